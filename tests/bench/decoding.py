"""Time to decode one sensors frame. The floor is one regular expression that captures its six fields."""

import re
from time import perf_counter

from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.sensors import Sensors
from tests.bench.measured import Measured, Scale, in_turns

FRAMES = [
    b"$4WD,CSB%d.%02d,PV7.9%d,GS%d,LF1011,HW01,GM10#" % (20 + i % 200, i % 100, i % 10, i % 1024) for i in range(20_000)
]
SIX = re.compile(rb"\$4WD,CSB([0-9.]+),PV([0-9.]+),GS([0-9]+),LF([01]{4}),HW([01]{2}),GM([01]{2})#")


def _ours(frames: list[bytes]) -> float:
    feed = FrameSplitter().feed
    began = perf_counter()
    for frame in frames:
        feed(frame, 0.0)
    took = perf_counter() - began
    assert isinstance(feed(frames[0], 0.0)[0], Sensors)
    return took / len(frames) * 1e6


def _floor(frames: list[bytes]) -> float:
    match = SIX.match
    began = perf_counter()
    for frame in frames:
        found = match(frame)
        assert found is not None
        found.groups()
    return (perf_counter() - began) / len(frames) * 1e6


def run(scale: Scale) -> list[Measured]:
    frames = FRAMES[: scale.count(len(FRAMES))]
    ours, floor = in_turns(scale, lambda: _ours(frames), lambda: _floor(frames))
    return [Measured("decode a sensors frame", tuple(ours), tuple(floor), "us", 6.0)]

"""CPU time per recorded message, and of a hundred cars. The floor is a subscriber's callback with `add_message`.

Both are processes of their own, and get the same messages at the same pace: those of forty cars that track a line.
The CPU time is that of the whole process, so ours includes flushes, status and counting.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, sleep, time_ns
from typing import Any

from schemas import bus, keys
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.bench.load import cpu_s
from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import READING, Stage, stage
from tests.support.lossless import all_there
from tests.support.processes import GatewayProcess, wait_for
from tests.support.recording import Load, Recording, faults

CARS = 40
TOPIC_NAMES = ("sensor/line", "frame/rx")
ROUNDS = 50
ROUND_S = 1 / 25
CROWD = 100
CROWD_S = 60.0
CROWD_FLOOR_S = 20.0
SETTLE_S = 0.3
"""Time until all publishers of a crowd have begun, before the CPU time is measured."""


def _publishers(opened: bus.Bus, fleet: str) -> list[bus.Publisher]:
    return [
        opened.publisher(keys.topic_key(fleet, f"car{number}", name), TOPICS[name], f"car{number}")
        for number in range(CARS)
        for name in TOPIC_NAMES
    ]


def _cost(here: Stage, fleet: str, rounds: int, start: Callable[[Path], GatewayProcess]) -> float:
    """Return the CPU time per message, microseconds."""
    publishers = _publishers(here.fleet.bus, fleet)
    line = pb.Line(left_outer=True)
    frame = pb.RxFrame(data=READING, verdict="sensors", published=["sensor/line"])
    with tempfile.TemporaryDirectory(dir=here.fleet.directory) as directory:
        process = start(Path(directory))
        assert process.line()["ready"]
        _known(here.fleet.bus, publishers)
        due = perf_counter()
        for number in range(rounds * len(publishers)):
            if number % len(TOPIC_NAMES) == 0:  # the next car's turn
                due += ROUND_S / CARS
                sleep(max(0.0, due - perf_counter()))
            publisher = publishers[number % len(publishers)]
            publisher.put(line if publisher.topic.name == "sensor/line" else frame, time_ns())
        found: Any = _told_to_end(process, rounds * len(publishers))
    assert found["messages"] >= rounds * len(publishers), found
    return float(found["cpu_s"]) / (rounds * len(publishers)) * 1e6


def _known(opened: bus.Bus, publishers: list[bus.Publisher]) -> None:
    """Wait until the publishers have the subscription, a moment after the subscriber is ready."""
    for publisher in publishers:
        with opened._session.declare_publisher(publisher.key) as plain:  # zenoh.ext's have no such method
            wait_for(lambda: plain.matching_status.matching, f"a subscriber of {publisher.key}")  # type: ignore[attr-defined]


def _told_to_end(process: GatewayProcess, published: int = 0) -> Any:
    assert process.popen.stdin is not None
    process.popen.stdin.write(f"{published}\n")
    process.popen.stdin.flush()
    found = process.line()
    process.wait()
    return found


def _crowd(here: Stage, scale: Scale) -> list[Measured]:
    """Record readings and raw frames of tracking cars. Check that the recorder drops and misses no message."""
    cars, crowd_s, floor_s = scale.count(CROWD), scale.seconds(CROWD_S, 1.0), scale.seconds(CROWD_FLOOR_S, 1.0)
    directory = here.fleet.directory / "crowd"
    recording = Recording(here.fleet, directory)
    with Load(here.fleet.endpoint, cars) as load:
        ours, rate = _share(recording.process, load, crowd_s)
        load.rest()
        all_there(load, [recording.session])
        found = recording.end()
    assert faults(load, [recording.session]) == ({}, {})
    assert (found["drops"], found["missed"]) == ({}, {}), found
    bare = here.bare("record", "fleet/**", str(here.fleet.directory / "crowd.mcap"))
    assert bare.line()["ready"]
    with Load(here.fleet.endpoint, cars) as load:
        floor, _ = _share(bare, load, floor_s)
    _told_to_end(bare)
    asked = cars * len(TOPIC_NAMES) / ROUND_S
    return [
        Measured(f"recorder CPU, {cars} cars at 25/s and frames, {crowd_s:g} s", (ours,), (floor,), "%", None),
        Measured("... which published, and all was recorded", (rate,), (asked,), "/s", None),
    ]


def _share(process: GatewayProcess, load: Load, seconds: float) -> tuple[float, float]:
    """Return the share of a core, in percent, and the messages a second."""
    sleep(SETTLE_S)
    count, before, began = load.count(), cpu_s(process), perf_counter()
    sleep(seconds)
    took = perf_counter() - began
    return (cpu_s(process) - before) / took * 100, (load.count() - count) / took


def run(scale: Scale) -> list[Measured]:
    with stage() as here:
        rounds = scale.count(ROUNDS, 3)
        ours, floor = in_turns(
            scale,
            lambda: _cost(
                here,
                "ours",
                rounds,
                lambda d: here.fleet.start("-m", "tests.bench.record_ours", here.fleet.endpoint, "ours", str(d)),
            ),
            lambda: _cost(here, "floor", rounds, lambda d: here.bare("record", "floor/**", str(d / "floor.mcap"))),
        )
        crowd = _crowd(here, scale)
    return [Measured("record a message (CPU)", tuple(ours), tuple(floor), "us", 1.3), *crowd]

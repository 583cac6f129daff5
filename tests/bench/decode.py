"""Decode time per sensors frame, against one regular expression that captures its six fields."""

import re
import timeit

from gateway.protocol.decode import Decoder
from tests.bench.measure import Measured, in_turn

FRAME = b"$4WD,CSB57.24,PV7.91,GS214,LF1011,HW01,GM10#"
FRAMES = 20_000
_FIELDS = re.compile(rb"\$4WD,CSB([\d.]+),PV([\d.]+),GS(\d+),LF([01]{4}),HW([01]{2}),GM([01]{2})#")


def run() -> list[Measured]:
    decoder = Decoder()

    def ours() -> float:
        return timeit.timeit(lambda: decoder.feed(FRAME, 0.0), number=FRAMES) / FRAMES * 1e6

    def floor() -> float:
        def capture() -> tuple[bytes, ...]:
            found = _FIELDS.match(FRAME)
            assert found is not None
            return found.groups()

        return timeit.timeit(capture, number=FRAMES) / FRAMES * 1e6

    return [Measured("decode a sensors frame", *in_turn(ours, floor), "us", 6.0)]

"""Finds out whether bytes without a frame look like a wrong baud rate. Pure.

The two ends of a serial line must agree on the length of a bit. A receiver that samples faster sees each bit of the car
several times, so its bytes consist of long runs of equal bits: 00, 80, E0, F8, FE and their like. A receiver that
samples slower sees several bits as one, and its bytes are arbitrary.
"""

from typing import Final

from msgspec import Struct

from schemas.links import LinkUrl

MIN_BYTES: Final = 200
"""Minimum bytes without a frame before the baud rate is doubted. A report of a car has 46."""
_MIN_RUN_SHARE: Final = 0.5
"""The baud rate counts as wrong if at least this share of the bytes has at most two runs of equal bits. In arbitrary
bytes the share is 0.06, in a report 0, and if the port is at least four times as fast as the car, 0.69 to 1."""
_MAX_TEXT_SHARE: Final = 0.8
"""Share of printable bytes above which the baud rate counts as right. It is 1 at the right rate, else at most 0.56."""
_TEXT: Final = frozenset({*range(0x20, 0x7F), *b"\r\n\t"})
_RUNS: Final = frozenset(
    byte for byte in range(256) if sum((byte >> bit & 1) != (byte >> (bit + 1) & 1) for bit in range(7)) <= 1
)
"""The bytes with at most two runs of equal bits."""


class BaudDoubt(Struct, frozen=True):
    """Why the baud rate may be wrong. `cause` is the word under which it is counted: `wrong_baud` or `no_frames`."""

    cause: str
    words: str


class BaudWatch:
    """Watches the bytes of one connection until the first frame."""

    def __init__(self, url: LinkUrl) -> None:
        self._url = url
        self._counts: dict[int, int] | None = {}
        """How often each byte arrived. None after the first frame, or after a result."""

    def on_bytes(self, data: bytes) -> BaudDoubt | None:
        """Count bytes. If there are many without a frame, return a doubt, once. Else return None."""
        if self._counts is None:
            return None
        for byte in data:
            self._counts[byte] = self._counts.get(byte, 0) + 1
        total = sum(self._counts.values())
        if total < MIN_BYTES:
            return None
        counts, self._counts = self._counts, None
        if _share(counts, _TEXT) > _MAX_TEXT_SHARE:
            return None
        looks_wrong = _share(counts, _RUNS) >= _MIN_RUN_SHARE
        return BaudDoubt("wrong_baud" if looks_wrong else "no_frames", self._words(total, looks_wrong=looks_wrong))

    def on_frame(self) -> None:
        """Stop watching, because a frame shows that the baud rate is right."""
        self._counts = None

    def _words(self, total: int, *, looks_wrong: bool) -> str:
        fact = f"{total} bytes came, but never a frame"
        if looks_wrong:
            fact += ": they look like a wrong baud rate"
        return f"{fact}. {self._url.doubt_baud()}"


def _share(counts: dict[int, int], wanted: frozenset[int]) -> float:
    return sum(count for byte, count in counts.items() if byte in wanted) / sum(counts.values())

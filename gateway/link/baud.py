"""Finds out whether bytes without a frame look like a wrong baud rate. Pure.

The two ends of a serial line must agree on the length of a bit. A receiver that samples faster sees each bit of the car
several times, so its bytes consist of long runs of equal bits: 00, 80, E0, F8, FE and their like. A receiver that
samples slower sees several bits as one, and its bytes are arbitrary.
"""

from dataclasses import dataclass
from typing import Final

from schemas.links import LinkUrl

MIN_BYTES: Final = 200
"""Minimum bytes without a frame before a baud rate is doubted; a report of a car has 46."""
_MIN_RUN_SHARE: Final = 0.5
"""Minimum share of bytes with at most two runs of equal bits. In arbitrary bytes it is 0.06, in a report 0. If the
port is four times as fast as the car or more, it is 0.69 to 1."""
_MAX_TEXT_SHARE: Final = 0.8
"""Maximum share of printable bytes: it is 1 at the right baud rate, and at most 0.56 at a wrong one."""
_TEXT: Final = frozenset({*range(0x20, 0x7F), *b"\r\n\t"})
_RUNS: Final = frozenset(
    byte for byte in range(256) if sum((byte >> bit & 1) != (byte >> (bit + 1) & 1) for bit in range(7)) <= 1
)
"""The bytes with at most two runs of equal bits."""


@dataclass(frozen=True, slots=True)
class BaudDoubt:
    """Why the baud rate may be wrong. `cause` is how it is counted, `wrong_baud` or `no_frames`."""

    cause: str
    words: str


class BaudWatch:
    """Watches the bytes of one connection until the first frame."""

    def __init__(self, url: LinkUrl) -> None:
        self._url = url
        self._counts: dict[int, int] | None = {}
        """How often each byte came. None after the first frame, or after the judgment."""

    def on_bytes(self, data: bytes) -> BaudDoubt | None:
        """Count bytes. Return a doubt once if many bytes have no frame, else None."""
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
        looks_so = _share(counts, _RUNS) >= _MIN_RUN_SHARE
        return BaudDoubt("wrong_baud" if looks_so else "no_frames", self._words(total, looks_so=looks_so))

    def on_frame(self) -> None:
        """Stop watching: the baud rate is right."""
        self._counts = None

    def _words(self, total: int, *, looks_so: bool) -> str:
        fact = f"{total} bytes came, but never a frame"
        if looks_so:
            fact += ": they look like a wrong baud rate"
        return f"{fact}. {self._url.doubt_baud()}"


def _share(counts: dict[int, int], wanted: frozenset[int]) -> float:
    return sum(count for byte, count in counts.items() if byte in wanted) / sum(counts.values())

"""How long to wait before the next try to connect, and what of many tries is news."""

from typing import Final

FIRST_S: Final = 0.25
LONGEST_S: Final = 1.0
"""A car may be driving while its link is away: whatever a try costs, it is tried again within a second."""
PROVEN_S: Final = 3.0
"""An open link that lived so long was no failure to open, though nothing was heard."""
MOST_CAUSES: Final = 10
_OPENED: Final = ""


def delay_s(failures: int, jitter: float) -> float:
    """Seconds before the next try after `failures` (1..) in a row; `jitter` 0..1 spreads it over the upper half."""
    longest = min(LONGEST_S, FIRST_S * 2.0 ** min(failures - 1, 10))
    return longest * (0.5 + 0.5 * jitter)


class Attempts:
    """The openings of one link, each of which may reset a car's board.

    One that carried a reading, or lived PROVEN_S, is proven, and its loss is followed by a try at once. One that opens
    and dies at once counts as one that did not open. Until one is proven, each cause is news once, and so is opening.
    """

    def __init__(self) -> None:
        self._failures = 0
        self._told: set[str] = set()
        self._opened_at: float | None = None
        """Of the link that is open and not proven yet."""
        self._untold = False

    def opened(self, now: float) -> bool:
        """The link is open; whether that is news."""
        self._opened_at = now
        self._untold = _OPENED in self._told
        self._told.add(_OPENED)
        return not self._untold

    def proven(self, now: float, *, heard: bool) -> bool:
        """Ask of an open link, at each reading and now and then; whether it is news now that it is open."""
        if self._opened_at is None or not (heard or now - self._opened_at >= PROVEN_S):
            return False
        self._opened_at = None
        self._failures = 0
        self._told.clear()
        return self._untold

    def failed(self, cause: str) -> bool:
        """The link did not open, or is lost; whether the cause is news."""
        self._opened_at = None
        self._failures += 1
        news = cause not in self._told and len(self._told) < MOST_CAUSES
        if news:
            self._told.add(cause)
        return news

    def delay_s(self, jitter: float) -> float:
        """Seconds before the next try; `jitter` as for `delay_s`."""
        return delay_s(max(1, self._failures), jitter)

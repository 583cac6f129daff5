"""Whether a car shows that it hears us, which it never says: `MODE00` blocks it for a second without reports. Pure.

In mode 0 a report comes once a second, counted in turns of the loop, which a block holds up (protocol.md): so two
reports around a `MODE00` that was obeyed are two seconds apart, and one second around one that was lost.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

EARLY_S: Final = 0.95
"""A report that comes so soon after `MODE00` was written was sent before it had come, or the car never got it."""
HELD_UP_S: Final = 0.8
"""Reports that are closer than this were held up on the way, so when they came says nothing."""
UNBLOCKED_S: Final = 1.4
"""Reports that are no further apart have no block of a second between them."""
BLOCKED_S: Final = 1.7
"""Reports so far apart have, if both had an echo: without one a ranging takes a second."""


class Shown(StrEnum):
    """What two reports around a `MODE00` show."""

    OBEYED = "obeyed"
    LOST = "lost"


@dataclass(slots=True)
class Obedience:
    """Weighs the reports of mode 0, by when they came. Times: s, monotonic.

    A lost `MODE00` shows where the link's way there and back takes less than a second, whatever it is.
    """

    ever: bool = False
    """The car has shown since the link was opened that it hears."""
    _closed_at: float | None = None
    _before: float | None = None
    """When the last report with an echo came, if nothing without one came since."""
    _early: bool = False

    def closed(self, now: float, *, awake: bool) -> None:
        """`MODE00` was written; `awake`: to a car that was not blocked, so that it began to beep at once."""
        self._closed_at = now if awake else None
        self._early = False

    def heard(self, at: float, *, echo: bool) -> Shown | None:
        """Take a report of mode 0; what it shows, if it does."""
        before, self._before = self._before, at if echo else None
        closed_at = self._closed_at
        if closed_at is None or before is None or not echo:
            self._early = False
            return None
        early, self._early = self._early, False
        if not early and at < closed_at + EARLY_S:
            self._early = at > closed_at
            return None
        self._closed_at = None
        gap_s = at - before
        if gap_s > BLOCKED_S:
            self.ever = True
            return Shown.OBEYED
        return Shown.LOST if early and HELD_UP_S < gap_s < UNBLOCKED_S else None

    def stalled(self, gap_s: float) -> None:
        """The loop slept for so long, so reports may have been taken later than they came."""
        if gap_s > 1.0 - HELD_UP_S:
            self._closed_at, self._early = None, False

    @property
    def doubt_until(self) -> float:
        """Until when it is open whether `MODE00` was lost; -inf if there is no doubt."""
        return self._before + UNBLOCKED_S if self._early and self._before is not None else float("-inf")

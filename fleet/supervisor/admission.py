"""Decides which processes may be started or killed now, so that a loaded machine is not loaded more. Pure.

`fleet up --sim 100` on two cores: a gateway takes 0.3 s of a processor to start. A hundred that start together are not
heard in time, and each restart makes the others later.
"""

from collections.abc import Iterable
from typing import Final

PLACE_S: Final = 10.0
"""Maximum time for which a starting process keeps others from starting. A process that hangs must not hold them up."""
RESTARTS_AT_ONCE: Final = 16
RESTART_INTERVAL_S: Final = 1.0
"""Restarts of the whole fleet beyond the first ones. A restart takes 0.3 to 0.7 s of a processor."""
KILLS_AT_ONCE: Final = 3
KILL_INTERVAL_S: Final = 5.0
"""Kills of hung processes of the whole fleet beyond the first ones."""


class Budget:
    """Allows `at_once` events, and one more for each interval that passes."""

    def __init__(self, at_once: int, interval_s: float) -> None:
        self._at_once = at_once
        self._interval_s = interval_s
        self._left = float(at_once)
        self._at: float | None = None

    def has(self, now: float) -> bool:
        """Return True if an event is allowed now."""
        if self._at is not None:
            self._left = min(self._at_once, self._left + (now - self._at) / self._interval_s)
        self._at = now
        return self._left >= 1.0

    def take(self) -> None:
        """Count an event that `has` allowed."""
        self._left -= 1.0


class Admission:
    """Admits starts a few at a time: the next one when a process before it is heard, or has had its time."""

    def __init__(self, places: int) -> None:
        self._places = places
        self._restarts = Budget(RESTARTS_AT_ONCE, RESTART_INTERVAL_S)
        self._kills = Budget(KILLS_AT_ONCE, KILL_INTERVAL_S)

    def admit_start(self, now: float, starting_since: Iterable[float], *, restart: bool) -> bool:
        """Return True if one more process may be started now, beside those that start since these times."""
        if sum(now - since < PLACE_S for since in starting_since) >= self._places:
            return False
        if restart:
            if not self._restarts.has(now):
                return False
            self._restarts.take()
        return True

    def may_kill(self, now: float) -> bool:
        """Return True if one more hung process may be killed now."""
        return self._kills.has(now)

    def killed(self) -> None:
        """Count a hung process that was killed."""
        self._kills.take()

"""Rate limits for starts and kills, so that restarts do not overload the machine further. Pure.

A gateway takes 0.3 s of CPU time to start. A hundred gateways on two cores cannot all send a heartbeat in time. Each
restart would delay the others further.
"""

from collections.abc import Iterable
from typing import Final

START_SLOT_TIMEOUT_S: Final = 10.0
"""Maximum time for which a starting process delays others. A hung process must not block them."""
RESTARTS_AT_ONCE: Final = 16
RESTART_INTERVAL_S: Final = 1.0
"""Interval of further restarts in the whole fleet. A restart takes 0.3 to 0.7 s of CPU time."""
KILLS_AT_ONCE: Final = 3
KILL_INTERVAL_S: Final = 5.0
"""Interval of further kills of hung processes in the whole fleet."""


class Budget:
    """A rate limit: `at_once` events, and one more for each interval that passes."""

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
    """Limits concurrent starts. A start ends with the first heartbeat or after START_SLOT_TIMEOUT_S."""

    def __init__(self, places: int) -> None:
        self._places = places
        self._restarts = Budget(RESTARTS_AT_ONCE, RESTART_INTERVAL_S)
        self._kills = Budget(KILLS_AT_ONCE, KILL_INTERVAL_S)

    def admit_start(self, now: float, starting_since: Iterable[float], *, restart: bool) -> bool:
        """Return True if one more process may start now. starting_since: when the starting processes were started."""
        if sum(now - since < START_SLOT_TIMEOUT_S for since in starting_since) >= self._places:
            return False
        if restart:
            if not self._restarts.has(now):
                return False
            self._restarts.take()
        return True

    def may_kill(self, now: float) -> bool:
        """Return True if one more hung process may be killed now."""
        return self._kills.has(now)

    def count_kill(self) -> None:
        """Count one killed hung process."""
        self._kills.take()

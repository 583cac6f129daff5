"""Limits for starts, restarts and kills, so that restarts do not overload the machine further. Pure.

A gateway needs 0.3 s of CPU time to start. If a hundred gateways start on two cores, they cannot all send a heartbeat
in time. Those without one would be killed as hung and restarted, and each restart would delay the others further.
"""

from collections.abc import Iterable
from typing import Final

from schemas.token_bucket import TokenBucket

START_SLOT_TIMEOUT_S: Final = 10.0
"""Maximum time for which a starting process delays others, because one that hangs must not block them."""
RESTARTS_AT_ONCE: Final = 16
RESTART_INTERVAL_S: Final = 1.0
"""Interval of restarts in the whole fleet after the first RESTARTS_AT_ONCE. A restart takes 0.3 to 0.7 s of CPU
time."""
KILLS_AT_ONCE: Final = 3
KILL_INTERVAL_S: Final = 5.0
"""Interval of kills of hung processes in the whole fleet after the first KILLS_AT_ONCE."""


class Admission:
    """Limits concurrent starts to `places`, and the rates of restarts and kills.

    A start ends with the first heartbeat or after START_SLOT_TIMEOUT_S.
    """

    def __init__(self, places: int) -> None:
        self._places = places
        self._restarts = TokenBucket(1 / RESTART_INTERVAL_S, RESTARTS_AT_ONCE)
        self._kills = TokenBucket(1 / KILL_INTERVAL_S, KILLS_AT_ONCE)

    def admit_start(self, now: float, starting_since: Iterable[float], *, restart: bool) -> bool:
        """Return True if one more process may start now. starting_since: when the starting processes were started."""
        if sum(now - since < START_SLOT_TIMEOUT_S for since in starting_since) >= self._places:
            return False
        return not restart or self._restarts.take_one(now)

    def may_kill(self, now: float) -> bool:
        """Return True if one more hung process may be killed now."""
        return self._kills.has(now)

    def count_kill(self, now: float) -> None:
        """Count one killed hung process."""
        self._kills.take_one(now)

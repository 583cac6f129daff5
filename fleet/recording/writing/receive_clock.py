"""The clock of a recorder's receive times: the wall clock, but it never goes back. No I/O.

Readers sort by receive time. If somebody sets the wall clock back by an hour, a session would tell two hours at once: a
replay would mix them, and `sessions verify` would find gaps. So receive times go on, and only the publish times follow
the clock. The next recorder begins with the time of the wall clock again.
"""

import time
from collections.abc import Callable
from typing import Final

SET_BACK_NS: Final = 1_000_000_000
"""Minimum by which a wall clock is set back. NTP corrects less than this slowly, and the receive times follow it."""


class ReceiveClock:
    """Follows the wall clock forward, also over a sleep of the computer."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._last_ns = wall_ns()
        self._ahead_ns = self._last_ns - monotonic_ns()

    def ns(self) -> int:
        """Return the time, ns since the epoch; never less than before."""
        monotonic_ns = self._monotonic_ns()
        ahead_ns = self._wall_ns() - monotonic_ns
        if ahead_ns > self._ahead_ns - SET_BACK_NS:
            self._ahead_ns = ahead_ns
        self._last_ns = max(self._last_ns, monotonic_ns + self._ahead_ns)
        return self._last_ns

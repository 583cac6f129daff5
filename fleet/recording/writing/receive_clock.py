"""The clock of a recorder's receive times: the wall clock, but it never goes back. No I/O.

Readers sort by receive time. If receive times followed a wall clock that is set back by an hour, a session would
contain the same hour twice: a replay would mix the two, and `sessions verify` would find gaps. So receive times keep
running, and only the publish times follow the clock. The next recorder starts at the wall clock again.
"""

import time
from collections.abc import Callable
from typing import Final

SET_BACK_NS: Final = 1_000_000_000
"""Minimum backward step that counts as a wall clock being set back. NTP corrects smaller errors slowly, and the receive
times follow these corrections."""


class ReceiveClock:
    """A clock that follows the wall clock forward, also over a sleep of the computer."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._last_ns = wall_ns()
        self._ahead_ns = self._last_ns - monotonic_ns()

    def ns(self) -> int:
        """Return the time, ns since the epoch. It is never less than before."""
        monotonic_ns = self._monotonic_ns()
        ahead_ns = self._wall_ns() - monotonic_ns
        if ahead_ns > self._ahead_ns - SET_BACK_NS:
            self._ahead_ns = ahead_ns
        self._last_ns = max(self._last_ns, monotonic_ns + self._ahead_ns)
        return self._last_ns

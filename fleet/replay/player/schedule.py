"""Computes when each message of a replayed recording is due. Pure; all times are arguments.

All times count from one origin, in whole nanoseconds of the recording. So a message that is late does not delay others.
"""

from msgspec import Struct


class Schedule(Struct):
    """Converts times of the recorder, in order, to seconds since the origin."""

    rate: float = 1.0
    longest_gap_ns: int | None = None
    """Maximum gap between messages. Longer gaps are shortened to it. None means no limit."""
    played_ns: int = 0
    """Length of the recording played so far, with shortened gaps."""
    shortened: int = 0
    """Number of shortened gaps."""
    _last_ns: int | None = None

    def due_s(self, at_ns: int) -> float:
        """Return when the next message is due. A backward step of the clock takes no time."""
        if self._last_ns is not None:
            gap_ns = max(0, at_ns - self._last_ns)
            if self.longest_gap_ns is not None and gap_ns > self.longest_gap_ns:
                gap_ns = self.longest_gap_ns
                self.shortened += 1
            self.played_ns += gap_ns
        self._last_ns = at_ns
        return self.played_ns / 1e9 / self.rate

    def again(self, pause_ns: int) -> None:
        """Let the recording begin again after a pause."""
        self.played_ns += pause_ns
        self._last_ns = None

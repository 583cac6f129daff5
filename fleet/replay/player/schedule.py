"""When each message of a recording is due when it is played again. Pure; times are seconds and nanoseconds given.

Everything is counted from one origin, in whole nanoseconds of the recording: what is late once makes nothing else late.
"""

from dataclasses import dataclass


@dataclass(slots=True)
class Schedule:
    """Takes the recorder's times in order, gives seconds since the origin."""

    rate: float = 1.0
    longest_gap_ns: int | None = None
    """A pause that is longer is made so long; None: none is shortened."""
    played_ns: int = 0
    """How much of the recording has been played, pauses that were shortened as they are played."""
    shortened: int = 0
    _last_ns: int | None = None

    def due_s(self, at_ns: int) -> float:
        """When the next message is due. A clock that went backwards stands still meanwhile."""
        if self._last_ns is not None:
            gap_ns = max(0, at_ns - self._last_ns)
            if self.longest_gap_ns is not None and gap_ns > self.longest_gap_ns:
                gap_ns = self.longest_gap_ns
                self.shortened += 1
            self.played_ns += gap_ns
        self._last_ns = at_ns
        return self.played_ns / 1e9 / self.rate

    def again(self, pause_ns: int) -> None:
        """The recording begins anew, so long after its last message."""
        self.played_ns += pause_ns
        self._last_ns = None

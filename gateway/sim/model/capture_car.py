"""Plays a capture as a car: its pieces at their times. It ignores all bytes from the host."""

from collections.abc import Sequence
from math import inf
from typing import Final

LOOP_PAUSE_S: Final = 1.0
"""Pause between two rounds of a loop, about as long as the time between two reports of a car."""


class CaptureCar:
    """Plays pieces (time in the capture, s, and bytes), `rate` times as fast, once or for ever.

    Times must not run backwards.
    """

    def __init__(
        self, pieces: Sequence[tuple[float, bytes]], *, rate: float = 1.0, loop: bool = False, now: float | None = None
    ) -> None:
        self._pieces = pieces
        self._rate = rate
        self._loop = loop
        self._index = 0
        self._start = now
        """Start time of this round, or None while the capture waits for a host."""
        self.rounds = 0
        """Number of complete rounds."""
        self.sent_bytes = 0
        self.ignored_bytes = 0
        """Number of bytes from the host."""
        self.truth: Final = None
        self.alive: Final = True

    def begin(self, now: float) -> None:
        """Start to play, unless the capture has begun before, even if it has ended since."""
        if self._start is None:
            self._start = now

    @property
    def done(self) -> bool:
        """True at the end of a capture that does not loop."""
        return self._index >= len(self._pieces)

    def feed(self, data: bytes, now: float) -> None:  # noqa: ARG002 - as Firmware.feed
        """Count the bytes and ignore them."""
        self.ignored_bytes += len(data)

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """Return the pieces that were due since the last call, each with its time."""
        sent = []
        while (due := self.next_event()) <= now:
            data = self._pieces[self._index][1]
            sent.append((due, data))
            self.sent_bytes += len(data)
            self._index += 1
            if self.done:
                self.rounds += 1
                if self._loop:
                    self._index, self._start = 0, due + LOOP_PAUSE_S / self._rate
        return sent

    def next_event(self) -> float:
        """Return the time of the next piece, or inf if there is none, or if no host has connected yet."""
        if self._start is None or self.done:
            return inf
        return self._start + self._pieces[self._index][0] / self._rate

    def backlog(self, now: float) -> int:  # noqa: ARG002 - as Firmware.backlog
        """Return 0: the capture accepts bytes at once."""
        return 0

    def pose(self, now: float) -> None:  # noqa: ARG002 - as Firmware.pose
        """Return None: the pose is unknown."""
        return

    def drop_link(self, now: float) -> None:
        """Do nothing, because a capture plays on without its link, as a car runs on without one."""

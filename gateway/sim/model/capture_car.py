"""A capture that plays as a car: its pieces at their times. It hears nothing; only its bytes are known."""

from collections.abc import Sequence
from math import inf
from typing import Final

PAUSE_S: Final = 1.0
"""Between two rounds of a loop: about what lies between two reports of a car."""


class CaptureCar:
    """Plays (time in the capture s, bytes) once or for ever, `rate` times as fast. Times must not run backwards."""

    def __init__(
        self, pieces: Sequence[tuple[float, bytes]], *, rate: float = 1.0, loop: bool = False, now: float | None = None
    ) -> None:
        self._pieces = pieces
        self._rate = rate
        self._loop = loop
        self._index = 0
        self._start = now
        """When the round began; None: a host is waited for."""
        self.rounds = 0
        """How often it was played to its end."""
        self.sent_bytes = 0
        self.ignored_bytes = 0
        """What the host has sent to it."""
        self.truth: Final = None
        self.alive: Final = True

    def begin(self, now: float) -> None:
        """A host is there; of a capture that plays already nothing changes."""
        if self._start is None:
            self._start = now

    @property
    def done(self) -> bool:
        """Whether nothing more will come."""
        return self._index >= len(self._pieces)

    def feed(self, data: bytes, now: float) -> None:  # noqa: ARG002 - as Firmware.feed
        """Nobody hears it; it is counted."""
        self.ignored_bytes += len(data)

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """What has come since, with its time."""
        sent = []
        while (due := self.next_event()) <= now:
            data = self._pieces[self._index][1]
            sent.append((due, data))
            self.sent_bytes += len(data)
            self._index += 1
            if self.done:
                self.rounds += 1
                if self._loop:
                    self._index, self._start = 0, due + PAUSE_S / self._rate
        return sent

    def next_event(self) -> float:
        """When its next piece is due; inf when there is none, or nobody has come."""
        if self._start is None or self.done:
            return inf
        return self._start + self._pieces[self._index][0] / self._rate

    def backlog(self, now: float) -> int:  # noqa: ARG002 - as Firmware.backlog
        """Nothing waits: whatever comes is taken at once."""
        return 0

    def pose(self, now: float) -> None:  # noqa: ARG002 - as Firmware.pose
        """Nobody knows."""
        return

    def drop_link(self, now: float) -> None:
        """The capture goes on while its link is gone, as a car does."""

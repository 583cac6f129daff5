"""The declarations of a bus, each of which can be repeated in the bus's next session (`Bus.reopen`)."""

from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any, Self

import zenoh

from schemas.bus.overlap import Overlap, mark_of_sample

Declare = Callable[[zenoh.Session, int], Any]
"""Declares something in a session. The number is that of the session: a callback must know which session calls it."""


class Declared:
    """One subscription, queryable or token of a bus."""

    def __init__(self, declare: Declare) -> None:
        self._declare = declare
        self.current: list[Any] = []
        """Zenoh's own declarations, one for each open session, the newest last."""
        self.is_over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.undeclare()

    def add(self, session: zenoh.Session, number: int) -> None:
        """Make the declaration in a session."""
        self.current.append(self._declare(session, number))

    def undeclare(self) -> None:
        """End the declaration in every session."""
        self.is_over = True
        while self.current:
            self.current.pop().undeclare()

    def keep_newest(self) -> None:
        """End the declaration in all sessions but the newest."""
        while len(self.current) > 1:
            self.current.pop(0).undeclare()

    def keep_oldest(self) -> None:
        """Keep the declaration only in the oldest session. The other sessions are about to close, and end theirs."""
        del self.current[1:]


class SampleChannel(Declared):
    """A subscription that is read with `try_recv`, by one thread."""

    def __init__(self, declare: Declare, declaration: int) -> None:
        super().__init__(declare)
        self._declaration = declaration
        self._older_is_over = False
        self.try_recv: Callable[[], zenoh.Sample | None] = lambda: None
        """Return the next sample, or None if there is none. It is Zenoh's own method, because a wrapper costs time."""

    def add(self, session: zenoh.Session, number: int) -> None:
        """Subscribe in a session. Read two declarations until the older one has ended and is empty."""
        super().add(session, number)
        if len(self.current) == 1:
            self.try_recv = self.current[0].handler.try_recv
            return
        self._older_is_over = False
        self._read_both(self.try_recv, self.current[-1].handler.try_recv)

    def keep_newest(self) -> None:
        """End the subscription in all sessions but the newest. Samples that the older ones still hold can be read."""
        super().keep_newest()
        self._older_is_over = True

    def keep_oldest(self) -> None:
        """Keep the declaration only in the oldest session. The other sessions are about to close, and end theirs."""
        super().keep_oldest()
        self.try_recv = self.current[0].handler.try_recv

    def _read_both(self, older: Callable[[], zenoh.Sample | None], newer: Callable[[], zenoh.Sample | None]) -> None:
        overlap = Overlap()

        def receive() -> zenoh.Sample | None:
            is_over = self._older_is_over
            with suppress(zenoh.ZError):  # the older declaration is undeclared, and empty
                while (sample := older()) is not None:
                    if not overlap.is_twin(mark_of_sample(self._declaration, sample), monotonic(), newer=False):
                        return sample
            while (sample := newer()) is not None:
                if not overlap.is_twin(mark_of_sample(self._declaration, sample), monotonic(), newer=True):
                    return sample
            if is_over:
                self.try_recv = newer
            return None

        self.try_recv = receive

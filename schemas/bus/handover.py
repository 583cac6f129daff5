"""Bounded queues from Zenoh's threads to one asyncio loop.

A Zenoh callback runs on a foreign thread and does one thing: hand over to the loop that owns the state.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:  # a gateway is on the bus before it has imported these
    import asyncio


T = TypeVar("T")

_TURN: Final = 16
"""Objects that are handed over in one iteration of a loop."""


class Handover(Generic[T]):
    """Hands objects from Zenoh's threads to one asyncio loop, in order and bounded; what does not fit is counted.

    Left out is what comes while it is full or, with `newest`, what has waited longest. It may be made before there is
    a loop: what comes waits until `attach`. In one iteration of the loop it hands over few, so that others get a turn.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop | None" = None,
        take: Callable[[T], object] | None = None,
        *,
        limit: int = 1024,
        newest: bool = False,
    ) -> None:
        self._loop = loop
        self._take = take
        self._limit = limit
        self._newest = newest
        self._lock = threading.Lock()
        self._waiting: deque[T] = deque()
        self.dropped = 0

    def attach(self, loop: "asyncio.AbstractEventLoop", take: Callable[[T], object]) -> None:
        """Say who takes what comes; on the loop's thread."""
        with self._lock:
            self._loop = loop
            self._take = take
        loop.call_soon(self._drain)

    def __call__(self, item: T, *, reserve: int = 0) -> bool:
        """Called on a Zenoh thread; False if the item was left out. `reserve`: how far it may go beyond the limit."""
        with self._lock:
            if len(self._waiting) >= self._limit + reserve:
                self.dropped += 1
                if not self._newest:
                    return False
                self._waiting.popleft()
            self._waiting.append(item)
            loop = self._loop
            if loop is None or len(self._waiting) > 1:
                return True
        try:
            loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop is closed: nobody is left to take it
            return False
        return True

    def _drain(self) -> None:
        assert self._loop is not None
        assert self._take is not None
        with self._lock:
            batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), _TURN))]
            left = bool(self._waiting)
        for item in batch:
            # One callback each: an item that raises takes no other with it.
            self._loop.call_soon(self._take, item)
        if left:
            self._loop.call_soon(self._drain)


class Backlog(Generic[T]):
    """Objects from Zenoh's threads that wait for one task of an asyncio loop, in order and bounded.

    The task takes one when it is done with the last: what takes long is done one at a time. It may be made before there
    is a loop.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._waiting: deque[T] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._came: asyncio.Event | None = None
        self.dropped = 0
        """How many found it full."""

    def attach(self, loop: "asyncio.AbstractEventLoop", came: "asyncio.Event") -> None:
        """Say whose task takes them; `came` is set when there are some. On the loop's thread."""
        with self._lock:
            self._loop, self._came = loop, came
        came.set()

    def __call__(self, item: T) -> bool:
        """Called on a Zenoh thread; False if the item was left out."""
        with self._lock:
            if len(self._waiting) >= self._limit:
                self.dropped += 1
                return False
            self._waiting.append(item)
            loop, came = self._loop, self._came
            if loop is None or came is None or len(self._waiting) > 1:
                return True
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to take it
            loop.call_soon_threadsafe(came.set)
        return True

    async def next(self) -> T:
        """The one that has waited longest; only one task may wait for it."""
        assert self._came is not None
        while True:
            with self._lock:
                if self._waiting:
                    return self._waiting.popleft()
                self._came.clear()
            await self._came.wait()


class Latest(Generic[T]):
    """Hands the latest value of each name from Zenoh's threads to one asyncio loop: changes of one name are merged.

    The first is handed over at once, what comes within `APART_S` after it together. Of more names than `limit` in that
    time the rest is left out, and counted.
    """

    APART_S: Final = 0.05

    def __init__(self, limit: int = 16_384) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._changed: dict[str, T] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._take: Callable[[dict[str, T]], object] | None = None
        self._told_at = float("-inf")
        self.dropped = 0

    def attach(self, loop: "asyncio.AbstractEventLoop", take: "Callable[[dict[str, T]], object]") -> None:
        """Say who takes what has changed, the latest of each name; on the loop's thread."""
        with self._lock:
            self._loop, self._take = loop, take
        loop.call_soon(self._tell)

    def __call__(self, name: str, value: T) -> bool:
        """Called on a Zenoh thread; False if the change was left out."""
        with self._lock:
            first = not self._changed
            if len(self._changed) >= self._limit and name not in self._changed:
                self.dropped += 1
                return False
            self._changed.pop(name, None)  # in the order of the last changes
            self._changed[name] = value
            loop = self._loop
        if first and loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to take it
                loop.call_soon_threadsafe(self._schedule)
        return True

    def taken(self) -> dict[str, T]:
        """What has changed since it was taken last, for who comes by itself."""
        with self._lock:
            changed, self._changed = self._changed, {}
        return changed

    def _schedule(self) -> None:
        assert self._loop is not None
        self._loop.call_at(self._told_at + self.APART_S, self._tell)

    def _tell(self) -> None:
        assert self._loop is not None
        assert self._take is not None
        self._told_at = self._loop.time()
        if changed := self.taken():
            self._take(changed)

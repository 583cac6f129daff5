"""Bounded queues from Zenoh's threads to one asyncio loop.

A Zenoh callback runs on a thread of Zenoh. It only hands its object over to the loop, which owns the state.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:  # a gateway joins the bus before it imports these
    import asyncio


T = TypeVar("T")

_BATCH: Final = 16
"""Maximum number of objects handed over in one iteration of the loop, so that other callbacks get their turn."""


class Handover(Generic[T]):
    """A bounded first-in-first-out queue. If it is full, it drops the new object or, with `newest`, the oldest one.

    It may be created before the loop. Objects then wait until `attach`.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop | None" = None,
        on_item: Callable[[T], object] | None = None,
        *,
        limit: int = 1024,
        newest: bool = False,
    ) -> None:
        self._loop = loop
        self._on_item = on_item
        self._limit = limit
        self._newest = newest
        self._lock = threading.Lock()
        self._queue: deque[T] = deque()
        self.dropped = 0
        """Number of dropped objects."""

    def attach(self, loop: "asyncio.AbstractEventLoop", on_item: Callable[[T], object]) -> None:
        """Set the loop and its callback. Runs on the loop's thread."""
        with self._lock:
            self._loop = loop
            self._on_item = on_item
        loop.call_soon(self._drain)

    def __call__(self, item: T, *, reserve: int = 0) -> bool:
        """Queue an object, on a Zenoh thread. Return False if it was dropped. `reserve` raises the limit for it."""
        with self._lock:
            if len(self._queue) >= self._limit + reserve:
                self.dropped += 1
                if not self._newest:
                    return False
                self._queue.popleft()
            self._queue.append(item)
            loop = self._loop
            if loop is None or len(self._queue) > 1:
                return True
        try:
            loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop is closed
            return False
        return True

    def _drain(self) -> None:
        assert self._loop is not None
        assert self._on_item is not None
        with self._lock:
            batch = [self._queue.popleft() for _ in range(min(len(self._queue), _BATCH))]
            left = bool(self._queue)
        for item in batch:
            # A callback for each, so that an exception affects only one object.
            self._loop.call_soon(self._on_item, item)
        if left:
            self._loop.call_soon(self._drain)


class Backlog(Generic[T]):
    """A bounded first-in-first-out queue for slow work: one task handles one object at a time.

    It may be created before the loop.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._queue: deque[T] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._not_empty: asyncio.Event | None = None
        self.dropped = 0
        """Number of objects that were dropped because the queue was full."""

    def attach(self, loop: "asyncio.AbstractEventLoop", not_empty: "asyncio.Event") -> None:
        """Set the loop, and the event that tells it that there are objects. Runs on the loop's thread."""
        with self._lock:
            self._loop, self._not_empty = loop, not_empty
        not_empty.set()

    def __call__(self, item: T) -> bool:
        """Queue an object, on a Zenoh thread. Return False if it was dropped."""
        with self._lock:
            if len(self._queue) >= self._limit:
                self.dropped += 1
                return False
            self._queue.append(item)
            loop, not_empty = self._loop, self._not_empty
            if loop is None or not_empty is None or len(self._queue) > 1:
                return True
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(not_empty.set)
        return True

    async def next(self) -> T:
        """Wait for the oldest object and return it. Only one task may call this."""
        assert self._not_empty is not None
        while True:
            with self._lock:
                if self._queue:
                    return self._queue.popleft()
                self._not_empty.clear()
            await self._not_empty.wait()


class Latest(Generic[T]):
    """Hands over only the latest value of each name, at most once per `INTERVAL_S` (debounced).

    The first change is handed over at once, later ones together after the interval. Within one interval, changes of
    further names are dropped once `limit` names have changed.
    """

    INTERVAL_S: Final = 0.05

    def __init__(self, limit: int = 16_384) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._changed: dict[str, T] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_change: Callable[[dict[str, T]], object] | None = None
        self._handed_over_at = float("-inf")
        self.dropped = 0
        """Number of dropped changes."""

    def attach(self, loop: "asyncio.AbstractEventLoop", on_change: "Callable[[dict[str, T]], object]") -> None:
        """Set the loop, and the callback that gets the changed names with their values. Runs on the loop's thread."""
        with self._lock:
            self._loop, self._on_change = loop, on_change
        loop.call_soon(self._hand_over)

    def __call__(self, name: str, value: T) -> bool:
        """Record a change, on a Zenoh thread. Return False if it was dropped."""
        with self._lock:
            first = not self._changed
            if len(self._changed) >= self._limit and name not in self._changed:
                self.dropped += 1
                return False
            self._changed.pop(name, None)  # keeps the names in the order of their last changes
            self._changed[name] = value
            loop = self._loop
        if first and loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._schedule)
        return True

    def take(self) -> dict[str, T]:
        """Return the changes since the last call, for callers without a loop."""
        with self._lock:
            changed, self._changed = self._changed, {}
        return changed

    def _schedule(self) -> None:
        assert self._loop is not None
        self._loop.call_at(self._handed_over_at + self.INTERVAL_S, self._hand_over)

    def _hand_over(self) -> None:
        assert self._loop is not None
        assert self._on_change is not None
        self._handed_over_at = self._loop.time()
        if changed := self.take():
            self._on_change(changed)

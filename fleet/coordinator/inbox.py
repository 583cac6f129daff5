"""Input of the coordinator from the bus: samples and queries in order, and gateways that arrive or leave.

Zenoh's threads fill the inbox, and the coordinator's own thread empties it. Its size is limited: further items are
dropped and counted.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, Self

import zenoh
from msgspec import Struct

from fleet.client.client import Fleet
from schemas import keys
from schemas.bus import Latest, Sample
from schemas.topics import Qos

_STATE_QUERY_TIMEOUT_S: Final = 1.0
_INBOX_SIZE: Final = 4096
_MAX_WAITING_QUERIES: Final = 64
"""Maximum number of queries in the inbox."""
_MAX_STATE_QUERIES_AT_ONCE: Final = 4
_MAX_CARS_QUERIED_SINGLY: Final = 8
"""Maximum number of cars that are queried one by one. If more arrive together, one query asks all cars."""


class QueriedSample(Struct, frozen=True):
    """A sample from a query, so it may be old."""

    sample: Sample


Item = Sample | QueriedSample | zenoh.Query


class Heard(Struct, frozen=True):
    """Messages, and gateways that came or left: one batch from the inbox of a program that only listens."""

    now: float
    """The time at which they were taken from the inbox, s, monotonic."""
    gateways: Mapping[str, bool]
    """The cars whose gateways arrived (True) or left."""
    samples: Sequence[tuple[Sample, float | None]]
    """Messages. An answer to a query may be old, so it comes with the wall clock (s). A message that was just published
    comes with None."""


class Inbox:
    """The inbox of a coordinator, or of a program that only listens.

    `topics_wanted` returns the topics for which the cars are queried.
    """

    def __init__(self, client: Fleet, topics_wanted: Callable[[], set[str]]) -> None:
        self._client = client
        self._topics_wanted = topics_wanted
        self.dropped = 0
        """Number of samples and queries dropped because the inbox was full."""
        self._subscribed: set[str] = set()
        self._items: queue.Queue[Item] = queue.Queue(_INBOX_SIZE)
        self._query_slots = threading.Semaphore(_MAX_WAITING_QUERIES)
        """Free places for queries in the inbox."""
        self._tokens: Latest[bool] = Latest()
        """Changes of tokens by car: True if the gateway is on the bus."""
        self._arrived: set[str] = set()
        """Cars whose gateways arrived and whose states were not queried yet."""
        self._state_queries: list[Future[None]] = []

    @classmethod
    def listening(cls, client: Fleet, topics: Iterable[str], more: Iterable[str] = ()) -> Self:
        """Return the inbox of a program that only listens, filled from now on.

        topics: topics of all cars to listen to. A car whose gateway arrives is also queried for them. more: topics that
        are not queried.
        """
        asked = {*topics}
        inbox = cls(client, lambda: asked)
        for topic in sorted({*asked, *more}):
            inbox.subscribe(keys.topic_key(client.name, "*", topic))
        inbox.watch_gateways()
        return inbox

    # ------------------------------------------------------------------ filling the inbox

    def subscribe(self, expression: str) -> None:
        """Also receive the samples of these keys."""
        if expression not in self._subscribed:
            self._subscribed.add(expression)
            self._client.bus.subscribe(expression, self._enqueue)

    def watch_gateways(self) -> None:
        """Receive the changes of the gateways' tokens."""
        token = keys.car_token(self._client.name, "*")
        self._client.bus.watch_tokens(token, lambda key, alive: self._tokens(key.rpartition("/")[2], alive))

    def on_query(self, query: zenoh.Query) -> bool:
        """Put a query into the inbox. Return False if too many wait. Runs on a Zenoh thread."""
        if not self._query_slots.acquire(blocking=False):
            return False
        if self._enqueue(query):
            return True
        self._query_slots.release()
        return False

    def query_states(self, car: str = "*") -> None:
        """Query the last states and readings of all cars, or of one."""
        for topic in sorted(self._topics_wanted()):
            selector = f"{self._client.name}/{car}/{topic}"
            for answer in self._client.bus.query(selector, timeout_s=_STATE_QUERY_TIMEOUT_S, qos=Qos.STATE):
                if isinstance(answer, Sample):
                    self._enqueue(QueriedSample(answer))

    def _enqueue(self, item: Item) -> bool:
        """Put an item into the inbox. Return False if the inbox is full. May run on any thread."""
        try:
            self._items.put_nowait(item)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    # ------------------------------------------------------------------ emptying the inbox

    def items(self, wait_s: float) -> Iterator[Item]:
        """Yield the items in the inbox, at most as many as it can hold. Wait at most `wait_s` for the first."""
        for _ in range(_INBOX_SIZE):  # later items are for the next step
            try:
                item = self._items.get(timeout=wait_s) if wait_s else self._items.get_nowait()
            except queue.Empty:
                return
            wait_s = 0.0
            if isinstance(item, zenoh.Query):
                self._query_slots.release()
            yield item

    def hear(self, wait_s: float, pool: ThreadPoolExecutor) -> Heard:
        """Return new messages and changes, and query the cars that arrived.

        Wait at most `wait_s` for the first message.
        """
        items = list(self.items(wait_s))
        now, wall_s, changes = time.monotonic(), time.time(), self.gateways()
        self.query_arrived(changes, pool, began=True)
        samples: list[tuple[Sample, float | None]] = []
        for item in items:
            if isinstance(item, QueriedSample):
                samples.append((item.sample, wall_s))
            elif isinstance(item, Sample):
                samples.append((item, None))
        return Heard(now, changes, samples)

    def gateways(self) -> Mapping[str, bool]:
        """Return the cars whose gateways arrived (True) or left since the last call."""
        return self._tokens.take()

    def query_arrived(self, changes: Mapping[str, bool], pool: ThreadPoolExecutor, *, began: bool) -> None:
        """Query the states of the cars that arrived. Before the plan `began`, all cars are queried anyway."""
        for car, alive in changes.items():
            if alive and began:
                self._arrived.add(car)
            elif not alive:
                self._arrived.discard(car)
        self._state_queries = [each for each in self._state_queries if not each.done()]
        if self._arrived and len(self._state_queries) < _MAX_STATE_QUERIES_AT_ONCE:
            cars, self._arrived = sorted(self._arrived), set()
            self._state_queries += [
                pool.submit(self.query_states, car)
                for car in (cars if len(cars) <= _MAX_CARS_QUERIED_SINGLY else ["*"])
            ]

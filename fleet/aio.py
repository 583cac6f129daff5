"""Fleet and Car for asyncio: the client of client.py with the same names, each call to be awaited.

The blocking calls run in threads; a watch is an asynchronous iterator fed through a bounded hand-over.
"""

import asyncio
import weakref
from collections.abc import Callable, Coroutine, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from types import TracebackType
from typing import Any, Final, ParamSpec, Self, TypeVar

from fleet.client import client
from fleet.client import lease as leases
from fleet.client.commands import CarCommands, CommandRequest
from fleet.client.condition import KeyCondition
from fleet.client.outcome import Outcome
from fleet.client.reading import QUEUE_LIMIT, Reading, Wanted, reading_of
from fleet.client.wait import ConditionWait
from schemas import keys, messages
from schemas.bus import Handover, Sample

_THREADS: Final = 256
"""Calls that may wait at the same time: a drive waits until it is over, and no stop may wait for a free thread."""
P = ParamSpec("P")
T = TypeVar("T")


class Fleet:
    """`async with Fleet() as fleet`; see fleet.client.client.Fleet for what each does and raises."""

    def __init__(
        self,
        endpoint: str | None = None,
        name: str = keys.DEFAULT_FLEET,
        *,
        sender: str | None = None,
        kind: str = "script",
        start_hub: bool = False,
    ) -> None:
        self._open = lambda: client.Fleet(endpoint, name, sender=sender, kind=kind, start_hub=start_hub)
        self._client: client.Fleet | None = None
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="fleet-aio")

    async def __aenter__(self) -> Self:
        self._client = await self.call(self._open)
        return self

    async def __aexit__(self, *_: object) -> None:
        for watch in list(self._watches):
            watch.close()
        await self.call(self.sync.close)
        self._threads.shutdown(wait=False)

    async def call(self, function: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """What a blocking call returns or raises; in a thread, where it runs on if the task is cancelled."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(function, *args, **options))

    @property
    def sync(self) -> client.Fleet:
        """The client underneath."""
        if self._client is None:
            raise RuntimeError("use the fleet inside `async with`")
        return self._client

    async def cars(self) -> list[str]:
        """The cars whose gateway is on the bus."""
        return await self.call(self.sync.cars)

    def car(self, name: str) -> "Car":
        """One car, there or not."""
        return Car(self, keys.check_name(name))

    async def get(self, expression: str) -> list[Reading]:
        """The latest value under every key that matches."""
        return await self.call(self.sync.get, expression)

    async def history(self, expression: str, *, last: int | None = None, since_s: float | None = None) -> list[Reading]:
        """The last so many values of every key that matches, or of the last so many seconds; each oldest first."""
        return await self.call(self.sync.history, expression, last=last, since_s=since_s)

    def watch(self, expression: str, *, when: str | None = None) -> "Watch":
        """Readings as they are published: `async for reading in fleet.watch("*/sensor/range")`; as `when` says.

        Use it with `async with` if the fleet stays open longer: it takes readings until it, or the fleet, is closed.
        """
        written = self.sync.expression(expression)
        watch = Watch(None if when is None else KeyCondition.of(when, written).holds)
        watch.begin(self.sync.bus.subscribe(written, watch.hand_over).undeclare)
        self._watches.add(watch)
        return watch

    async def wait(self, expression: str, when: str, *, timeout_s: float | None = None, for_s: float = 0.0) -> Reading:
        """Wait until `when` holds of a fresh reading, and return that; raises waiting.NotInTime."""
        written = self.sync.expression(expression)
        waiting = ConditionWait(KeyCondition.of(when, written), for_s)
        try:
            async with asyncio.timeout(timeout_s), self.watch(expression) as stream:
                for reading in await self.get(expression):
                    if waiting.ends(reading, datetime.now(UTC)):
                        return reading
                async for reading in stream:
                    if waiting.ends(reading, datetime.now(UTC)):
                        return reading
        except TimeoutError:
            pass
        raise waiting.late(written, timeout_s or 0.0, datetime.now(UTC))

    async def stop(self, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Stop these cars, or every car."""
        return await self.call(self.sync.stop, cars)

    async def estop(self, cars: Iterable[str] | None = None, why: str = "") -> list[Outcome]:
        """Emergency stop of these cars, or of the fleet."""
        return await self.call(self.sync.estop, cars, why)

    async def resume(self, cars: Iterable[str], ids: Sequence[str] = ()) -> list[Outcome]:
        """End the e-stops of these ids; without ids, the hold."""
        return await self.call(self.sync.resume, cars, ids)

    async def ask(self, request: CommandRequest, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Ask the cars and wait for what becomes of it."""
        return await self.call(self.sync.ask, request, cars)


class Car(CarCommands[Coroutine[Any, Any, Outcome]]):
    """One car of a Fleet: `await fleet.car("red").drive("forward", 2.0)`. Made by `Fleet.car`."""

    def __init__(self, fleet: Fleet, name: str, leased: client.LeasedCar | None = None) -> None:
        super().__init__(name)
        self._fleet = fleet
        self._leased = leased

    async def get(self, topic: str = "sensor/*") -> list[Reading]:
        """The latest readings of this car."""
        return await self._fleet.get(f"{self.name}/{topic}")

    def lease(self, *, take: bool = False) -> "Lease":
        """Have the car while a block runs: `async with fleet.car("red").lease() as car: await car.drive("forward")`.

        As fleet.client.client.Car.lease; a task that is cancelled stops the car, too.
        """
        return Lease(self._fleet, self.name, take=take)

    async def do(self, request: CommandRequest) -> Outcome:
        """Ask for one command and say what became of it."""
        return await self._fleet.call((self._leased or self._fleet.sync.car(self.name)).do, request)


class Lease:
    """Made by `Car.lease`; use it with `async with`, which raises LeaseLost if the car is another's."""

    def __init__(self, fleet: Fleet, name: str, *, take: bool) -> None:
        self._fleet = fleet
        self._name = name
        self._lease = leases.Lease(fleet.sync, name, take=take)

    async def __aenter__(self) -> Car:
        entering = asyncio.ensure_future(self._fleet.call(self._lease.__enter__))
        try:
            return Car(self._fleet, self._name, await asyncio.shield(entering))
        except asyncio.CancelledError:
            await entering
            await self.__aexit__(None, None, None)
            raise

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await asyncio.shield(self._fleet.call(self._lease.__exit__, kind, error, trace))


class Watch:
    """Readings as they come. `async for`; `close` (or `async with`) ends it. Who reads too slowly loses the oldest."""

    def __init__(self, wanted: Wanted | None = None) -> None:
        self._wanted = wanted
        self._waiting: asyncio.Queue[Sample | None] = asyncio.Queue(QUEUE_LIMIT)
        self._closed = False
        self._undeclare: Callable[[], object] = lambda: None
        self.hand_over: Handover[Sample] = Handover(asyncio.get_running_loop(), self._take, limit=QUEUE_LIMIT)
        self._full = 0
        self.unreadable = 0
        """Samples that are no message of ours."""

    @property
    def dropped(self) -> int:
        """Samples that made room for newer ones, or came while the loop stood still."""
        return self._full + self.hand_over.dropped

    def begin(self, undeclare: Callable[[], object]) -> None:
        """It is subscribed; `undeclare` is called at the end."""
        self._undeclare = undeclare

    def close(self) -> None:
        """End the stream; the iteration stops."""
        if not self._closed:
            self._closed = True
            self._undeclare()
            self._put(None)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        while not self._closed:
            sample = await self._waiting.get()
            if sample is None:
                break
            try:
                reading = reading_of(sample)
            except (messages.BadPayload, KeyError):
                self.unreadable += 1
                continue
            if self._wanted is None or self._wanted(reading):
                return reading
        raise StopAsyncIteration

    def _take(self, sample: Sample) -> None:
        self._full += self._put(sample)

    def _put(self, sample: Sample | None) -> bool:
        """Whether the oldest made room."""
        full = self._waiting.full()
        if full:
            self._waiting.get_nowait()
        self._waiting.put_nowait(sample)
        return full

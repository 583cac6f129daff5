"""Fleet and Car for asyncio, with the same names as in `fleet.client`, but as coroutines.

The blocking calls run in threads. A watch is an asynchronous iterator with a bounded queue.
"""

import asyncio
import time
import weakref
from collections.abc import Callable, Coroutine, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from types import TracebackType
from typing import Any, Final, ParamSpec, Self, TypeVar

from fleet.client import client
from fleet.client.commands import (
    CarCommands,
    CommandRequest,
    end_loan_request,
    estop_request,
    lend_request,
    pause_request,
    plain_request,
    resume_request,
    stop_request,
)
from fleet.client.condition import KeyCondition, check_car, check_key
from fleet.client.outcome import Outcome
from fleet.client.reading import READING_QUEUE_LIMIT, Reading, ReadingFilter, reading_of
from fleet.client.wait import ConditionWait
from schemas import keys, messages
from schemas.bus import Handover, Sample
from schemas.commands import Verb
from schemas.words import Rank, Scope

_THREADS: Final = 256
"""Maximum number of concurrent calls. A drive blocks its thread until the drive ends."""
P = ParamSpec("P")
T = TypeVar("T")


class Fleet:
    """The asyncio twin of fleet.client.client.Fleet: `async with Fleet() as fleet`."""

    def __init__(
        self,
        endpoint: str | None = None,
        name: str = keys.DEFAULT_FLEET,
        *,
        person: str | None = None,
        sender: str | None = None,
        kind: str = Rank.SCRIPT.value,
        start_hub: bool = False,
        identity: str = "",
    ) -> None:
        self._open = partial(
            client.Fleet,
            endpoint,
            name,
            person=person,
            sender=sender,
            kind=kind,
            start_hub=start_hub,
            identity=identity,
        )
        self._client: client.Fleet | None = None
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="fleet-aio")
        self._closed = False

    async def __aenter__(self) -> Self:
        if self._closed:
            raise client.closed_error()
        opening = self._threads.submit(self._open)
        try:
            self._client = await asyncio.wrap_future(opening)
        except asyncio.CancelledError:  # the thread goes on
            opening.add_done_callback(_close_opened)
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        for watch in list(self._watches):
            watch.close()
        closing = asyncio.get_running_loop().run_in_executor(None, self.sync.close)  # ours may all be busy
        self._closed = True
        self._threads.shutdown(wait=False)
        await asyncio.shield(closing)

    async def call(self, function: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Run a blocking call in a thread. If the task is cancelled, a call that has begun still runs to its end.

        Raises BusError if this Fleet is closed.
        """
        if self._closed:  # the error of the executor does not help
            raise client.closed_error()
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(function, *args, **options))

    @property
    def sync(self) -> client.Fleet:
        """The blocking client."""
        if self._client is None:
            raise RuntimeError("use the fleet inside `async with`")
        return self._client

    async def cars(self) -> list[str]:
        """Return the names of the cars whose gateway is on the bus."""
        return await self.call(self.sync.cars)

    def car(self, name: str) -> "Car":
        """Return a car, whether or not it is on the bus."""
        return Car(self, check_car(name))

    async def get(self, expression: str) -> list[Reading]:
        """Return the latest value of every matching key."""
        return await self.call(self.sync.get, expression)

    async def history(self, expression: str, *, last: int | None = None, since_s: float | None = None) -> list[Reading]:
        """Return the newest `last` values of every matching key, or those of the last `since_s` seconds.

        With both, return the newest `last` values of that time.
        """
        return await self.call(self.sync.history, expression, last=last, since_s=since_s)

    def watch(self, expression: str, *, when: str | None = None) -> "Watch":
        """Subscribe to readings: `async for reading in fleet.watch("*/sensor/range")`.

        If the fleet stays open longer than you need the watch, use the watch with `async with`. Otherwise it receives
        readings until the fleet is closed. Raises conditions.BadExpression.
        """
        key_expression = check_key(self.sync.expression(expression))
        self.sync.check_open()
        watch = Watch(None if when is None else KeyCondition.of(when, key_expression).holds)
        watch.begin(self.sync.bus.subscribe(key_expression, watch.hand_over).undeclare)
        self._watches.add(watch)
        return watch

    async def wait(self, expression: str, when: str, *, timeout_s: float | None = None, for_s: float = 0.0) -> Reading:
        """Wait until the condition `when` is true for a fresh reading, and return it.

        Raises wait.NotInTime, conditions.BadExpression, and BusError if this Fleet is closed meanwhile.
        """
        key_expression = self.sync.expression(expression)
        waiting = ConditionWait(KeyCondition.of(when, key_expression), for_s)
        try:
            # The current reading counts, too, however short the wait is.
            at_least_s = None if timeout_s is None else max(client.MIN_QUERY_TIMEOUT_S, timeout_s)
            async with asyncio.timeout(at_least_s), self.watch(expression) as stream:
                for reading in await self.get(expression):
                    if waiting.ends(reading, datetime.now(UTC)):
                        return reading
                async for reading in stream:
                    if waiting.ends(reading, datetime.now(UTC), time.monotonic()):
                        return reading
        except TimeoutError:
            raise waiting.timeout_error(key_expression, timeout_s or 0.0, datetime.now(UTC)) from None
        raise client.closed_error()

    async def publish_pose(
        self,
        car: str,
        *,
        x_m: float,
        y_m: float,
        heading_rad: float,
        frame: str = "map",
        at: datetime | None = None,
        xy_std_m: float | None = None,
        heading_std_rad: float | None = None,
    ) -> None:
        """Publish where a car is, as this program has measured it from outside: `sensor/pose`."""
        publish, stds = self.sync.publish_pose, {"xy_std_m": xy_std_m, "heading_std_rad": heading_std_rad}
        await self.call(partial(publish, car, x_m=x_m, y_m=y_m, heading_rad=heading_rad, frame=frame, at=at, **stds))

    async def stop(self, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Stop these cars, or every car."""
        return await self.ask(stop_request(), cars)

    async def estop(self, cars: Iterable[str] | None = None, why: str = "") -> list[Outcome]:
        """E-stop these cars, or the fleet."""
        return await self.ask(estop_request(why, Scope.FLEET if cars is None else Scope.CAR), cars)

    async def resume(
        self, cars: Iterable[str] | None, ids: Sequence[str] = (), *, everything: bool = False
    ) -> list[Outcome]:
        """End the e-stops with these ids. Without ids, end the hold that a stop left.

        If `cars` is None, do so for every car.
        """
        return await self.ask(resume_request(ids, everything=everything), cars)

    async def pause(self, why: str = "") -> list[Outcome]:
        """Stop every car, and let only leads move cars until `unpause`."""
        return await self.ask(pause_request(why))

    async def unpause(self) -> list[Outcome]:
        """End the pause of the fleet. This does not move a car."""
        return await self.ask(plain_request(Verb.UNPAUSE))

    async def lend(self, cars: Iterable[str], to: str, duration_s: float) -> list[Outcome]:
        """Lend these cars to a person. For `duration_s`, only that person and leads can drive them."""
        return await self.ask(lend_request(to, duration_s), cars)

    async def end_loan(self, cars: Iterable[str]) -> list[Outcome]:
        """End the loan of these cars, and stop those that the borrower drives."""
        return await self.ask(end_loan_request(), cars)

    async def ask(self, request: CommandRequest, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Send a command to the cars and return their outcomes.

        The command is sent at once, even if all threads are busy.
        """
        return await self.call(self.sync.outcomes, self.sync.send(request, cars))


def _close_opened(opening: "Future[client.Fleet]") -> None:
    """Close the client of an `async with` whose task was cancelled while the client was opened."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()


class Car(CarCommands[Coroutine[Any, Any, Outcome]]):
    """One car of a Fleet: `await fleet.car("red").drive("forward", 2.0)`. Made by `Fleet.car`."""

    def __init__(self, fleet: Fleet, name: str, leased: client.LeasedCar | None = None) -> None:
        super().__init__(name)
        self._fleet = fleet
        self._leased = leased

    async def get(self, topic: str = "sensor/*") -> list[Reading]:
        """Return the latest readings of this car."""
        return await self._fleet.get(f"{self.name}/{topic}")

    def lease(self, *, take: bool = False) -> "Lease":
        """Reserve the car for a block: `async with fleet.car("red").lease() as car: await car.drive("forward")`.

        See fleet.client.client.Car.lease. Cancelling the task stops the car, too.
        """
        return Lease(self._fleet, self.name, take=take)

    async def do(self, request: CommandRequest) -> Outcome:
        """Send one command and return its outcome."""
        if self._leased is not None:
            return await self._fleet.call(self._leased.do, request)
        return (await self._fleet.ask(request, [self.name]))[0]


class Lease:
    """The lease of a car, from `Car.lease`. Use it with `async with`.

    Raises NotCarriedOut if the car cannot be reserved, and LeaseLost (a NotCarriedOut) if another client has it.
    """

    def __init__(self, fleet: Fleet, name: str, *, take: bool) -> None:
        self._fleet = fleet
        self._name = name
        self._lease = fleet.sync.car(name).lease(take=take)

    async def __aenter__(self) -> Car:
        entering = asyncio.ensure_future(self._fleet.call(self._lease.__enter__))
        try:
            return Car(self._fleet, self._name, await asyncio.shield(entering))
        except asyncio.CancelledError as cancelled:
            await asyncio.shield(self._undo(entering, cancelled))
            raise

    async def _undo(self, entering: asyncio.Future[client.LeasedCar], cancelled: BaseException) -> None:
        """End the lease of a block whose task was cancelled on the way into it."""
        with suppress(Exception):  # without a lease there is nothing to end, and the cancellation goes on
            await entering
            await self.__aexit__(type(cancelled), cancelled, None)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await asyncio.shield(self._fleet.call(self._lease.__exit__, kind, error, trace))


class Watch:
    """A stream of readings for `async for`, ended by `close` or `async with`. A full queue drops the oldest samples."""

    def __init__(self, accept: ReadingFilter | None = None) -> None:
        self._accept = accept
        self._queue: asyncio.Queue[Sample | None] = asyncio.Queue(READING_QUEUE_LIMIT)
        self._closed = False
        self._undeclare: Callable[[], object] = lambda: None
        self.hand_over: Handover[Sample] = Handover(
            asyncio.get_running_loop(), self._on_sample, limit=READING_QUEUE_LIMIT
        )
        self._dropped = 0
        self.unreadable = 0
        """Number of samples that are not messages of ours."""

    @property
    def dropped(self) -> int:
        """Number of samples dropped from the full queue, or while the loop was blocked."""
        return self._dropped + self.hand_over.dropped

    def begin(self, undeclare: Callable[[], object]) -> None:
        """Store the function that ends the subscription."""
        self._undeclare = undeclare

    def close(self) -> None:
        """End the stream and its iteration."""
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
            sample = await self._queue.get()
            if sample is None:
                break
            try:
                reading = reading_of(sample)
            except (messages.BadPayload, KeyError):
                self.unreadable += 1
                continue
            if self._accept is None or self._accept(reading):
                return reading
        raise StopAsyncIteration

    def _on_sample(self, sample: Sample) -> None:
        self._dropped += self._put(sample)

    def _put(self, sample: Sample | None) -> bool:
        """Queue a sample. Return True if the oldest one was dropped."""
        full = self._queue.full()
        if full:
            self._queue.get_nowait()
        self._queue.put_nowait(sample)
        return full

"""Fleet and Car for asyncio: the client of client.py with the same names, each call to be awaited.

The blocking calls run in threads; a watch is an asynchronous iterator fed through a bounded hand-over.
"""

import asyncio
from collections.abc import AsyncIterator, Coroutine, Iterable, Sequence
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any, Self

from fleet import client
from fleet.condition import Condition
from fleet.outcome import Outcome
from fleet.readings import QUEUE_LIMIT, Reading, Wanted, reading_of
from fleet.verbs import Request, Verbs
from fleet.waiting import Waiting
from schemas import keys, messages
from schemas.bus import Handover, Sample


class Fleet:
    """`async with Fleet() as fleet`; see fleet.client.Fleet for what each does and raises."""

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

    async def __aenter__(self) -> Self:
        self._client = await asyncio.to_thread(self._open)
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self.sync.close)

    @property
    def sync(self) -> client.Fleet:
        """The client underneath."""
        if self._client is None:
            raise RuntimeError("use the fleet inside `async with`")
        return self._client

    async def cars(self) -> list[str]:
        """The cars whose gateway is on the bus."""
        return await asyncio.to_thread(self.sync.cars)

    def car(self, name: str) -> "Car":
        """One car, there or not."""
        return Car(self, keys.check_name(name))

    async def get(self, expression: str) -> list[Reading]:
        """The latest value under every key that matches."""
        return await asyncio.to_thread(self.sync.get, expression)

    async def history(self, expression: str, *, last: int | None = None, since_s: float | None = None) -> list[Reading]:
        """The last so many values of every key that matches, or of the last so many seconds; each oldest first."""
        return await asyncio.to_thread(self.sync.history, expression, last=last, since_s=since_s)

    @asynccontextmanager
    async def watch(self, expression: str, *, when: str | None = None) -> AsyncIterator["Watch"]:
        """Readings as they are published: `async with fleet.watch("red") as stream: async for reading in stream`.

        Only those of which `when` holds, if it is given.
        """
        written = self.sync.expression(expression)
        stream = Watch(None if when is None else Condition.of(when, written).holds)
        subscriber = self.sync.bus.subscribe(written, stream.hand_over)
        try:
            yield stream
        finally:
            await asyncio.to_thread(subscriber.undeclare)

    async def wait(self, expression: str, when: str, *, timeout_s: float | None = None, for_s: float = 0.0) -> Reading:
        """Wait until `when` holds of a fresh reading, and return that; raises waiting.NotInTime."""
        written = self.sync.expression(expression)
        waiting = Waiting(Condition.of(when, written), for_s)
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
        return await asyncio.to_thread(self.sync.stop, cars)

    async def estop(self, cars: Iterable[str] | None = None, why: str = "") -> list[Outcome]:
        """Emergency stop of these cars, or of the fleet."""
        return await asyncio.to_thread(self.sync.estop, cars, why)

    async def resume(self, cars: Iterable[str], ids: Sequence[str] = ()) -> list[Outcome]:
        """End the e-stops of these ids; without ids, the hold."""
        return await asyncio.to_thread(self.sync.resume, cars, ids)

    async def ask(self, request: Request, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Ask the cars and wait for what becomes of it."""
        return await asyncio.to_thread(self.sync.ask, request, cars)


class Car(Verbs[Coroutine[Any, Any, Outcome]]):
    """One car of an Fleet: `await fleet.car("red").drive("forward", 2.0)`."""

    def __init__(self, fleet: Fleet, name: str) -> None:
        super().__init__(name)
        self._fleet = fleet

    async def get(self, topic: str = "sensor/*") -> list[Reading]:
        """The latest readings of this car."""
        return await self._fleet.get(f"{self.name}/{topic}")

    async def _do(self, request: Request) -> Outcome:
        return (await self._fleet.ask(request, [self.name]))[0]


class Watch:
    """Readings as they come; a reader that is too slow loses the oldest."""

    def __init__(self, wanted: Wanted | None = None) -> None:
        self._wanted = wanted
        self._waiting: asyncio.Queue[Sample] = asyncio.Queue(QUEUE_LIMIT)
        self.hand_over: Handover[Sample] = Handover(asyncio.get_running_loop(), self._take, limit=QUEUE_LIMIT)
        self._full = 0
        self.unreadable = 0
        """Samples that are no message of ours."""

    @property
    def dropped(self) -> int:
        """Samples that made room for newer ones, or came while the loop stood still."""
        return self._full + self.hand_over.dropped

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        while True:
            try:
                reading = reading_of(await self._waiting.get())
            except (messages.BadPayload, KeyError):
                self.unreadable += 1
                continue
            if self._wanted is None or self._wanted(reading):
                return reading

    def _take(self, sample: Sample) -> None:
        if self._waiting.full():
            self._waiting.get_nowait()
            self._full += 1
        self._waiting.put_nowait(sample)

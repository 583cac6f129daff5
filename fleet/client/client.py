"""Fleet and Car: the operator's side of the bus, for scripts, the command line, the console and the coordinator.

Asks and waits. What a command is lies in verbs.py, what became of it in outcome.py; the same for asyncio is aio.py.
"""

import getpass
import logging
import os
import queue
import re
import socket
import time
import uuid
import weakref
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, Final, Self

from fleet.client import history
from fleet.client.command_tracker import ANSWER_S, CLOSED, PendingCommand, PresenceChange, QueryEnded
from fleet.client.commands import CarCommands, CommandRequest, estop_request, resume_request, stop_request
from fleet.client.condition import KeyCondition
from fleet.client.lease import Lease
from fleet.client.outcome import LATEST_ANSWER_S, Outcome
from fleet.client.reading import Reading, Watch, reading_of
from fleet.client.wait import ConditionWait
from schemas import keys, messages, topics
from schemas.bus import Bus, Failure, Sample, canon
from schemas.topics import Qos

_EVENT: Final = topics.TOPICS["event/command"].message
_FOREVER_S: Final = 3600.0
"""One look of a wait without a time-out."""
_SHORTEST_S: Final = 0.1
"""However short a wait is, the current value is asked for."""

log = logging.getLogger("fleet")


def default_sender() -> str:
    """Who asks, in one key chunk: user@host-pid."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError, ImportError):  # no entry for this user id, as in some containers; no pwd (Windows)
        user = "user"
    return re.sub(r"[^A-Za-z0-9_.@-]", "-", f"{user}@{socket.gethostname()}-{os.getpid()}").lstrip("@")


class Fleet:
    """One operator on the bus; use it with `with`. Its methods may be called from several threads.

    `endpoint`: `tcp/HOST:PORT` of the bus; else FLEET_ENDPOINT, else loopback port 7447. `name`: of the fleet.
    `sender`: who asks, as others are told; else user@host-pid. `kind`: `script`, `person` (outranks scripts) or
    `coordinator`.

    While it is open it holds the token `<fleet>/@operator/<sender>`: when that is lost, gateways stop what it drives.
    Raises schemas.bus.BusError if there is no fleet, keys.BadKey for a bad name.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        name: str = keys.DEFAULT_FLEET,
        *,
        sender: str | None = None,
        kind: str = "script",
        start_hub: bool = False,
    ) -> None:
        self.name = keys.check_name(name, "fleet name")
        self.sender = sender or default_sender()
        self.kind = kind
        token = keys.operator_token(self.name, self.sender)
        self.bus = Bus.open(endpoint, start_hub=start_hub)
        self._askings: dict[str, PendingCommand] = {}
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()
        self._pool = ThreadPoolExecutor(max_workers=32, thread_name_prefix="fleet-ask")
        self.dropped = 0
        """Command events that were lost because nobody took them in time."""
        try:
            self.bus.token(token)
            self.bus.subscribe(keys.topic_key(self.name, "*", "event/command"), self._event)
            self.bus.watch_tokens(keys.car_token(self.name, "*"), self._gateway)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus; what is still waited for ends as not known, and every watch ends."""
        for watch in list(self._watches):
            watch.close()
        for asking in list(self._askings.values()):
            asking.inbox.put((time.monotonic(), CLOSED))
        self._pool.shutdown(wait=False, cancel_futures=True)
        self.bus.close()  # ends every query that is on its way
        self._pool.shutdown()

    # ------------------------------------------------------------------ reading

    def cars(self) -> list[str]:
        """The cars whose gateway is on the bus, by name."""
        return [token.rpartition("/")[2] for token in self.bus.tokens(keys.car_token(self.name, "*"))]

    def car(self, name: str) -> "Car":
        """One car, there or not; raises keys.BadKey for a bad name."""
        return Car(self, keys.check_name(name))

    def expression(self, expression: str) -> str:
        """A short form (`red`, `*/sensor/battery`) written out; raises keys.BadKey."""
        return canon(keys.expand(expression, self.name))

    def get(self, expression: str) -> list[Reading]:
        """The latest value under every key that matches, sorted by key; short forms as on the command line."""
        return self._read(self.expression(expression), ANSWER_S)

    def history(self, expression: str, *, last: int | None = None, since_s: float | None = None) -> list[Reading]:
        """The last so many values of every key that matches, or those of the last so many seconds, or both.

        Sorted by key, each key's oldest first. A gateway keeps 1500 of each reading and the latest of each state:
        `history.shortfalls` says what is missing. Raises ValueError.
        """
        selector = history.selector(self.expression(expression), last=last, since_s=since_s)
        found: list[Reading] = []
        for _ in range(history.TRIES):
            found = history.united(found, self._read(selector, history.ANSWER_S), last)
            if not history.gaps(found):
                break
        return found

    def _read(self, selector: str, timeout_s: float) -> list[Reading]:
        written = selector.partition("?")[0]
        if "@cmd" in written.split("/"):
            raise keys.BadKey(f"{written} is a command, not a reading: a query of it would be carried out")
        found = []
        for answer in self.bus.query(selector, timeout_s=timeout_s, qos=Qos.STATE):
            if isinstance(answer, Failure):
                log.warning("not every gateway answered: %s", answer.words)
                continue
            try:
                found.append(reading_of(answer))
            except (messages.BadPayload, KeyError) as error:
                log.warning("%s: an answer that is no message of this fleet: %s", answer.key, error)
        return sorted(found, key=lambda reading: reading.key)

    def watch(self, expression: str, *, when: str | None = None) -> Watch:
        """Readings as they are published: `for reading in fleet.watch("*/sensor/range")`, if `when` holds of them.

        Use it with `with` if the fleet stays open longer: it takes readings until it, or the fleet, is closed.

        `when` is about the fields of one message, as `range_m < 0.3`; raises expression.BadExpression.
        """
        written = self.expression(expression)
        wanted = None if when is None else KeyCondition.of(when, written).holds

        def subscribe(take: Callable[[Sample], None]) -> Callable[[], object]:
            return self.bus.subscribe(written, take).undeclare

        watch = Watch(wanted).begin(subscribe)
        self._watches.add(watch)
        return watch

    def wait(self, expression: str, when: str, *, timeout_s: float | None = None, for_s: float = 0.0) -> Reading:
        """Wait until `when` holds of a fresh reading, the current one included, and return that.

        `for_s`: it must have held of every reading for so long, by their stamps. Raises waiting.NotInTime (a
        TimeoutError) after `timeout_s` (None: never), and expression.BadExpression.
        """
        written = self.expression(expression)
        waiting = ConditionWait(KeyCondition.of(when, written), for_s)
        began = time.monotonic()

        def left_s() -> float:
            return _FOREVER_S if timeout_s is None else began + timeout_s - time.monotonic()

        with self.watch(expression) as stream:  # before the current values are asked for: nothing falls between
            for reading in self._read(written, max(_SHORTEST_S, min(ANSWER_S, left_s()))):
                if waiting.ends(reading, datetime.now(UTC)):
                    return reading
            while (left := left_s()) > 0:
                coming = stream.within(left)
                if coming is not None and waiting.ends(coming, datetime.now(UTC)):
                    return coming
        raise waiting.late(written, timeout_s or 0.0, datetime.now(UTC))

    # ------------------------------------------------------------------ commands

    def stop(self, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Stop these cars; without an argument every car, with one query."""
        return self.ask(stop_request(), cars)

    def estop(self, cars: Iterable[str] | None = None, why: str = "") -> list[Outcome]:
        """Emergency stop of these cars; without an argument of the whole fleet."""
        return self.ask(estop_request(why, "fleet" if cars is None else "car"), cars)

    def resume(self, cars: Iterable[str], ids: Sequence[str] = ()) -> list[Outcome]:
        """End the e-stops of these ids; without ids, the hold."""
        return self.ask(resume_request(ids), cars)

    def ask(self, request: CommandRequest, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Ask the cars (None: all, with one wildcard query), wait, and say for each what became of it.

        A car that is missing or silent has an outcome of its own and keeps none of the others waiting to be asked.
        """
        named = None if cars is None else list(dict.fromkeys(keys.check_name(car) for car in cars))
        message, command_id = self._filled(request)
        asking = PendingCommand(request, self.cars(), named, lambda: self.bus.hubs)
        self._askings[command_id] = asking
        try:
            payload = message.SerializeToString()
            futures = [self._pool.submit(self._query, target, asking, payload) for target in asking.targets]
            asking.wait()
            for future in futures:
                if future.done():
                    future.result()
        finally:
            del self._askings[command_id]
        return asking.outcomes()

    def _filled(self, request: CommandRequest) -> tuple[Any, str]:
        message = type(request.message)()
        message.CopyFrom(request.message)
        message.id = uuid.uuid4().hex
        message.sender = self.sender
        message.kind = self.kind
        message.take = request.take
        message.asked.seconds, message.asked.nanos = divmod(time.time_ns(), 1_000_000_000)
        return message, message.id

    def _query(self, target: str, asking: PendingCommand, payload: bytes) -> None:
        """Ask one car, or all; on a thread of the pool."""
        verb = asking.request.verb
        words = f"{target} gave no answer: its gateway went away or failed"
        try:
            answers = self.bus.query(
                keys.command_key(self.name, target, verb),
                payload=payload,
                encoding=messages.encoding_of(topics.COMMANDS[verb]),
                timeout_s=LATEST_ANSWER_S,
            )
            for answer in answers:
                if isinstance(answer, Sample):
                    asking.inbox.put((time.monotonic(), answer))
                else:
                    words = "" if answer.words == "Timeout" else answer.words
        finally:
            asking.inbox.put((time.monotonic(), QueryEnded(target, words)))

    def _gateway(self, token: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """A car's gateway came or went; on a Zenoh thread."""
        car = token.rpartition("/")[2]
        for asking in list(self._askings.values()):
            if asking.concerns(car):
                with suppress(queue.Full):
                    asking.inbox.put_nowait((time.monotonic(), PresenceChange(car, alive=alive)))

    def _event(self, sample: Sample) -> None:
        """A record of some command of somebody; on a Zenoh thread."""
        try:
            event: Any = messages.parse(_EVENT, sample.payload, sample.encoding)
        except messages.BadPayload as error:
            log.warning("%s: not a command event: %s", sample.key, error)
            return
        asking = self._askings.get(event.id)
        if asking is None:
            return
        try:
            asking.inbox.put_nowait((time.monotonic(), event))
        except queue.Full:
            self.dropped += 1


class Car(CarCommands[Outcome]):
    """One car of a Fleet: `fleet.car("red").drive("forward", 2.0)`. Made by `Fleet.car`."""

    def __init__(self, fleet: Fleet, name: str) -> None:
        super().__init__(name)
        self._fleet = fleet

    def get(self, topic: str = "sensor/*") -> list[Reading]:
        """The latest readings of this car."""
        return self._fleet.get(f"{self.name}/{topic}")

    def lease(self, *, take: bool = False) -> Lease:
        """Have the car while a block runs: `with fleet.car("red").lease() as car: car.drive("forward", 1.5)`.

        When the block ends, however it does, the car is stopped and given back. In it nobody of the same rank drives
        the car, and a command that is not carried out raises NotCarriedOut; once another has taken or stopped the car,
        every command raises LeaseLost. Entering raises them, too. `take`: as a person (`Fleet(kind="person")`), also
        from another person.
        """
        return Lease(self._fleet, self.name, take=take)

    def do(self, request: CommandRequest) -> Outcome:
        """Ask for one command and say what became of it."""
        return self._fleet.ask(request, [self.name])[0]


class LeasedCar(Car):
    """A car within `with fleet.car("red").lease() as car`: what is not carried out raises."""

    def __init__(self, fleet: Fleet, name: str, lease: Lease) -> None:
        super().__init__(fleet, name)
        self._lease = lease

    def do(self, request: CommandRequest) -> Outcome:
        """Ask for one command; raises NotCarriedOut, or LeaseLost once another has the car."""
        self._lease.check()
        return self._lease.checked(super().do(request))

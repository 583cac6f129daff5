"""Fleet and Car: the operator's side of the bus, for scripts, the command line and the coordinator.

`commands` makes the requests, `outcome` decides on their results. `fleet.aio` is the same for asyncio.
"""

import getpass
import logging
import os
import queue
import re
import socket
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from math import inf
from typing import Any, Final, Self

from fleet.client import history_query
from fleet.client.command_tracker import (
    ANSWER_TIMEOUT_S,
    CLOSED,
    PendingCommand,
    PresenceChange,
    QueryEnded,
    SupervisedCars,
)
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
from fleet.client.hub_ended import explain_no_fleet
from fleet.client.job_threads import JobThreads
from fleet.client.lease import Lease
from fleet.client.outcome import OVERLOAD_ANSWER_TIMEOUT_S, Outcome, Until
from fleet.client.pose import pose_message
from fleet.client.reading import Reading, Watch, reading_of
from fleet.client.supervision import ask_status, gateways_of
from fleet.client.wait import ConditionWait
from schemas import keys, messages, topics
from schemas.bus import Bus, BusError, Failure, NoFleet, Publisher, Sample, canon
from schemas.commands import COMMANDS, Verb
from schemas.identity import IdentityRole, may_locate
from schemas.identity import parse as parse_identity
from schemas.process import json_log
from schemas.topics import Qos
from schemas.words import Phase, Rank, RunState, Scope

_EVENT: Final = topics.TOPICS["event/command"].message
_MAX_STOP_THREADS: Final = 1024
"""Maximum number of threads for the queries of stops. Each query waits on its own thread. A stop of all cars makes two
queries: to the gateways and to the supervisor."""
MIN_QUERY_TIMEOUT_S: Final = 0.1
"""Minimum timeout of the query for the current values, even if the wait itself is shorter."""

log = logging.getLogger("fleet")
command_log = logging.getLogger(json_log.COMMANDS)


def default_sender(person: str | None = None) -> str:
    """Return the default name of a sender: person@host-pid.

    The person is `person`, else FLEET_AS, else the user's login.

    Raises keys.BadKey for a bad name of a person.
    """
    person = person or os.environ.get("FLEET_AS")
    try:
        user = keys.check_name(person, "person") if person else getpass.getuser()
    except (KeyError, OSError, ImportError):  # a container without this user id, or Windows, which has no pwd
        user = "user"
    return re.sub(r"[^A-Za-z0-9_.@-]", "-", f"{user}@{socket.gethostname()}-{os.getpid()}").lstrip("@")


def certified_sender(identity: str, sender: str | None = None, person: str | None = None) -> str:
    """Return the full name under which a client sends commands: `sender`, or else the default one.

    `identity` is the owner of the client's certificate. If the owner is a person, only this person may be the sender:
    raises keys.BadKey for another one.
    """
    known = parse_identity(identity)
    if known is None or known[0] is not IdentityRole.PERSON:
        return sender or default_sender(person)
    asked = keys.person_of(sender) if sender else person or os.environ.get("FLEET_AS") or known[1]
    if asked != known[1]:
        raise keys.BadKey(
            f"you are {known[1]} here, by the certificate of this computer, and not {asked}: leave out --as and "
            f"FLEET_AS. For {asked}, `fleet hub invite {asked}` makes another certificate."
        )
    return sender or default_sender(known[1])


def closed_error() -> BusError:
    """Return the error of a method that needs an open Fleet."""
    return BusError("this Fleet is closed: use it inside its `with`, or open another one")


class Fleet:
    """A connection to one fleet: `with Fleet() as fleet`. Several threads may call its methods.

    `endpoint` is the address of the bus, `tcp/HOST:PORT`. The default is FLEET_ENDPOINT, else the hub that this
    computer has joined, else port 7447 on this computer. `name` is the fleet's name. `person` is the person in whose
    name commands are sent, such as `group_a` (default: FLEET_AS, else the user's login). `sender` is the full name of
    the sender, `person@host-pid` by default. `kind` is the rank of the sender: `script`, `person` (outranks scripts) or
    `coordinator`. `start_hub`: start a hub on this computer if none runs. `identity` is the owner of the certificate to
    use, such as `service.coordinator` (default: the user). If a person owns the certificate, commands are sent in this
    person's name, and a different `person` or `sender` raises keys.BadKey.

    While a Fleet is open, it has the liveliness token `<fleet>/@operator/<sender>` on the bus. If the token disappears,
    for example because the program has crashed, gateways end the drives of this client, and stop the cars that it
    drives. Modes that it has switched on go on, but a mode that has not begun is dropped. So use a Fleet in a `with`
    block, or call `close`. Otherwise the script ends with a ResourceWarning. A forked process needs a Fleet of its own:
    one that was opened before the fork raises BusError there.

    Raises schemas.bus.NoFleet (a BusError) if there is no fleet, keys.BadKey for a bad name.
    """

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
        self.name = keys.check_name(name, "fleet name")
        self.kind = kind
        keys.operator_token(self.name, sender or default_sender(person))  # raises BadKey before the bus is opened
        try:
            self.bus = Bus.open(endpoint, start_hub=start_hub, identity=identity)
        except NoFleet as error:
            raise explain_no_fleet(error) from None
        try:
            self.sender = certified_sender(self.bus.identity, sender, person)
        except keys.BadKey:
            self.bus.close()
            raise
        token = keys.operator_token(self.name, self.sender)
        self._closed = False
        self._pending: dict[str, PendingCommand] = {}
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()
        self._poses: dict[str, Publisher] = {}
        """The publisher of each car's poses, by car."""
        self._pose_lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=32, thread_name_prefix="fleet-ask")
        # A query to a gateway that hangs occupies a thread for 10 s. A stop never waits for such a thread.
        self._stop_pool = JobThreads(_MAX_STOP_THREADS, "fleet-stop")
        self.dropped = 0
        """Number of command events that were dropped because the queue of their command was full."""
        try:
            self.bus.token(token)
            self.bus.subscribe(keys.topic_key(self.name, "*", "event/command"), self._on_event)
            self.bus.watch_tokens(keys.car_token(self.name, "*"), self._on_gateway)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus. Every watch ends. The outcome of a command that is still under way is unknown then."""
        self._closed = True
        if self.bus.is_of_other_process:  # the Fleet of the process that has forked stays open
            return
        for watch in list(self._watches):
            watch.close()
        for command in list(self._pending.values()):
            command.inbox.put((time.monotonic(), CLOSED))
        pools = self._pool, self._stop_pool
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)
        self.bus.close()  # ends every pending query
        for pool in pools:
            pool.shutdown()

    def check_open(self) -> None:
        """Raise BusError if the fleet is closed, or was opened by the process that has forked this one."""
        if self._closed:  # the errors that Zenoh and the pools would raise do not help
            raise closed_error()
        if self.bus.is_of_other_process:  # Zenoh would wait for ever for its threads, which a fork does not copy
            raise BusError("this Fleet was opened before this process was forked: open another one in this process")

    # ------------------------------------------------------------------ reading

    def cars(self) -> list[str]:
        """Return the names of the cars whose gateway is on the bus."""
        self.check_open()
        return [token.rpartition("/")[2] for token in self.bus.tokens(keys.car_token(self.name, "*"))]

    def car(self, name: str) -> "Car":
        """Return a car, whether or not it is on the bus. Raises keys.BadKey for a bad name."""
        return Car(self, check_car(name))

    def expression(self, expression: str) -> str:
        """Expand a short form (`red`, `*/sensor/battery`) to a key expression. Raises keys.BadKey."""
        return canon(keys.expand(expression, self.name))

    def get(self, expression: str) -> list[Reading]:
        """Return the latest value of every matching key, sorted by key.

        `expression` is a key or a key expression. Short forms work as on the command line, such as `red/sensor/range`,
        `*/sensor/battery` or `red`. Raises keys.BadKey for a key that no topic has. A car that is not on the bus has no
        readings.
        """
        return self._read(self.expression(expression), ANSWER_TIMEOUT_S)

    def history(self, expression: str, *, last: int | None = None, since_s: float | None = None) -> list[Reading]:
        """Return the newest `last` values of every matching key, or those of the last `since_s` seconds.

        With both, return the newest `last` values of that time. The result is sorted by key and time. A gateway stores
        1500 values of each sensor, and only the latest value of each state.
        `fleet.client.history_query.describe_shortfalls` says what is missing. Raises ValueError for values out of
        range.
        """
        selector = history_query.selector(self.expression(expression), last=last, since_s=since_s)
        found: list[Reading] = []
        for _ in range(history_query.MAX_HISTORY_QUERIES):
            found = history_query.merge(found, self._read(selector, history_query.HISTORY_TIMEOUT_S), last)
            if not history_query.gaps(found):
                break
        return found

    def _read(self, selector: str, timeout_s: float) -> list[Reading]:
        key_expression = selector.partition("?")[0]
        if "@cmd" in key_expression.split("/"):
            raise keys.BadKey(f"{key_expression} is a command, not a reading: a query of it would be carried out")
        check_key(key_expression)
        self.check_open()
        found = []
        for answer in self.bus.query(selector, timeout_s=timeout_s, qos=Qos.STATE):
            if isinstance(answer, Failure):
                log.warning("not every gateway answered: %s", answer.words)
                continue
            try:
                found.append(reading_of(answer))
            except (messages.BadPayload, KeyError) as error:
                log.warning("%s: an answer that is not a message of this fleet: %s", answer.key, error)
        return sorted(found, key=lambda reading: reading.key)

    def watch(self, expression: str, *, when: str | None = None) -> Watch:
        """Return a stream of the readings to come: `for reading in fleet.watch("*/sensor/range")`.

        `when` is a condition on the fields of one message, such as `range_m < 0.3`. The stream then yields only
        messages for which the condition is true. It ends when the fleet is closed, or earlier at the end of a `with`
        block. Raises conditions.BadExpression.
        """
        key_expression = check_key(self.expression(expression))
        accept = None if when is None else KeyCondition.of(when, key_expression).holds
        self.check_open()

        def subscribe(on_sample: Callable[[Sample], None]) -> Callable[[], object]:
            return self.bus.subscribe(key_expression, on_sample).undeclare

        watch = Watch(accept).begin(subscribe)
        self._watches.add(watch)
        if self._closed:  # since `check_open`: perhaps `close` has not seen this watch
            watch.close()
        return watch

    def wait(self, expression: str, when: str, *, timeout_s: float | None = None, for_s: float = 0.0) -> Reading:
        """Wait until the condition `when` is true for a reading, and return it.

        The current reading counts, too, unless it is stale. With `for_s`, the condition must have been true in all
        readings of the last `for_s` seconds, by their stamps. Without `timeout_s`, wait for ever. Raises wait.NotInTime
        (a TimeoutError), conditions.BadExpression, and BusError if this Fleet is closed meanwhile.
        """
        key_expression = self.expression(expression)
        waiting = ConditionWait(KeyCondition.of(when, key_expression), for_s)
        began = time.monotonic()

        def left_s() -> float:
            return inf if timeout_s is None else began + timeout_s - time.monotonic()

        with self.watch(expression) as stream:  # before the query, so that no value in between is missed
            for reading in self._read(key_expression, max(MIN_QUERY_TIMEOUT_S, min(ANSWER_TIMEOUT_S, left_s()))):
                if waiting.ends(reading, datetime.now(UTC)):
                    return reading
            while (left := left_s()) > 0:
                self.check_open()
                coming = stream.within(left)
                if coming is not None and waiting.ends(coming, datetime.now(UTC), time.monotonic()):
                    return coming
        raise waiting.timeout_error(key_expression, timeout_s or 0.0, datetime.now(UTC))

    # ------------------------------------------------------------------ poses

    def publish_pose(
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
        """Publish where a car is, as this program has measured it from outside the car: `sensor/pose` (REP-103).

        `frame` is the coordinate frame: cars with the same frame are on the same map. `heading_rad` is
        counter-clockwise from the x axis, and may be any number. `at` is the time of the measurement, with its time
        zone (default: now). `xy_std_m` and `heading_std_rad` are standard deviations, if they are known. Raises
        ValueError for a value out of its range, keys.BadKey for a bad name, and BusError on a hub with certificates,
        unless this client has the certificate of `service.locator`.
        """
        self.check_open()
        message = pose_message(x_m, y_m, heading_rad, frame, xy_std_m, heading_std_rad)
        if not may_locate(self.bus.identity, check_car(car)):
            raise BusError(
                f"{self.bus.identity} may not say where {car} is, so the hub would drop it. Open the fleet with "
                'identity="service.locator". Another computer first needs the certificate for it: '
                "`fleet hub invite --service locator`."
            )
        with self._pose_lock:
            if car not in self._poses:
                topic = topics.TOPICS["sensor/pose"]
                self._poses[car] = self.bus.publisher(keys.topic_key(self.name, car, topic.name), topic, car)
            when = datetime.now(UTC) if at is None else at
            with self.bus.while_open():
                self._poses[car].put(message, round(when.timestamp() * 1e6) * 1000)

    # ------------------------------------------------------------------ commands

    def stop(self, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Stop these cars; a str is one car. Without an argument, stop every car with one query."""
        return self.ask(stop_request(), cars)

    def estop(self, cars: Iterable[str] | None = None, why: str = "") -> list[Outcome]:
        """E-stop these cars. Without an argument, e-stop the whole fleet."""
        return self.ask(estop_request(why, Scope.FLEET if cars is None else Scope.CAR), cars)

    def resume(self, cars: Iterable[str] | None, ids: Sequence[str] = (), *, everything: bool = False) -> list[Outcome]:
        """End the e-stops with these ids; a str is one id. Without ids, end the hold that a stop left.

        If `cars` is None, do this for every car. With `everything`, end the hold and every e-stop that this sender may
        end. If an e-stop or a hold remains, the outcome is not ok.
        """
        return self.ask(resume_request(ids, everything=everything), cars)

    def pause(self, why: str = "") -> list[Outcome]:
        """Stop every car. Until `unpause`, only leads can move cars; if the fleet has no leads, nobody can."""
        return self.ask(pause_request(why))

    def unpause(self) -> list[Outcome]:
        """End the pause of the fleet. This moves no car."""
        return self.ask(plain_request(Verb.UNPAUSE))

    def lend(self, cars: Iterable[str], to: str, duration_s: float) -> list[Outcome]:
        """Lend these cars to a person. For `duration_s`, only that person and leads can drive them."""
        return self.ask(lend_request(to, duration_s), cars)

    def end_loan(self, cars: Iterable[str]) -> list[Outcome]:
        """End the loan of these cars, and stop those that the borrower drives."""
        return self.ask(end_loan_request(), cars)

    def ask(self, request: CommandRequest, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Send a command to the cars, or to all with one wildcard query if `cars` is None. Return their outcomes.

        All cars get the command at once. The list is complete when the last outcome is known, or is given up.
        """
        return self.outcomes(self.send(request, cars))

    def send(self, request: CommandRequest, cars: Iterable[str] | None = None) -> PendingCommand:
        """Send a command and return at once. To get its outcomes, pass the result to `outcomes`."""
        self.check_open()
        cars = [cars] if isinstance(cars, str) else cars  # "red" is an Iterable[str], too: r, e, d
        named = None if cars is None else list(dict.fromkeys(keys.check_name(car) for car in cars))
        message = self._fill(request)
        command_id, payload = message.id, message.SerializeToString()
        pool = self._stop_pool if request.until is Until.STOPPED else self._pool

        def send_again(car: str) -> None:
            pool.submit(self._query, car, command, payload)

        command = PendingCommand(command_id, request, self.cars(), named, lambda: self.bus.link, send_again)
        self._pending[command_id] = command
        extra = json_log.fields(
            command_id=command_id, verb=request.verb, phase=Phase.ASKED, sender=message.sender, cars=command.targets
        )
        command_log.info("%s to %s", request.verb, ", ".join(command.targets) or "no car", extra=extra)
        try:
            command.queries = [pool.submit(self._query, target, command, payload) for target in command.targets]
            if command.is_stop:
                with suppress(RuntimeError):  # the fleet was closed meanwhile, which ends the command
                    pool.submit(self._query_supervisor, command)
        except BaseException as error:
            del self._pending[command_id]
            if self._closed and isinstance(error, RuntimeError):  # of a pool that takes no more jobs
                raise closed_error() from error
            raise
        if self._closed:  # since `check_open`: perhaps `close` has not seen this command
            command.abandon()
        return command

    def outcomes(self, command: PendingCommand) -> list[Outcome]:
        """Wait for the outcomes of a command that `send` has sent, and return them."""
        try:
            command.wait()
            for query in command.queries:
                if query.done() and not query.cancelled():
                    query.result()  # raises an unexpected error of its thread
        finally:
            self._pending.pop(command.id, None)
        found = command.outcomes()
        for each in found:
            extra = json_log.fields(
                command_id=command.id,
                car=each.car,
                verb=command.request.verb,
                phase=each.phase,
                reason=each.reason,
                words=each.words,
            )
            command_log.info("%s: %s %s", each.car, command.request.verb, each.phase, extra=extra)
        return found

    def _fill(self, request: CommandRequest) -> Any:
        """Return the message of a request, with its id, sender and time."""
        message = type(request.message)()
        message.CopyFrom(request.message)
        message.id = uuid.uuid4().hex
        message.sender = request.sender or self.sender
        message.kind = self.kind
        message.take = request.take
        message.asked.seconds, message.asked.nanos = divmod(time.time_ns(), 1_000_000_000)
        return message

    def _query(self, target: str, command: PendingCommand, payload: bytes) -> None:
        """Send the command to one car, or to all, and queue the answers. Runs on a thread of the pool."""
        verb = command.request.verb
        # Why a car has not answered: this, unless the query itself says more. If the target is `*`, the tracker puts
        # the name of each car there.
        why_silent = f"{target} may or may not carry it out: its gateway ended without an answer. Look at the car."
        try:
            answers = self.bus.query(
                keys.command_key(self.name, target, verb, self.bus.identity),
                payload=payload,
                encoding=messages.encoding_of(COMMANDS[verb].message),
                timeout_s=OVERLOAD_ANSWER_TIMEOUT_S,
            )
            for answer in answers:
                if isinstance(answer, Sample):
                    command.inbox.put((time.monotonic(), answer))
                else:
                    why_silent = "" if answer.is_timeout else answer.words  # see QueryEnded
        finally:
            command.inbox.put((time.monotonic(), QueryEnded(target, why_silent)))

    def _query_supervisor(self, command: PendingCommand) -> None:
        """Ask the supervisor whose gateways it runs, and queue the names of these cars. Runs on a pool thread."""
        names: set[str] = set()
        try:
            for status in ask_status(self.bus, self.name, ANSWER_TIMEOUT_S):
                names |= {car for car, each in gateways_of(status).items() if each.state != RunState.ENDED}
        except messages.BadPayload as error:
            log.warning("a supervisor's status is unreadable: %s", error)
        finally:
            command.inbox.put((time.monotonic(), SupervisedCars(frozenset(names), frozenset(self.cars()))))

    def _on_gateway(self, token: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
        """Handle a change of a gateway's presence. Runs on a thread of the bus."""
        car = token.rpartition("/")[2]
        for command in list(self._pending.values()):
            if command.concerns(car):
                with suppress(queue.Full):
                    command.inbox.put_nowait((time.monotonic(), PresenceChange(car, alive=alive)))

    def _on_event(self, sample: Sample) -> None:
        """Handle a command event, perhaps of another sender's command. Runs on a Zenoh thread."""
        try:
            event: Any = messages.parse(_EVENT, sample.payload, sample.encoding)
        except messages.BadPayload as error:
            log.warning("%s: not a command event: %s", sample.key, error)
            return
        command = self._pending.get(event.id)
        if command is None:
            return
        try:
            command.inbox.put_nowait((time.monotonic(), event))
        except queue.Full:
            self.dropped += 1


class Car(CarCommands[Outcome]):
    """One car of a fleet, which `Fleet.car` returns: `fleet.car("red").drive("forward", 2.0)`."""

    def __init__(self, fleet: Fleet, name: str) -> None:
        super().__init__(name)
        self._fleet = fleet

    def get(self, topic: str = "sensor/*") -> list[Reading]:
        """Return the latest readings of this car."""
        return self._fleet.get(f"{self.name}/{topic}")

    def lease(self, *, take: bool = False) -> "Lease[LeasedCar]":
        """Reserve the car for a block: `with fleet.car("red").lease() as car: car.drive("forward", 1.5)`.

        Within the block, nobody of the same or a lower rank can drive the car, unless a person takes it over. At its
        end, the car is stopped and released. In the block, a command that is not carried out raises NotCarriedOut. Once
        another sender has taken or stopped the car, every command raises LeaseLost. Both errors can also be raised
        when the block begins.
        With `take`, a person (`Fleet(kind="person")`) takes the car over from another person.
        """
        return Lease(self._fleet, self.name, partial(LeasedCar, self._fleet, self.name), take=take)

    def do(self, request: CommandRequest) -> Outcome:
        """Send one command and return its outcome."""
        return self._fleet.ask(request, [self.name])[0]


class LeasedCar(Car):
    """A car within `with fleet.car("red").lease() as car`: a command that is not carried out raises."""

    def __init__(self, fleet: Fleet, name: str, lease: "Lease[LeasedCar]") -> None:
        super().__init__(fleet, name)
        self._lease = lease

    def do(self, request: CommandRequest) -> Outcome:
        """Send one command. Raises NotCarriedOut, or LeaseLost if another sender has taken or stopped the car."""
        self._lease.check()
        return self._lease.check_outcome(super().do(request))

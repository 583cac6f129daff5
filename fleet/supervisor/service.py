"""The supervisor's place on the bus: what it hears of cars and services, what it is asked, that there is only one."""

import asyncio
import logging
import time
import uuid
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any, Final

import zenoh

from schemas import keys, messages, topics
from schemas.bus import Bus, Failure, Handover, Sample, reply, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos

STATUS: Final = topics.TOPICS[f"{keys.SUPERVISOR}/status"]
TOGETHER_S: Final = 0.3
"""Two that start at the same moment see each other when both have declared."""
PING_S: Final = 2.0
_HEARD: Final = ("*/state/*", "*/sensor/battery", "*/event/log", f"{keys.RECORDER}/status", f"{keys.COORDINATOR}/plan")
_WAITING: Final = 8192
"""Messages that may wait: some seconds of a hundred cars."""
_QUESTIONS: Final = 64
"""Queries that may wait."""
SERVICES: Final = {"down": "fleet.v1.DownCommand", "reload": "fleet.v1.ReloadCommand"}
"""What it may be asked, and the payload's message."""


class AnotherSupervisor(Exception):
    """The fleet has a supervisor; the text names it."""


class ReloadRefused(Exception):
    """What was asked cannot be done; the text says why, and that nothing was changed."""


_log: Final = logging.getLogger(__name__)
Service = Callable[[str], Awaitable[str]]
"""Does what its sender asked for; what it says of it. Raises Refused."""


class SupervisorService:
    """One session, declared from `open` to `close`; all callbacks come on the loop."""

    def __init__(self, bus: Bus, fleet: str) -> None:
        self.bus = bus
        self.fleet = fleet
        self._publisher = bus.publisher(self._key("status"), STATUS, keys.SUPERVISOR)

    def _key(self, name: str) -> str:
        return keys.topic_key(self.fleet, keys.SUPERVISOR, name)

    async def open(
        self,
        heard: Callable[[str, str, Any], object],
        services: Mapping[str, Service],
        status: Callable[[], pb.Supervision],
    ) -> None:
        """Declare all: heard(car, topic, message), what may be asked by its verb. Raises AnotherSupervisor."""
        loop = asyncio.get_running_loop()
        self._refuse(await asyncio.to_thread(self._others))

        def take(sample: Sample) -> None:
            key = keys.parse(sample.key)
            try:
                value = sample.message()
            except (messages.BadPayload, KeyError):
                return  # not of this fleet's programs: they are heard by what they publish
            if key is not None:
                heard(key.car, key.topic, value)

        def answer(query: zenoh.Query) -> None:
            with query:
                message = status()
                message.car, message.boot_id = keys.SUPERVISOR, self.bus.boot_id
                reply_value(query, self._key("status"), message.SerializeToString(), STATUS)

        samples: Handover[Sample] = Handover(loop, take, limit=_WAITING)
        questions: Handover[zenoh.Query] = Handover(loop, answer, limit=_QUESTIONS)
        work: set[asyncio.Task[None]] = set()

        def command(query: zenoh.Query) -> None:
            task = loop.create_task(self._asked(query, services))
            work.add(task)
            task.add_done_callback(work.discard)

        commands: Handover[zenoh.Query] = Handover(loop, command, limit=_QUESTIONS)
        self.bus.queryable(self._key("status"), questions)
        self.bus.queryable(self._key("@cmd/*"), commands)
        self.bus.token(keys.car_token(self.fleet, keys.SUPERVISOR))
        for expression in _HEARD:
            self.bus.subscribe(f"{self.fleet}/{expression}", samples)
        await asyncio.sleep(TOGETHER_S)
        others = await asyncio.to_thread(self._others)
        self._refuse([other for other in others if other.boot_id < self.bus.boot_id])

    def publish(self, status: pb.Supervision) -> None:
        """Publish how things are."""
        self._publisher.put(status, time.time_ns())

    def coordinator_answers(self) -> bool:
        """Whether the coordinator answers; on a thread, it waits for PING_S."""
        return self.plan_in_force() is not None

    def plan_in_force(self) -> Any:
        """The coordinator's fleet.v1.Plan; None if it does not answer. On a thread, it waits for PING_S."""
        answers = self.bus.query(f"{self.fleet}/{keys.COORDINATOR}/plan", timeout_s=PING_S, qos=Qos.STATE)
        return next((answer.message() for answer in answers if isinstance(answer, Sample)), None)

    def take_plan(self, text: str) -> bool:
        """Give the coordinator another plan; whether it took it. On a thread."""
        key = f"{self.fleet}/{keys.COORDINATOR}/@cmd/plan"
        payload, encoding = pb.Plan(text=text).SerializeToString(), messages.encoding_of("fleet.v1.Plan")
        for answer in self.bus.query(key, payload=payload, encoding=encoding, timeout_s=PING_S):
            if isinstance(answer, Sample):
                result: Any = messages.parse(topics.RESULT, answer.payload, answer.encoding)
                return bool(result.status == "sent")
        return False

    def stop_all(self) -> None:
        """Stop every car with one query; on a thread.

        As the coordinator does: the stop of a person or a script would hold the cars, also after the next start.
        """
        command = pb.StopCommand(sender="supervisor", kind="coordinator", id=uuid.uuid4().hex)
        key, encoding = keys.command_key(self.fleet, "*", "stop"), messages.encoding_of(topics.COMMANDS["stop"])
        for _ in self.bus.query(key, payload=command.SerializeToString(), encoding=encoding):
            pass

    async def _asked(self, query: zenoh.Query, services: Mapping[str, Service]) -> None:
        """Do what is asked, and answer as it was asked: protobuf, or JSON."""
        verb = str(query.key_expr).rpartition("/")[2]
        encoding = str(query.encoding) if query.encoding is not None else ""
        result = pb.Result(car=keys.SUPERVISOR, status="sent")
        try:
            command = self._command(query, verb, encoding)
            result.id = command.id
            result.words = await services[verb](command.sender or "anonymous")
        except (ReloadRefused, messages.BadPayload) as error:
            result.status, result.reason, result.words = "rejected", "bad_value", str(error)
        except Exception as error:  # noqa: BLE001 - whoever asks gets an answer, also of what nobody thought of
            result.status, result.words = "rejected", f"it went wrong: {type(error).__name__}: {error}"
            _log.exception("%s went wrong", verb)
        as_json = query.parameters.get("format") == "json" or not encoding.startswith(topics.PROTOBUF)
        with query:
            payload = messages.to_json(result).encode() if as_json else result.SerializeToString()
            reply(
                query,
                self._key(f"@cmd/{verb}"),
                payload,
                messages.JSON if as_json else messages.encoding_of(topics.RESULT),
            )

    def _command(self, query: zenoh.Query, verb: str, encoding: str) -> Any:
        if verb not in SERVICES:
            raise ReloadRefused(f"there is no {verb}: allowed are {', '.join(SERVICES)}")
        if query.payload is None:
            raise ReloadRefused("there is no payload: send a message, {} is enough")
        return messages.parse(SERVICES[verb], query.payload.to_bytes(), encoding)

    def _others(self) -> list[Any]:
        return [each for each in ask_status(self.bus, self.fleet) if each.boot_id != self.bus.boot_id]

    def _refuse(self, others: Iterable[Any]) -> None:
        for other in others:
            raise AnotherSupervisor(
                f"fleet {self.fleet} is up already: process {other.pid} on {other.host} "
                f"({other.fleet_file or 'simulated cars'}); end that first (fleet down), or name this one with --fleet"
            )


def ask_status(bus: Bus, fleet: str, timeout_s: float = 2.0) -> list[Any]:
    """The fleet.v1.Supervision of every supervisor that answers."""
    answers = bus.query(f"{fleet}/{STATUS.name}", timeout_s=timeout_s, qos=Qos.STATE)
    return [answer.message() for answer in answers if isinstance(answer, Sample)]


def ask_service(bus: Bus, fleet: str, verb: str, sender: str, timeout_s: float = 30.0) -> Any:
    """Ask the supervisor to do something; its fleet.v1.Result, None if there is none that answers."""
    command = messages.message_class(SERVICES[verb])()
    command.sender, command.kind, command.id = sender, "person", uuid.uuid4().hex  # type: ignore[attr-defined]  # ours
    key = keys.topic_key(fleet, keys.SUPERVISOR, f"@cmd/{verb}")
    payload, encoding = command.SerializeToString(), messages.encoding_of(SERVICES[verb])
    for answer in bus.query(key, payload=payload, encoding=encoding, timeout_s=timeout_s):
        if not isinstance(answer, Failure):
            return messages.parse(topics.RESULT, answer.payload, answer.encoding)
    return None

"""The supervisor's bus service: subscriptions to cars and services, its status, its commands. One per fleet."""

import asyncio
import logging
import time
import uuid
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

import zenoh

from fleet.client.services import send_command
from fleet.client.supervision import SUPERVISOR_STATUS
from schemas import keys, messages
from schemas.bus import (
    Bus,
    Failure,
    Handover,
    Sample,
    Singleton,
    is_json_wanted,
    messages_of,
    reply_message,
    reply_value,
)
from schemas.commands import COMMANDS, Verb
from schemas.gen import fleet_v1_pb2 as pb
from schemas.identity import NotTheSender, sender_for
from schemas.topics import Qos
from schemas.words import Phase, Rank, Reason

SECOND_CHECK_DELAY_S: Final = 0.3
"""Delay before the second search for other supervisors. If two start at once, both are on the bus by then."""
SERVICE_QUERY_TIMEOUT_S: Final = 2.0
SUBSCRIPTIONS: Final = (
    "*/state/*",
    "*/sensor/battery",
    "*/event/log",
    f"{keys.RECORDER}/status",
    f"{keys.COORDINATOR}/plan",
)
MAX_QUEUED_SAMPLES: Final = 8192
"""Maximum number of queued messages. A hundred cars publish as many in some seconds."""
MAX_SUPERVISOR_QUERIES: Final = 64
SUPERVISOR_COMMANDS: Final = {"down": "fleet.v1.DownCommand", "reload": "fleet.v1.ReloadCommand"}
"""The supervisor's commands, with the message type of the payload."""


class AnotherSupervisor(Exception):
    """The fleet already has a supervisor. The text names it."""


class CommandRefused(Exception):
    """A command is refused, and nothing has changed. The text says why."""


class RestartNeeded(Exception):
    """A part of a reload needs a restart of the fleet. The rest is done. The text names both."""


SupervisorHandler = Callable[[str], Awaitable[str]]
"""Carries out a command of the given sender and returns words for the reply. Raises CommandRefused, RestartNeeded."""
_log: Final = logging.getLogger(__name__)


class SupervisorService:
    """The supervisor's declarations in a bus session. All callbacks run on the loop."""

    def __init__(self, bus: Bus, fleet: str) -> None:
        self.bus = bus
        self.fleet = fleet
        self._publisher = bus.publisher(self._key("status"), SUPERVISOR_STATUS, keys.SUPERVISOR)

    def _key(self, name: str) -> str:
        return keys.topic_key(self.fleet, keys.SUPERVISOR, name)

    async def open(
        self,
        on_message: Callable[[str, str, Any], object],
        handlers: Mapping[str, SupervisorHandler],
        status: Callable[[], pb.Supervision],
        refusal: Callable[[str], str],
    ) -> None:
        """Declare everything. Raises AnotherSupervisor.

        on_message: called with car, topic and message. refusal: called with a person who has a certificate. It returns
        why this person may not send a command, or an empty text.
        """
        loop = asyncio.get_running_loop()
        singleton = Singleton(self.bus, self._key("status"), self._another_supervisor)
        await asyncio.to_thread(singleton.check_alone)

        def on_sample(sample: Sample) -> None:
            key = keys.parse(sample.key)
            try:
                value = sample.message()
            except (messages.BadPayload, KeyError):
                return  # the publisher is not a program of this fleet
            if key is not None:
                on_message(key.car, key.topic, value)

        def on_status_query(query: zenoh.Query) -> None:
            with query:
                message = status()
                message.car, message.boot_id = keys.SUPERVISOR, self.bus.boot_id
                reply_value(query, self._key("status"), message.SerializeToString(), SUPERVISOR_STATUS)

        tasks: set[asyncio.Task[None]] = set()

        def on_command_query(query: zenoh.Query) -> None:
            task = loop.create_task(self._on_command(query, handlers, refusal))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

        samples: Handover[Sample] = Handover(loop, on_sample, limit=MAX_QUEUED_SAMPLES)
        status_queries: Handover[zenoh.Query] = Handover(loop, on_status_query, limit=MAX_SUPERVISOR_QUERIES)
        command_queries: Handover[zenoh.Query] = Handover(loop, on_command_query, limit=MAX_SUPERVISOR_QUERIES)
        self.bus.queryable(self._key("status"), status_queries)
        for expression in keys.command_keys(self.fleet, keys.SUPERVISOR):
            self.bus.queryable(expression, command_queries)
        self.bus.token(keys.car_token(self.fleet, keys.SUPERVISOR))
        for expression in SUBSCRIPTIONS:
            self.bus.subscribe(f"{self.fleet}/{expression}", samples)
        await asyncio.sleep(SECOND_CHECK_DELAY_S)
        await asyncio.to_thread(singleton.raise_unless_first)

    def publish(self, status: pb.Supervision) -> None:
        """Publish the status."""
        self._publisher.put(status, time.time_ns())

    def coordinator_answers(self) -> bool:
        """Return True if the coordinator answers. Call it on a thread: it blocks for up to SERVICE_QUERY_TIMEOUT_S."""
        return self.plan_in_force() is not None

    def plan_in_force(self) -> Any:
        """Return the coordinator's fleet.v1.Plan, or None if it does not answer. Call this on a thread."""
        answers = self.bus.query(
            f"{self.fleet}/{keys.COORDINATOR}/plan", timeout_s=SERVICE_QUERY_TIMEOUT_S, qos=Qos.STATE
        )
        return next(messages_of(answers), None)

    def send_plan(self, text: str) -> bool:
        """Send the coordinator another plan. Return True if it accepted. Call it on a thread."""
        plan = pb.Plan(text=text, set_by=keys.SUPERVISOR)
        answers = send_command(self.bus, self.fleet, keys.COORDINATOR, "plan", plan, SERVICE_QUERY_TIMEOUT_S)
        return next((answer.status == Phase.SENT for answer in answers if not isinstance(answer, Failure)), False)

    def stop_all(self) -> None:
        """Stop every car with one query. Call it on a thread."""
        # Stop as a coordinator. A stop by a person or a script would put the cars on hold, and the hold would last into
        # the next run.
        command = pb.StopCommand(sender="supervisor", kind=Rank.COORDINATOR, id=uuid.uuid4().hex)
        key = keys.command_key(self.fleet, "*", Verb.STOP, self.bus.identity)
        encoding = messages.encoding_of(COMMANDS[Verb.STOP].message)
        for _ in self.bus.query(key, payload=command.SerializeToString(), encoding=encoding):
            pass

    async def _on_command(
        self, query: zenoh.Query, handlers: Mapping[str, SupervisorHandler], refusal: Callable[[str], str]
    ) -> None:
        """Carry out a command and reply in the encoding of the query."""
        key = str(query.key_expr)
        verb, identity = key.rpartition("/")[2], keys.identity_of(key)
        encoding = str(query.encoding) if query.encoding is not None else ""
        result = pb.Result(car=keys.SUPERVISOR, status=Phase.SENT)
        try:
            command = self._parse_command(query, verb, encoding)
            result.id = command.id
            result.words = await handlers[verb](_proven_sender(identity, command.sender, verb, refusal))
        except (CommandRefused, messages.BadPayload) as error:
            result.status, result.reason, result.words = Phase.REJECTED, Reason.BAD_VALUE, str(error)
        except RestartNeeded as error:
            result.status, result.words = Phase.FAILED, str(error)
        except Exception as error:  # noqa: BLE001 - reply to every query, whatever the error
            result.status, result.words = Phase.REJECTED, f"internal error: {type(error).__name__}: {error}"
            _log.exception("%s went wrong", verb)
        key = keys.command_key(self.fleet, keys.SUPERVISOR, verb, identity)
        with query:
            reply_message(query, key, result, as_json=is_json_wanted(query))

    def _parse_command(self, query: zenoh.Query, verb: str, encoding: str) -> Any:
        if verb not in SUPERVISOR_COMMANDS:
            raise CommandRefused(f"There is no command {verb}: allowed are {', '.join(SUPERVISOR_COMMANDS)}.")
        if query.payload is None:
            raise CommandRefused("The payload is missing. Send a message: {} is enough.")
        return messages.parse(SUPERVISOR_COMMANDS[verb], query.payload.to_bytes(), encoding)

    def _another_supervisor(self, other: Any) -> AnotherSupervisor:
        return AnotherSupervisor(
            f"{keys.describe_fleet(self.fleet).capitalize()} is up already: process {other.pid} on {other.host} "
            f"({other.fleet_file or 'simulated cars'}). End it with `fleet down`, or give this fleet another name with "
            "--fleet."
        )


def _proven_sender(identity: str, sender: str, verb: str, refusal: Callable[[str], str]) -> str:
    """Return the sender of a command.

    Raises CommandRefused if the certificate names another sender, or if the sender may not send this command.
    """
    try:
        sender = sender_for(identity, sender, verb)
    except NotTheSender as error:
        raise CommandRefused(str(error)) from None
    if identity and (words := refusal(keys.person_of(sender))):
        raise CommandRefused(words)
    return sender


def ask_service(bus: Bus, fleet: str, verb: str, sender: str, timeout_s: float = 30.0) -> Any:
    """Send a command to the supervisor. Return its fleet.v1.Result, or None if no supervisor answers."""
    command = messages.message_class(SUPERVISOR_COMMANDS[verb])()
    # Both messages have these fields.
    command.sender, command.kind, command.id = sender, Rank.PERSON, uuid.uuid4().hex  # type: ignore[attr-defined]
    answers = send_command(bus, fleet, keys.SUPERVISOR, verb, command, timeout_s)
    return next((answer for answer in answers if not isinstance(answer, Failure)), None)

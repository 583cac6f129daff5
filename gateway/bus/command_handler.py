"""Handles the command queries and drive streams of one car: parses them, records them, answers them.

Control decides about each command. Its answer goes out after control could write, and after the safety state is saved.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import zenoh

from gateway.bus import requests
from gateway.bus.estop_sync import EstopSync
from gateway.bus.publisher import CarPublisher
from gateway.control.commands import Answer, Command, EmergencyStop, Pause, Resume, Unpause
from gateway.control.controller import Controller
from gateway.control.driver import Driver
from gateway.control.events import LogRecord
from gateway.control.safety import PersistedSafety
from schemas import bus, keys, topics
from schemas.commands import Verb
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Level, Phase, Reason

_LOGGING_LEVELS: Final = {
    Level.DEBUG: logging.DEBUG,
    Level.INFO: logging.INFO,
    Level.WARNING: logging.WARNING,
    Level.ERROR: logging.ERROR,
}

log = logging.getLogger("gateway")


@dataclass(frozen=True, slots=True)
class _PendingQuery:
    """A command query whose answer is not sent yet."""

    query: zenoh.Query
    key: str
    command_id: str
    answer: Answer
    as_json: bool


class CommandHandler:
    """The commands of one car. Use it in the loop: `clock` is the loop's, `wake` wakes the writer."""

    def __init__(
        self,
        fleet: str,
        car: str,
        control: Controller[Driver],
        publisher: CarPublisher,
        estop_sync: EstopSync,
        *,
        save: Callable[[PersistedSafety], object],
        longest_drive_s: float,
        clock: Callable[[], float],
        wake: Callable[[], None],
    ) -> None:
        self._fleet = fleet
        self._car = car
        self._control = control
        self._publisher = publisher
        self._estop_sync = estop_sync
        self._save_to_disk = save
        self._saved_safety = control.safety.persisted
        self._longest_drive_s = longest_drive_s
        self._clock = clock
        self._wake = wake
        self._pending_queries: list[_PendingQuery] = []
        self._sent: set[str] = set()
        """Ids of commands whose first frame was written since the last answers."""

    def on_query(self, item: tuple[zenoh.Query, str]) -> None:
        """Pass a command query to control. Queue its answer until control could write."""
        query, unread = item
        expression = str(query.key_expr)
        verb = expression.rpartition("/")[2]
        encoding = str(query.encoding) if query.encoding is not None and not unread else ""
        payload = query.payload.to_bytes() if query.payload is not None and not unread else None
        as_json = query.parameters.get("format") == "json" or not encoding.startswith(topics.PROTOBUF)
        if "*" in verb:
            bus.refuse(query, f"{expression}: name the command, there is no command {verb}")
            return
        request = requests.RawRequest(
            verb,
            payload,
            encoding,
            time.time_ns(),
            longest_drive_s=self._longest_drive_s,
            car=self._car,
            by_wildcard="*" in expression,
            unread=unread,
            identity=keys.identity_of(expression),
        )
        before = self._control.safety.persisted
        command, answer = self._carry_out(request)
        if not request.by_wildcard:
            self._estop_sync.forward(command, before, self._control.safety.persisted)
        elif (
            isinstance(command.what, Pause | Unpause)
            or (isinstance(command.what, EmergencyStop) and command.what.fleet_wide)
            or (isinstance(command.what, Resume) and answer.reason is Reason.ESTOPPED)
        ):
            self._estop_sync.sync_soon()  # this gateway may have missed an e-stop or a pause, or its end
        key = keys.command_key(self._fleet, self._car, verb, request.identity)
        self._pending_queries.append(_PendingQuery(query, key, command.id, answer, as_json))
        self._wake()

    def on_sample(self, sample: bus.Sample) -> None:
        """Pass a drive of a stream to control."""
        if not sample.deleted:
            request = requests.RawRequest(
                Verb.DRIVE,
                sample.payload,
                sample.encoding,
                time.time_ns(),
                sampled_ns=sample.time_ns,
                longest_drive_s=self._longest_drive_s,
                car=self._car,
                by_wildcard="*" in sample.key,
                unread=sample.unread,
                identity=keys.identity_of(sample.key),
            )
            self._carry_out(request)
            self._wake()

    def _carry_out(self, request: requests.RawRequest) -> tuple[Command, Answer]:
        """Parse a request and pass it to control. Its first record has the original request."""
        now = self._clock()
        try:
            command = requests.parse(request)
            answer = self._control.command(command, now)
        except requests.BadRequest as error:
            command = error.command
            answer = self._control.record_rejection(command, error.reason, error.words, now)
        self._publish_records(command.id, request)
        return command, answer

    def _reply(self, pending: _PendingQuery, sent: set[str]) -> None:
        answer = pending.answer
        status = Phase.SENT if pending.command_id in sent and answer.status is Phase.QUEUED else answer.status
        result = pb.Result(
            id=pending.command_id,
            car=self._car,
            status=status,
            reason=answer.reason or "",
            words=answer.words,
            worst_case_s=answer.worst_case_s or None,  # only a stop has one
        )
        with pending.query as query:
            bus.reply_message(query, pending.key, result, as_json=pending.as_json)

    def flush(self) -> None:
        """Publish records, save the safety state, answer the pending queries."""
        self._publish_records()
        self._save()
        sent, self._sent = self._sent, set()
        pending, self._pending_queries = self._pending_queries, []
        for each in pending:
            self._reply(each, sent)

    def _save(self) -> None:
        """Save a changed safety state."""
        # Before the answers: after "the e-stop is latched" a person may switch the computer off.
        safety = self._control.safety.persisted
        if safety == self._saved_safety:
            return
        self._saved_safety = safety
        try:
            self._save_to_disk(safety)
        except OSError as error:
            words = f"{self._car} loses its hold and e-stops at a restart of its gateway: {error}"
            self.log(Level.ERROR, "not_saved", words)
            for index, each in enumerate(self._pending_queries):
                answer = replace(each.answer, words="; ".join(filter(None, (each.answer.words, f"not saved: {error}"))))
                self._pending_queries[index] = replace(each, answer=answer)

    def _publish_records(self, command_id: str = "", request: requests.RawRequest | None = None) -> None:
        for record in self._control.take_records():
            if isinstance(record, LogRecord):
                self._print(record)
                self._publisher.publish_log(record)
                continue
            first = request if request is not None and record.command.id == command_id else None
            self._publisher.publish_command(record, None if first is None else (first.payload or b"", first.encoding))
            request = None if first is not None else request
            if record.phase is Phase.SENT:
                self._sent.add(record.command.id)

    def log(self, level: Level, code: str, words: str) -> None:
        """Log an event of the gateway, and publish it."""
        record = LogRecord(level, code, words, self._clock())
        self._print(record)
        self._publisher.publish_log(record)

    def _print(self, record: LogRecord) -> None:
        """Print a log line, with the code that the troubleshooting page explains."""
        car = "" if record.words.startswith(f"{self._car} ") else f"{self._car}: "
        log.log(_LOGGING_LEVELS[record.level], "%s%s [%s]", car, record.words, record.code)

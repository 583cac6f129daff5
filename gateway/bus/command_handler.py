"""Handles the command queries and drive streams of one car: parses them, records them, answers them.

Control decides about each command. The answer is sent after the writer has had a turn and the safety state is saved.
"""

import logging
import time
from collections.abc import Callable
from typing import Final

from msgspec.structs import replace

from gateway.bus import command_parser
from gateway.bus.car_publisher import CarPublisher
from gateway.bus.car_service import Request
from gateway.bus.estop_sync import EstopSync
from gateway.control.commands import Answer, Command
from gateway.control.control_output import CommandRecord, LogRecord
from gateway.control.controller import Controller
from gateway.control.driver import Driver
from gateway.control.safety_state import PersistedSafety
from schemas import bus, keys, topics
from schemas.gen import fleet_v1_pb2 as pb
from schemas.process import json_log
from schemas.words import Level, Phase

SAVE_RETRY_S: Final = 1.0
"""Interval at which a safety state that could not be saved is tried again: the disk may have room again."""
_LOGGING_LEVELS: Final = {
    Level.DEBUG: logging.DEBUG,
    Level.INFO: logging.INFO,
    Level.WARNING: logging.WARNING,
    Level.ERROR: logging.ERROR,
}

log = logging.getLogger("gateway")
command_log = logging.getLogger(json_log.COMMANDS)


class CommandHandler:
    """Handles the commands of one car, in the loop. `clock` is the loop's clock, and `wake` wakes the writer.

    `on_gap` looks for a gap of the loop: after a sleep of the computer, the car is stopped before the next command.
    """

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
        on_gap: Callable[[float], None],
    ) -> None:
        self._fleet = fleet
        self._car = car
        self._control = control
        self._publisher = publisher
        self._estop_sync = estop_sync
        self._save_to_disk = save
        self._saved_safety = control.safety.persisted
        self._unsaved_safety: PersistedSafety | None = None
        """The state that could not be saved at the last try."""
        self._save_at = float("-inf")
        """When it is tried again."""
        self._longest_drive_s = longest_drive_s
        self._clock = clock
        self._wake = wake
        self._on_gap = on_gap
        self._unanswered: list[tuple[Request, str, Answer]] = []
        """Queries, each with the id of its command and the answer to send."""
        self._logs_commands = json_log.is_wanted()
        self._sent: set[str] = set()
        """Ids of commands that were recorded as sent since the last answers were sent."""

    def on_request(self, request: Request) -> None:
        """Pass a command to control. Queue the answer to a query until the writer has had a turn."""
        self._on_gap(self._clock())
        before = self._control.safety.persisted
        command, answer = self._carry_out(request)
        if request.query is not None:
            self._estop_sync.share(command, answer, before, self._control.safety, by_wildcard=request.by_wildcard)
            self._unanswered.append((request, command.id, answer))
        self._wake()

    def _carry_out(self, request: Request) -> tuple[Command, Answer]:
        """Parse a request and pass it to control. Publish the original request in the command's first record."""
        now = self._clock()
        try:
            command = command_parser.parse(
                request, time.time_ns(), car=self._car, longest_drive_s=self._longest_drive_s
            )
            answer = self._control.command(command, now)
        except command_parser.BadRequest as error:
            command = error.command
            answer = self._control.record_rejection(command, error.reason, error.words, now)
        self._publish_records(command.id, request)
        return command, answer

    def _reply(self, request: Request, command_id: str, answer: Answer, sent: set[str]) -> None:
        status = Phase.SENT if command_id in sent and answer.status is Phase.QUEUED else answer.status
        result = pb.Result(
            id=command_id,
            car=self._car,
            status=status,
            reason=answer.reason or "",
            words=answer.words,
            worst_case_s=answer.worst_case_s or None,  # only a stop has a worst case
        )
        assert request.query is not None
        with request.query as query:
            key = keys.command_key(self._fleet, self._car, request.verb, request.identity)
            as_json = query.parameters.get("format") == "json" or not request.encoding.startswith(topics.PROTOBUF)
            bus.reply_message(query, key, result, as_json=as_json)

    def flush(self) -> None:
        """Publish records, save the safety state, and answer the pending queries."""
        self._publish_records()
        self._save()
        sent, self._sent = self._sent, set()
        unanswered, self._unanswered = self._unanswered, []
        for request, command_id, answer in unanswered:
            self._reply(request, command_id, answer, sent)

    def _save(self) -> None:
        """Save a changed safety state."""
        # Save before answering: a person who reads that the e-stop is in force may switch the computer off.
        safety = self._control.safety.persisted
        if safety == self._saved_safety:
            return
        now, is_retry = self._clock(), safety == self._unsaved_safety
        if is_retry and now < self._save_at:
            return
        try:
            self._save_to_disk(safety)
            self._saved_safety, self._unsaved_safety = safety, None
        except OSError as error:
            self._unsaved_safety, self._save_at = safety, now + SAVE_RETRY_S
            if is_retry:  # it was told at the first try
                return
            words = f"{self._car} will lose its hold and e-stops if its gateway restarts: {error}"
            self.log(Level.ERROR, "not_saved", words)
            lost = f"not saved: {error}"
            self._unanswered = [
                (request, command_id, replace(answer, words=f"{answer.words}; {lost}" if answer.words else lost))
                for request, command_id, answer in self._unanswered
            ]

    def _publish_records(self, command_id: str = "", request: Request | None = None) -> None:
        for record in self._control.take_records():
            if isinstance(record, LogRecord):
                self._print(record)
                self._publisher.publish_log(record)
                continue
            self._log_command(record)
            original: tuple[bytes, str] | None = None
            if request is not None and record.command.id == command_id:
                original, request = (request.payload or b"", request.encoding), None  # only the first record has it
            self._publisher.publish_command(record, original)
            if record.phase is Phase.SENT:
                self._sent.add(record.command.id)

    def _log_command(self, record: CommandRecord) -> None:
        """Log a record of a command, if this process logs as JSON."""
        if not self._logs_commands:
            return
        command = record.command
        extra = json_log.fields(
            command_id=command.id,
            car=self._car,
            verb=command.verb,
            phase=record.phase,
            sender=command.sender.name,
            reason=record.reason,
            words=record.words,
        )
        command_log.info("%s: %s %s", self._car, command.verb, record.phase, extra=extra)

    def log(self, level: Level, code: str, words: str) -> None:
        """Log an event of the gateway, and publish it."""
        record = LogRecord(level, code, words, self._clock())
        self._print(record)
        self._publisher.publish_log(record)

    def _print(self, record: LogRecord) -> None:
        """Print a log line that ends with the code, which the troubleshooting page explains."""
        car = "" if record.words.startswith(f"{self._car} ") else f"{self._car}: "
        extra = json_log.fields(car=self._car, code=record.code)
        log.log(_LOGGING_LEVELS[record.level], "%s%s [%s]", car, record.words, record.code, extra=extra)

"""Collects records of commands, and log records, until the loop publishes them."""

from collections import OrderedDict, deque
from collections.abc import Hashable
from typing import Any, Final

from msgspec import Struct, field

from gateway.control.commands import Command
from gateway.control.control_output import CommandRecord, Later, LogRecord, Record, frame_of
from schemas.words import Level, Phase, Reason

MAX_COMMAND_IDS: Final = 256
"""Maximum accepted commands whose ids are remembered, to detect duplicates."""


class Pending(Struct):
    """A command in progress: its arrival time, and the frames that it still needs."""

    command: Command
    received_at: float
    frames: deque[Any] = field(default_factory=deque)
    """The frames that are not written yet. A `Later` is a frame with a delay before it."""
    frames_written: int = 0
    sent: bool = False
    count: int = 1
    """Number of merged commands."""
    due_at: float = float("-inf")
    """When the next frame is due, at the end of the delay before it."""
    part: Hashable = None
    """The part of the car that the command acts on, as the driver names it."""
    sender_lost_at: float = float("inf")
    """When the sender of a waiting mode counts as lost. Infinite while its token exists, or if it never had one."""

    @property
    def waits_since(self) -> float:
        """Return since when the command waits for the car. During a delay, this is the end of the delay."""
        return max(self.received_at, self.due_at)

    @property
    def next_frame(self) -> Any:
        """Return the frame that is written next."""
        return frame_of(self.frames[0])

    @property
    def is_delayed(self) -> bool:
        """Return True if there is a delay before the next frame. Other commands need not wait for this one."""
        return bool(self.frames) and isinstance(self.frames[0], Later)

    @property
    def lasts(self) -> bool:
        """Return True if there is a delay before one of its frames."""
        return any(isinstance(each, Later) for each in self.frames)

    def begin_delay(self, now: float) -> None:
        """Begin the delay before the next frame now, if there is one."""
        self.due_at = now + (self.frames[0].after_s if self.is_delayed else 0.0)


class CommandLog:
    """Records each transition. Of a stream of drives, it records only start, end, and rejections with a new reason."""

    def __init__(self) -> None:
        self._records: list[Record] = []
        self._ids: OrderedDict[str, None] = OrderedDict()
        self._rejected: dict[str, Reason] = {}

    @property
    def has_records(self) -> bool:
        """Return True if there are records to take."""
        return bool(self._records)

    def take_records(self) -> list[Record]:
        """Return the records since the last call."""
        records, self._records = self._records, []
        return records

    def record(
        self,
        pending: Pending,
        phase: Phase,
        now: float,
        *,
        reason: Reason | None = None,
        words: str = "",
        worst_case_s: float = 0.0,
        evidence: tuple[str, ...] = (),
        basis: str = "",
    ) -> None:
        """Record one transition."""
        pending.sent = pending.sent or phase is Phase.SENT
        took = now - pending.received_at
        self._records.append(
            CommandRecord(
                pending.command, phase, now, reason, words, worst_case_s, took, evidence, pending.count, basis
            )
        )

    def record_sent(self, pending: Pending, now: float, words: str = "", reason: Reason | None = None) -> None:
        """Record the command as sent, if that is not recorded yet."""
        if not pending.sent:
            self.record(pending, Phase.SENT, now, reason=reason, words=words)

    def record_rejection(self, pending: Pending, reason: Reason, words: str, now: float) -> None:
        """Record a rejection. Of a stream, leave out one with the same reason as the sender's last one."""
        sender = pending.command.sender.name
        if pending.command.streamed:
            if self._rejected.get(sender) is reason:
                return
            if len(self._rejected) >= MAX_COMMAND_IDS:
                self._rejected.clear()
            self._rejected[sender] = reason
        self.record(pending, Phase.REJECTED, now, reason=reason, words=words)

    def accept(self, command: Command) -> None:
        """Remember the command's id, so that the command is not carried out twice."""
        self._rejected.pop(command.sender.name, None)
        if command.streamed:
            return
        self._ids[command.id] = None
        if len(self._ids) > MAX_COMMAND_IDS:
            self._ids.popitem(last=False)

    def has_accepted(self, command: Command) -> bool:
        """Return True if one of the last accepted commands has this id."""
        return command.id in self._ids

    def log(self, level: Level, code: str, words: str, now: float) -> None:
        """Add a log record."""
        self._records.append(LogRecord(level, code, words, now))

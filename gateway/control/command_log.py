"""What became of each command, and notable events, kept until the loop publishes them."""

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from gateway.control.commands import Command, Phase, Reason
from gateway.control.events import CommandRecord, Level, LogRecord, Record
from gateway.protocol.frames import Frame

_REMEMBERED_IDS: Final = 256


@dataclass(slots=True)
class Pending:
    """A command on its way: the frames it still needs, and when it came."""

    command: Command
    asked_at: float
    frames: deque[Frame] = field(default_factory=deque)
    sent: bool = False
    count: int = 1
    """How many commands of a stream it stands for."""


class CommandLog:
    """Records transitions; of a stream only its start, its end, and where a refusal begins."""

    def __init__(self) -> None:
        self._records: list[Record] = []
        self._ids: OrderedDict[str, None] = OrderedDict()
        self._refused: dict[str, Reason] = {}

    @property
    def waiting(self) -> bool:
        """Whether there are records to take."""
        return bool(self._records)

    def take(self) -> list[Record]:
        """The records since the last call."""
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
        """Note one transition."""
        pending.sent = pending.sent or phase is Phase.SENT
        took = now - pending.asked_at
        self._records.append(
            CommandRecord(
                pending.command, phase, now, reason, words, worst_case_s, took, evidence, pending.count, basis
            )
        )

    def sent(self, pending: Pending, now: float, words: str = "") -> None:
        """Note that the first frame went out, once."""
        if not pending.sent:
            self.record(pending, Phase.SENT, now, words=words)

    def refused(self, pending: Pending, reason: Reason, words: str, now: float) -> None:
        """Note a refusal; of a stream only the first of a kind."""
        sender = pending.command.sender.name
        if pending.command.streamed:
            if self._refused.get(sender) is reason:
                return
            if len(self._refused) >= _REMEMBERED_IDS:
                self._refused.clear()
            self._refused[sender] = reason
        self.record(pending, Phase.REJECTED, now, reason=reason, words=words)

    def accepted(self, command: Command) -> None:
        """Remember a command's id, so that it is not carried out twice."""
        self._refused.pop(command.sender.name, None)
        if command.streamed:
            return
        self._ids[command.id] = None
        if len(self._ids) > _REMEMBERED_IDS:
            self._ids.popitem(last=False)

    def known(self, command: Command) -> bool:
        """Whether a command with this id was accepted before (of the last 256)."""
        return command.id in self._ids

    def log(self, level: Level, code: str, words: str, now: float) -> None:
        """Note a notable event."""
        self._records.append(LogRecord(level, code, words, now))

"""The commands of one car: who requested what, what its gateway decided, what was sent, and which readings show it.

Pure.
"""

from typing import Any, Final

from msgspec import Struct, field

from fleet.client.diagnosis import FAILED_PHASES
from schemas import messages
from schemas.keys import name_of

MAX_COMMANDS: Final = 40
"""Number of commands that a page shows."""
MAX_WIRE_FRAMES: Final = 6
"""Number of frames of one command that a page shows."""


class LedgerCommand(Struct):
    """One command since its first event."""

    at_ms: int
    requested: str
    decided: list[str] = field(default_factory=list)
    wire: list[str] = field(default_factory=list)
    evidence: str = ""
    bad: bool = False


class CommandLedger:
    """The newest commands by id, the newest last."""

    def __init__(self) -> None:
        self._commands: dict[str, LedgerCommand] = {}
        self._early: dict[str, list[str]] = {}
        """Frames of commands that have no event yet, by command. Frames and events come over two subscriptions, in any
        order."""

    def on_event(self, event: Any) -> None:
        """Handle a command event."""
        if event.id not in self._commands:
            requested = f"{event.verb} by {name_of(event.sender)}{f' ({event.kind})' if event.kind else ''}"
            wire = self._early.pop(event.id, [])
            self._commands[event.id] = LedgerCommand(messages.stamp_ms(event.stamp), requested, wire=wire)
            _limit(self._commands)
        command = self._commands[event.id]
        words = event.phase + (f": {event.words or event.reason}" if event.words or event.reason else "")
        if event.HasField("took_s"):
            words += f" after {event.took_s:.2f} s"
        if not command.decided or command.decided[-1] != words:  # a stream of drives repeats its events
            command.decided = [*command.decided, words][-MAX_WIRE_FRAMES:]
        if event.evidence or event.basis:
            command.evidence = "; ".join(filter(None, (event.basis, *event.evidence)))
        command.bad = event.phase in FAILED_PHASES

    def on_frame(self, frame: Any) -> None:
        """Handle a frame to the car (fleet.v1.TxFrame)."""
        text = frame.data.decode("ascii", "backslashreplace")
        if not frame.written:
            text = f"{text} NOT written"
        command = self._commands.get(frame.command_id)
        if command is not None:
            command.wire = [*command.wire, text][-MAX_WIRE_FRAMES:]
        elif frame.command_id:
            self._early[frame.command_id] = [*self._early.get(frame.command_id, ()), text][-MAX_WIRE_FRAMES:]
            _limit(self._early)

    def as_list(self) -> list[dict[str, Any]]:
        """Return the commands, the newest first."""
        return [
            {
                "at_ms": each.at_ms,
                "requested": each.requested,
                "decided": " → ".join(each.decided),
                "wire": " ".join(each.wire),
                "evidence": each.evidence,
                "bad": each.bad,
            }
            for each in reversed(self._commands.values())
        ]


def _limit(by_id: dict[str, Any]) -> None:
    """Drop all but the newest."""
    while len(by_id) > MAX_COMMANDS:
        del by_id[next(iter(by_id))]

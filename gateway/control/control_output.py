"""The output of control: records of commands, log records, and frames to write. Values only."""

from typing import Any

from msgspec import Struct

from gateway.control.commands import Command
from schemas.words import FrameOrigin, Level, Phase, Reason


class CommandRecord(Struct, frozen=True):
    """One transition in the life of a command."""

    command: Command
    phase: Phase
    at: float
    reason: Reason | None = None
    words: str = ""
    worst_case_s: float = 0.0
    took_s: float = 0.0
    evidence: tuple[str, ...] = ()
    count: int = 1
    basis: str = ""
    """In the last record of a stop that is over: `shown` if readings show the stop, `sent` if only its frames were
    written. In the last record of a drive that was sent and has ended as commanded: `sent`. Else empty."""


class LogRecord(Struct, frozen=True):
    """One log record. `code` is one word for machines, `words` are for a person."""

    level: Level
    code: str
    words: str
    at: float


Record = CommandRecord | LogRecord


class Later(Struct, frozen=True):
    """A frame of an action, with a delay before it. Other commands can be sent during the delay."""

    frame: Any
    after_s: float
    """Delay in s after the previous frame, or after the command if this frame is the first one."""


def frame_of(given: Any) -> Any:
    """Return the frame that a driver gave, without its delay."""
    return given.frame if isinstance(given, Later) else given


class OutgoingFrame(Struct, frozen=True):
    """One frame to write now, in a single write."""

    frame: Any
    """The driver's own value."""
    data: bytes
    why: FrameOrigin
    command_id: str = ""

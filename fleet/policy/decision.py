"""A decision as a value: of whom, what, why, and what would change it. Its words are explain.py's. Pure."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gateway.protocol.values import Mode

LEFT_ALONE: Final = "left alone"


class Kind(StrEnum):
    """What a decision is about."""

    ROLE = "role"
    RULE = "rule"
    IDLE = "idle"
    ALONE = "alone"
    VACANT = "vacant"
    FILLED = "filled"
    PHASE = "phase"


@dataclass(frozen=True, slots=True)
class Decision:
    """What was decided of one subject: a car, `role NAME`, or `phase`."""

    subject: str
    kind: Kind
    decided: str
    """In a word or two: the mode, `left alone`, `1 of 2`, the phase."""
    cause: str
    """The same as long as the same thing decides."""
    why: str
    readings: tuple[str, ...] = ()
    """Those that were used, with values and ages."""
    would_change: str = ""
    car: str | None = None
    role: str | None = None
    mode: Mode | None = None
    """The mode the car should be in; None: it is left alone."""

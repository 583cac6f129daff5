"""A decision as a value: of whom, what, why, and what would change it. Its words are explain.py's. Pure."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from gateway.protocol.enums import Mode

LEFT_ALONE: Final = "left alone"


class DecisionKind(StrEnum):
    """What a decision is about."""

    ROLE = "role"
    RULE = "rule"
    IDLE = "idle"
    ALONE = "alone"
    VACANT = "vacant"
    FILLED = "filled"
    PHASE = "phase"
    OUT = "out"
    """A role that nobody is to have now."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What was decided of one subject: a car, `role NAME`, or `phase`."""

    subject: str
    kind: DecisionKind
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
    since: float = 0.0
    """When it was decided, s on the step's clock: the same as long as the cause is."""

    def after(self, before: "Decision | None", now: float) -> "Decision":
        """This, or `before` if it said the same: its readings are those that were used then."""
        if before is None or before.cause != self.cause:
            return replace(self, since=now)
        if (before.decided, before.why, before.would_change) == (self.decided, self.why, self.would_change):
            return before
        return replace(self, since=before.since)

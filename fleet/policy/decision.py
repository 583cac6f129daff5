"""A decision as a value: subject, result, reason, and what would change it. explain.py writes the words. Pure."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from schemas.words import Mode

LEFT_ALONE: Final = "left alone"


class DecisionKind(StrEnum):
    """Subject of a decision."""

    ROLE = "role"
    RULE = "rule"
    IDLE = "idle"
    ALONE = "alone"
    VACANT = "vacant"
    FILLED = "filled"
    PHASE = "phase"
    OUT = "out"
    """A role that no car should have now."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The decision about one subject: a car, `role NAME`, or `phase`."""

    subject: str
    kind: DecisionKind
    decided: str
    """The result in a word or two: the mode, `left alone`, `1 of 2`, the phase."""
    cause: str
    """Identifies the reason: it stays the same as long as the same thing decides."""
    why: str
    readings: tuple[str, ...] = ()
    """The readings that it is based on, with values and ages."""
    would_change: str = ""
    car: str | None = None
    role: str | None = None
    mode: Mode | None = None
    """The mode that the car should be in, or None if the car is left alone."""
    since: float = 0.0
    """Time at which the cause became the current one, s on the step's clock."""

    def after(self, before: "Decision | None", now: float) -> "Decision":
        """Return `before` if both say the same, so that its first readings stay; else this decision."""
        if before is None or before.cause != self.cause:
            return replace(self, since=now)
        if (before.decided, before.why, before.would_change) == (self.decided, self.why, self.would_change):
            return before
        return replace(self, since=before.since)

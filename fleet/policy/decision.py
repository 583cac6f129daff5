"""A decision as a value: subject, result, reason, and what would change it. explain.py writes the texts. Pure."""

from enum import StrEnum
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from schemas.words import Mode

LEFT_ALONE: Final = "left alone"


class DecisionKind(StrEnum):
    """The kind of a decision.

    For a car, it says what decided. For a role, it says whether the role has its cars. PHASE is for the phase.
    """

    ROLE = "role"
    RULE = "rule"
    IDLE = "idle"
    ALONE = "alone"
    VACANT = "vacant"
    FILLED = "filled"
    PHASE = "phase"
    OUT = "out"
    """A role that no car should have now."""


class Decision(Struct, frozen=True):
    """The decision about one subject: a car, `role NAME`, or `phase`."""

    subject: str
    kind: DecisionKind
    decided: str
    """The result in a word or two: the mode, `left alone`, `1 of 2`, the phase."""
    cause: str
    """Identifies the reason. It stays the same as long as the same role, rule or barrier decides."""
    why: str
    readings: tuple[str, ...] = ()
    """The readings on which the decision is based, with values and ages."""
    would_change: str = ""
    car: str | None = None
    role: str | None = None
    mode: Mode | None = None
    """The mode that the car should be in, or None if the car is left alone."""
    since: float = 0.0
    """Time at which the cause became the current one, s on the step's clock."""

    def after(self, before: "Decision | None", now: float) -> "Decision":
        """Return this decision, or `before` (that of the last step) if both say the same in the same words."""
        if before is None or before.cause != self.cause:
            return replace(self, since=now)
        if (before.decided, before.why, before.would_change) == (self.decided, self.why, self.would_change):
            return before
        return replace(self, since=before.since)

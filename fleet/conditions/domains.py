"""What the fields of messages ever are, and so which conditions can never be so however long one waits."""

from collections.abc import Mapping
from typing import Final

from fleet.conditions.expression import Expression
from fleet.conditions.parser import parse
from fleet.conditions.satisfiability import contradictory
from gateway.protocol.enums import Mode

_MOTIONS: Final = ("stop", "forward", "back", "left", "right", "spin_left", "spin_right", "unknown")
_MODES: Final = (*Mode, "unknown")
WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "battery.level": ("ok", "low", "critical"),
    "link.state": ("online", "quiet", "stale", "lost"),
    "mode.asked": _MODES,
    "mode.inferred": _MODES,
    "mode.verdict": ("assumed", "confirmed", "contradicted"),
    "motion.motion": _MOTIONS,
    "motion.source": ("commanded", "assumed", "unknown"),
    "safety.motors": ("off", "on", "stopping", "unknown"),
    "safety.motors_basis": ("shown", "sent"),
}
"""All that these ever are (schemas/proto); a field is named after the last word of its topic."""
RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "range.range_m": (0.0, 12.0),
    "battery.voltage_v": (0.0, 12.0),
    "battery.charge": (0.0, 1.0),
    "battery.charge_error": (0.0, 1.0),
    "grayscale.raw": (0.0, 1023.0),
    "motion.speed": (0.0, 1.0),
    "motion.servo_deg": (0.0, 180.0),
    "link.tx_airtime": (0.0, 1.0),
}
"""Beyond these nothing is published: docs/reference/protocol.md#ranges."""


def outside(expression: Expression, names: Mapping[str, type], of: str = "") -> str:
    """Why it can never be so, by what its names ever are; empty if it can.

    `names`: what it was parsed with; `of`: the last word of the topic, where they are the fields of one message.
    """
    if contradictory(expression):
        return f"{expression} is never so"
    for name in dict.fromkeys(expression.names):
        full = f"{of}.{name}" if of else name
        if full in WORDS:
            allowed = " or ".join(f"{name} == '{word}'" for word in WORDS[full])
            told = f"one of {', '.join(WORDS[full])}"
        elif full in RANGES:
            least, most = RANGES[full]
            allowed, told = f"{name} >= {least} and {name} <= {most}", f"{least:g} .. {most:g}"
        else:
            continue
        # Joined as trees: as one text they could be longer, or deeper, than a condition may be.
        if contradictory(expression & parse(allowed, names)):
            return f"{expression} is never so: {name} is {told}"
    return ""

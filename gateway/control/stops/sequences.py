"""The stops, as tables of frames and times: what docs/reference/protocol.md#stops prescribes. No state."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gateway.protocol.enums import Motion
from gateway.protocol.frames import Frame, General, ModeClose, Reset

REPEAT_S: Final = 1.1
"""A block that we know nothing of lasts up to 1.0 s; a frame sent 1.1 s after the last is alone in the buffer."""
SILENCE_S: Final = 3.7
"""From the first frame of recovery to the one that is certain: longer than any block outside avoidance."""
ANSWER_S: Final = 4.5
"""Maximum wait for a mode-0 reading after a stop: avoidance blocks for 4.3 s."""


class Gate(IntEnum):
    """What a frame waits for."""

    NOTHING = 0
    FLIGHT = 1
    """No frame of ours is in flight."""
    ALONE = 2
    """None is in flight, and none may be in the car's buffer."""


@dataclass(frozen=True, slots=True)
class Step:
    """One frame of a recipe, at the earliest so many seconds after the one before it, however late that was."""

    frame: Frame
    gate: Gate = Gate.NOTHING
    after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class StopSequence:
    """A way to stop. `rank`: a running recipe is only replaced by one of a higher rank."""

    name: str
    rank: int
    steps: tuple[Step, ...]

    @property
    def length_s(self) -> float:
        """From the first frame to the last, s, if nothing is waited for but what is certain."""
        return sum(step.after_s for step in self.steps)


_STOP: Final = General(Motion.STOP)
_MANUAL: Final = ModeClose()

# docs/reference/protocol.md#stops, soft
SOFT: Final = StopSequence("soft", 1, (Step(_STOP, Gate.FLIGHT), Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S)))

# docs/reference/protocol.md#stops, full
FULL: Final = StopSequence("full", 2, (Step(_MANUAL, Gate.ALONE), Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S)))

# The same where a frame of ours may lie in the buffer: `MODE00` behind it would be read at the wrong place, and waits.
# The general stop need not: behind that frame it is lost without harm, and mostly there is none.
FULL_BEHIND: Final = StopSequence("full_behind", 2, (Step(_STOP, Gate.FLIGHT), Step(_MANUAL, Gate.ALONE)))

# docs/reference/protocol.md#stops, Raspberry Pi
_PI_STEPS: Final = (Step(_STOP, Gate.FLIGHT), Step(_STOP, after_s=0.06), Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S))
PI_SOFT: Final = StopSequence("raspberry_pi_soft", 1, _PI_STEPS)
PI: Final = StopSequence("raspberry_pi", 2, _PI_STEPS)

# docs/reference/protocol.md#stops, recovery
RECOVERY: Final = StopSequence(
    "recovery",
    3,
    (
        Step(Reset()),
        Step(_MANUAL, after_s=0.05),
        Step(_MANUAL, after_s=SILENCE_S - 0.05),
        Step(_STOP, after_s=REPEAT_S),
    ),
)

# docs/reference/protocol.md#stops, platform unknown
UNKNOWN: Final = StopSequence(
    "unknown_platform",
    3,
    (
        Step(_STOP, Gate.FLIGHT),
        Step(_MANUAL, after_s=0.06),
        Step(_STOP, after_s=REPEAT_S),
        Step(_MANUAL, after_s=SILENCE_S - REPEAT_S - 0.06),
        Step(_STOP, after_s=REPEAT_S),
    ),
)

# The same where mode 0 is certain: there general stops stop every platform, behind whatever frame of ours is unread.
# `MODE00` comes last, alone: in one string with a stop it would undo it, with a servo frame it would open a mode.
UNKNOWN_MANUAL: Final = StopSequence(
    "unknown_platform_manual",
    3,
    (
        Step(_STOP, Gate.FLIGHT),
        Step(_STOP, after_s=0.06),
        Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S),
        Step(_MANUAL, Gate.ALONE, after_s=REPEAT_S),
        Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S),
    ),
)

# Asks a car that reports in mode 0 to show that it obeys: its reports pause for the second that `MODE00` takes.
PROBE: Final = StopSequence("probe", 3, (Step(_MANUAL, Gate.ALONE), Step(_STOP, Gate.FLIGHT, after_s=REPEAT_S)))

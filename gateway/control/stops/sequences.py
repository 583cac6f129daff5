"""The stop sequences as tables of frames and times, by docs/reference/protocol.md#stops. No state."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gateway.protocol.enums import Motion
from gateway.protocol.frames import Frame, General, ModeClose, Reset
from gateway.protocol.timing import RECOVERY_SILENCE_S

REPEAT_INTERVAL_S: Final = 1.1
"""Minimum interval that leaves a frame alone in the car's buffer: an unknown block lasts up to 1.0 s."""
STOP_REPORT_TIMEOUT_S: Final = 4.5
"""Timeout for a report of mode 0 after a stop: avoidance blocks for 4.3 s."""


class Gate(IntEnum):
    """The condition for writing a frame."""

    NOTHING = 0
    FLIGHT = 1
    """No frame of ours is in flight."""
    ALONE = 2
    """No frame of ours is in flight or in the car's buffer."""


@dataclass(frozen=True, slots=True)
class Step:
    """One frame of a sequence. `after_s` is the minimum time since the previous frame was written."""

    frame: Frame
    gate: Gate = Gate.NOTHING
    after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class StopSequence:
    """A way to stop. `rank`: only a sequence of a higher rank replaces the running one."""

    name: str
    rank: int
    steps: tuple[Step, ...]

    @property
    def length_s(self) -> float:
        """Return the minimum time from the first frame to the last, s."""
        return sum(step.after_s for step in self.steps)


STOP_FRAME: Final = General(Motion.STOP)
_MANUAL: Final = ModeClose()

# docs/reference/protocol.md#stops, stopping, soft
SOFT: Final = StopSequence(
    "soft", 1, (Step(STOP_FRAME, Gate.FLIGHT), Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S))
)

# docs/reference/protocol.md#stops, stopping, full
FULL: Final = StopSequence(
    "full", 2, (Step(_MANUAL, Gate.ALONE), Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S))
)

# The same if a frame of ours may be unread. Behind that frame the car would read `MODE00` at the wrong place, so it
# waits. The general stop does not wait: behind an unread frame it is lost without harm, and mostly there is none.
FULL_BEHIND: Final = StopSequence("full_behind", 2, (Step(STOP_FRAME, Gate.FLIGHT), Step(_MANUAL, Gate.ALONE)))

# docs/reference/protocol.md#stops, stopping, Raspberry Pi
_PI_STEPS: Final = (
    Step(STOP_FRAME, Gate.FLIGHT),
    Step(STOP_FRAME, after_s=0.06),
    Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
)
PI_SOFT: Final = StopSequence("raspberry_pi_soft", 1, _PI_STEPS)
PI: Final = StopSequence("raspberry_pi", 2, _PI_STEPS)

# docs/reference/protocol.md#stops, recovery
RECOVERY: Final = StopSequence(
    "recovery",
    3,
    (
        Step(Reset()),
        Step(_MANUAL, after_s=0.05),
        Step(_MANUAL, after_s=RECOVERY_SILENCE_S - 0.05),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
    ),
)

# docs/reference/protocol.md#stops, platform unknown
UNKNOWN: Final = StopSequence(
    "unknown_platform",
    3,
    (
        Step(STOP_FRAME, Gate.FLIGHT),
        Step(_MANUAL, after_s=0.06),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
        Step(_MANUAL, after_s=RECOVERY_SILENCE_S - REPEAT_INTERVAL_S - 0.06),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
    ),
)

# The same if mode 0 is certain. General stops then stop every platform, even behind an unread frame of ours.
# `MODE00` comes last and alone: in one string with a stop it would undo it, with a servo frame it would open a mode.
UNKNOWN_MANUAL: Final = StopSequence(
    "unknown_platform_manual",
    3,
    (
        Step(STOP_FRAME, Gate.FLIGHT),
        Step(STOP_FRAME, after_s=0.06),
        Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
        Step(_MANUAL, Gate.ALONE, after_s=REPEAT_INTERVAL_S),
        Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
    ),
)

# Tests whether a car in mode 0 receives frames: if so, its reports pause for the second that `MODE00` takes.
PROBE: Final = StopSequence(
    "probe", 3, (Step(_MANUAL, Gate.ALONE), Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S))
)

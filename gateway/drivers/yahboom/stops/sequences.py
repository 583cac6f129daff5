"""The stop sequences as tables of frames and times, by docs/reference/protocol.md#stops. No state."""

from typing import Final

from msgspec import Struct

from gateway.drivers.yahboom.pacing import NAMED_GAP_S, Gate
from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, General, LoneHash, ModeClose
from gateway.drivers.yahboom.protocol.timing import COLOR_S, FRAME_S, RECOVERY_SILENCE_S, REPEAT_INTERVAL_S
from schemas.words import Motion

STOP_REPORT_TIMEOUT_S: Final = 4.5
"""Timeout for a report of mode 0 after a stop: avoidance blocks for 4.3 s."""
# Do not send the general stop while the car may still show that it left its mode: only the last frame can be judged by
# a reading, and that must be `MODE00`. To send the general stop earlier would not help: a `MODE00` that lost its digits
# blocks for at least 2.0 s.
JUDGED_S: Final = 2.3
"""Time from `MODE00` to the general stop if the car was in another mode than 0."""


class Step(Struct, frozen=True):
    """One frame of a sequence. `after_s` is the minimum time after the frame before it, or after the try began."""

    frame: Frame
    gate: Gate = Gate.NOTHING
    after_s: float = 0.0


class StopSequence(Struct, frozen=True):
    """A way to stop. A requested stop replaces the running one only if its `rank` is higher. A recovery always does."""

    name: str
    rank: int
    steps: tuple[Step, ...]

    @property
    def length_s(self) -> float:
        """Return the minimum time from the first frame to the last, s."""
        return sum(step.after_s for step in self.steps)

    @property
    def is_recovery(self) -> bool:
        """Return True if the sequence brings a car in an unknown state to rest, by a lone `#` and `MODE00`."""
        return self.name == RECOVERY.name


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

# FULL for a car in another mode than 0, where it ignores a general stop.
FULL_MODE: Final = StopSequence(
    "full_mode", 2, (Step(_MANUAL, Gate.ALONE), Step(STOP_FRAME, Gate.FLIGHT, after_s=JUDGED_S))
)

# FULL if a frame of ours may be unread. Behind that frame the car would misread `MODE00`, so `MODE00` waits. The
# general stop does not wait: behind an unread frame it is lost without harm, and usually there is no such frame.
FULL_BEHIND: Final = StopSequence("full_behind", 2, (Step(STOP_FRAME, Gate.FLIGHT), Step(_MANUAL, Gate.ALONE)))

# docs/reference/protocol.md#stops, general stops only
_GENERAL_STEPS: Final = (
    Step(STOP_FRAME, Gate.FLIGHT),
    Step(STOP_FRAME, after_s=FRAME_S),
    Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
)
GENERAL_SOFT: Final = StopSequence("general_soft", 1, _GENERAL_STEPS)
GENERAL: Final = StopSequence("general", 2, _GENERAL_STEPS)

# docs/reference/protocol.md#stops, recovery
RECOVERY: Final = StopSequence(
    "recovery",
    3,
    (
        Step(LoneHash()),
        Step(_MANUAL, after_s=0.05),
        Step(_MANUAL, after_s=RECOVERY_SILENCE_S - 0.05),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
    ),
)

# docs/reference/protocol.md#stops, readings contradict the platform
BOTH: Final = StopSequence(
    "both",
    3,
    (
        Step(STOP_FRAME, Gate.FLIGHT),
        Step(_MANUAL, after_s=NAMED_GAP_S),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
        Step(_MANUAL, after_s=RECOVERY_SILENCE_S - REPEAT_INTERVAL_S - NAMED_GAP_S),
        Step(STOP_FRAME, after_s=REPEAT_INTERVAL_S),
    ),
)

# BOTH if mode 0 is certain. Then general stops stop every platform, even behind an unread frame of ours. `MODE00` comes
# later and alone: in one string with a stop it would undo the stop, and with a servo frame it would open a mode.
BOTH_MANUAL: Final = StopSequence(
    "both_manual",
    3,
    (
        Step(STOP_FRAME, Gate.FLIGHT),
        Step(STOP_FRAME, after_s=FRAME_S),
        Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
        Step(_MANUAL, Gate.ALONE, after_s=REPEAT_INTERVAL_S),
        Step(STOP_FRAME, Gate.FLIGHT, after_s=REPEAT_INTERVAL_S),
    ),
)

# Tests whether a car in mode 0 receives frames: if it does, the next report is late by the block of `MODE00`. No
# frame follows, so that the judged frame is the last one.
PROBE: Final = StopSequence("probe", 3, (Step(_MANUAL, Gate.ALONE),))

CONTROL_SHARE: Final = 0.35
"""Time from a report to the control frame, as a share of the interval."""


def control(interval_s: float) -> StopSequence:
    """Return the test that shows whether writing makes the link lose a report: a frame that does not block the car.

    From the last report to this frame passes more time than passed from a report to the `MODE00` before. So if writing
    `MODE00` made the link mute for long enough to hide the next report, writing this frame hides the next one too,
    however much the intervals differ.
    """
    return StopSequence("control", 3, (Step(STOP_FRAME, Gate.FLIGHT, after_s=CONTROL_SHARE * interval_s),))


def clearing(color: ColorLed) -> StopSequence:
    """Return a recovery that also clears a string beginning with `4WD,`, for which it needs a color frame.

    See docs/reference/protocol.md#hazards. A PTZ frame would clear the string, too, but it moves a servo.
    """
    reset, manual, last, stop = RECOVERY.steps
    color_step = Step(color, after_s=last.after_s)
    # The color frame may wait for a ranging before it is read. `MODE00` must not join it in the buffer.
    last = Step(_MANUAL, after_s=REPEAT_INTERVAL_S + COLOR_S)
    return StopSequence(RECOVERY.name, RECOVERY.rank, (reset, manual, color_step, last, stop))

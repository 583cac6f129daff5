"""The speed of the wire and the time for which each frame blocks a car.

Every number is a row of docs/reference/protocol.md#blocking-times unless a comment names another section.
`modes` has the times of the modes.
"""

from typing import Final

from gateway.drivers.yahboom.protocol.frames import ArmSet, ColorLed, Frame, General, LoneHash, ModeClose, ModeOpen, Ptz
from gateway.drivers.yahboom.protocol.modes import MODES

# framing: UART 9600 8N1, so at most 960 bytes/s each way
BYTES_PER_S: Final = 960
# A general frame with only motion, light and speed blocks for 0 s. 0.06 s is also the time between two writes
# (hazards).
FRAME_S: Final = 0.06
WHISTLE_S: Final = 0.30  # whistle
SERVO_S: Final = 0.65  # PTZ, front servo left/right/reset
COLOR_S: Final = 0.10  # color frame
MODE_CLOSE_S: Final = 1.0  # mode closed (`x0`)
RASPBERRY_PI_FAN_S: Final = 1.0  # Raspberry Pi: fan
RANGING_S: Final = 1.0  # once a second in mode 0: a ranging without an echo
REPORT_INTERVAL_S: Final = 1.25  # programs that people have: the interval until that of the car is learned
DIGITLESS_OPEN_S: Final = 2.0  # hazards: a MODE frame that lost its digits opens mode 0, which blocks for 2.0 to 2.3 s
# the longest block outside avoidance: opening a mode, up to 3.5 s
LONGEST_BLOCK_S: Final = max(row.open_s for row in MODES.values())
# Stopping, recovery: after the longest block and a margin of 0.2 s, the last `MODE00` is alone in the car's buffer.
# It is computed, so that the recovery waits longer if a mode opens more slowly.
RECOVERY_SILENCE_S: Final = round(LONGEST_BLOCK_S + 0.2, 3)
"""Time from the first frame of a recovery to its last `MODE00`, or to the color frame if it has one."""
REPEAT_INTERVAL_S: Final = 1.1
"""Minimum interval of two frames after which each is alone in the car's buffer: an unknown block takes up to 1.0 s."""


def block_s(frame: Frame, *, fan_s: float = 0.0) -> float:
    """Return the maximum time for which this frame blocks a car, at least `FRAME_S`. Actions of one frame add up."""
    match frame:
        case General():
            parts = ((frame.whistle, WHISTLE_S), (frame.servo, SERVO_S), (frame.fan, fan_s))
            return max(FRAME_S, sum(block for active, block in parts if active))
        case Ptz() | ArmSet():  # docs/reference/protocol.md has no row for the arm: assumed as one servo
            return SERVO_S
        case ColorLed():
            return COLOR_S
        case ModeOpen(mode):
            return MODES[mode].open_s
        case ModeClose():
            return MODE_CLOSE_S
        case LoneHash():  # docs/reference/protocol.md has no row for it: assumed as a stop, because it acts as one
            return FRAME_S

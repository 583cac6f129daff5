"""How long a car is deaf after each frame and in each mode, and how fast the wire is.

Every number is a row of docs/reference/protocol.md#blocking-times unless another section is named. Who waits for
them is in `control`; which platform a number is for is in `profile`.
"""

from typing import Final

from gateway.protocol.enums import Mode
from gateway.protocol.frames import ArmSet, ColorLed, Frame, General, ModeClose, ModeOpen, Ptz, Reset

# framing: UART 9600 8N1, so at most 960 bytes/s each way
BYTES_PER_S: Final = 960
# general frame with motion, light, speed only: 0, but allow 0.06 s; also the 60 ms between two writes (hazards)
FRAME_S: Final = 0.06
WHISTLE_S: Final = 0.30  # whistle
SERVO_S: Final = 0.65  # PTZ, front servo left/right/reset
COLOR_S: Final = 0.10  # colour frame
MODE_CLOSE_S: Final = 1.0  # mode closed (`x0`)
RASPBERRY_PI_FAN_S: Final = 1.0  # Raspberry Pi: fan
LONGEST_BLOCK_S: Final = 3.5  # the longest block outside avoidance is 3.5 s

# the longest turn of each mode's own loop
MODE_TURN_S: Final = {
    Mode.MANUAL: 1.0,  # once a second in mode 0, the report itself: 1.0 s if the ranging gets no echo
    Mode.REMOTE_CONTROL: 0.1,  # no row: taken as the modes that only read pins
    Mode.TRACKING: 0.1,  # tracking, light seeking, following: up to 0.1 s per turn
    Mode.OBSTACLE_AVOIDANCE: 4.3,  # near an obstacle 4.3 s (with no echo at all for ever, motors braked)
    Mode.COLOR_LED: 0.75,  # colour LED mode: 0.75 s per turn
    Mode.LIGHT_SEEKING: 0.1,
    Mode.FOLLOWING: 0.1,
}

# readings, observed rates: frames per second at most; the other modes are silent
RATE_HZ: Final = {Mode.MANUAL: 1.0, Mode.TRACKING: 27.0, Mode.LIGHT_SEEKING: 23.0, Mode.FOLLOWING: 24.0}


def mode_open_s(mode: Mode) -> float:
    """How long opening a mode blocks: 2.1 s + 0.2 s x (x + 1), so 2.5 to 3.5 s (mode opened (`x1`))."""
    return 2.1 + 0.2 * (mode.digit + 1)


def block_s(frame: Frame, *, fan_s: float = 0.0) -> float:
    """How long a car may be blocked after this frame; what one frame does adds up. At least `FRAME_S`."""
    match frame:
        case General():
            parts = ((frame.whistle, WHISTLE_S), (frame.servo, SERVO_S), (frame.fan, fan_s))
            return max(FRAME_S, sum(block for asked, block in parts if asked))
        case Ptz() | ArmSet():  # the arm has no row: as one servo
            return SERVO_S
        case ColorLed():
            return COLOR_S
        case ModeOpen(mode):
            return mode_open_s(mode)
        case ModeClose():
            return MODE_CLOSE_S
        case Reset():  # no row: as the stop that it acts as
            return FRAME_S

"""The closed sets of words in frames and readings.

The words are those of the messages. The digits are those of the protocol table; the digits of a mode are in `modes`.
"""

from enum import StrEnum


class Motion(StrEnum):
    """A motion of the wheels: places 1 and 2 of the general frame."""

    STOP = "stop"
    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    SPIN_LEFT = "spin_left"
    SPIN_RIGHT = "spin_right"

    @property
    def digits(self) -> tuple[int, int]:
        """Places 1 (motion) and 2 (rotate in place); a spin leaves place 1 at 0."""
        return _MOTION_DIGITS[self]


class Mode(StrEnum):
    """A mode of the car's program. In `MANUAL`, mode 0, the app drives. Each mode has a row in `modes.MODES`."""

    MANUAL = "manual"
    REMOTE_CONTROL = "remote_control"
    TRACKING = "tracking"
    OBSTACLE_AVOIDANCE = "obstacle_avoidance"
    COLOR_LED = "color_led"
    LIGHT_SEEKING = "light_seeking"
    FOLLOWING = "following"


class Light(StrEnum):
    """A color of the light: place 7 of the general frame."""

    WHITE = "white"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    CYAN = "cyan"
    MAGENTA = "magenta"
    YELLOW = "yellow"
    OFF = "off"

    @property
    def digit(self) -> int:
        """1..8; 0 means no change."""
        return _LIGHT_DIGITS[self]


class ServoAction(StrEnum):
    """One movement of one servo: place 5 of the general frame, or place 9 for `FRONT_RESET`."""

    FRONT_LEFT = "front_left"
    FRONT_RIGHT = "front_right"
    VERTICAL_UP = "vertical_up"
    VERTICAL_DOWN = "vertical_down"
    VERTICAL_RESET = "vertical_reset"
    HORIZONTAL_LEFT = "horizontal_left"
    HORIZONTAL_RIGHT = "horizontal_right"
    HORIZONTAL_RESET = "horizontal_reset"
    FRONT_RESET = "front_reset"

    @property
    def digits(self) -> tuple[int, int]:
        """Places 5 (servos) and 9 (servo reset)."""
        return _SERVO_DIGITS[self]


class SpeedStep(StrEnum):
    """A step of the speed, which is only relative: place 4 of the general frame."""

    UP = "up"
    DOWN = "down"

    @property
    def digit(self) -> int:
        """1 accelerates, 2 decelerates; 0 means keep."""
        return 1 if self is SpeedStep.UP else 2


class Cause(StrEnum):
    """Why bytes are not a reading (docs/reference/protocol.md#bad-input)."""

    NO_START = "no_start"
    OVERLONG = "overlong"
    UNKNOWN_WORD = "unknown_word"
    MISSING_WORD = "missing_word"
    BAD_NUMBER = "bad_number"
    OUT_OF_RANGE = "out_of_range"
    TRUNCATED = "truncated"


_MOTION_DIGITS = {
    Motion.STOP: (0, 0),
    Motion.FORWARD: (1, 0),
    Motion.BACK: (2, 0),
    Motion.LEFT: (3, 0),
    Motion.RIGHT: (4, 0),
    Motion.SPIN_LEFT: (0, 1),
    Motion.SPIN_RIGHT: (0, 2),
}
_LIGHT_DIGITS = {
    Light.WHITE: 1,
    Light.RED: 2,
    Light.GREEN: 3,
    Light.BLUE: 4,
    Light.CYAN: 5,
    Light.MAGENTA: 6,
    Light.YELLOW: 7,
    Light.OFF: 8,
}
_SERVO_DIGITS = {
    ServoAction.FRONT_LEFT: (1, 0),
    ServoAction.FRONT_RIGHT: (2, 0),
    ServoAction.VERTICAL_UP: (3, 0),
    ServoAction.VERTICAL_DOWN: (4, 0),
    ServoAction.VERTICAL_RESET: (5, 0),
    ServoAction.HORIZONTAL_LEFT: (6, 0),
    ServoAction.HORIZONTAL_RIGHT: (7, 0),
    ServoAction.HORIZONTAL_RESET: (8, 0),
    ServoAction.FRONT_RESET: (0, 1),
}

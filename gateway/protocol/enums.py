"""The closed sets of words that frames and readings are made of, with their digits on the wire.

The words are those of the messages; the digits are those of the protocol table. No framing and no ranges live here.
"""

from enum import StrEnum


class Motion(StrEnum):
    """What the wheels do. Places 1 and 2 of the general frame."""

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
    """What the car's program does by itself; `MANUAL` is mode 0, the app's control."""

    MANUAL = "manual"
    REMOTE_CONTROL = "remote_control"
    TRACKING = "tracking"
    OBSTACLE_AVOIDANCE = "obstacle_avoidance"
    COLOR_LED = "color_led"
    LIGHT_SEEKING = "light_seeking"
    FOLLOWING = "following"

    @property
    def digit(self) -> int:
        """The x of `MODE<x><y>`, 0..6."""
        return _MODE_DIGITS[self]


class Light(StrEnum):
    """Place 7 of the general frame."""

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
    """Place 4 of the general frame: speed is only ever relative."""

    UP = "up"
    DOWN = "down"

    @property
    def digit(self) -> int:
        """1 accelerates, 2 decelerates; 0 means keep."""
        return 1 if self is SpeedStep.UP else 2


_MOTION_DIGITS = {
    Motion.STOP: (0, 0),
    Motion.FORWARD: (1, 0),
    Motion.BACK: (2, 0),
    Motion.LEFT: (3, 0),
    Motion.RIGHT: (4, 0),
    Motion.SPIN_LEFT: (0, 1),
    Motion.SPIN_RIGHT: (0, 2),
}
_MODE_DIGITS = {mode: digit for digit, mode in enumerate(Mode)}
_LIGHT_DIGITS = {light: digit for digit, light in enumerate(Light, start=1)}
_SERVO_DIGITS = {action: (digit, 0) for digit, action in enumerate(ServoAction, start=1)} | {
    ServoAction.FRONT_RESET: (0, 1)
}

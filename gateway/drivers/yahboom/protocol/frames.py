"""The frames to the car: one class per frame in docs/reference/protocol.md, and their conversion to bytes and back.

`platforms` says which cars understand a frame. `gateway.control` and the driver decide when it is sent.
"""

import re
from enum import StrEnum
from typing import Final, TypeVar

from msgspec import Struct

from gateway.drivers.yahboom.protocol.modes import MODES
from schemas.words import Light, Mode, Motion, ServoAction, SpeedStep

STANDARD_HEAD: Final = "4WD"
ARM_JOINTS: Final = 6
DEG_MAX: Final = 180  # docs/reference/protocol.md#named-frames: PTZ and joints 0..180 degrees
COLOR_MAX: Final = 255  # docs/reference/protocol.md#named-frames: color LED 0..255 each


class EncodeError(ValueError):
    """A value that docs/reference/protocol.md does not allow. The message names the field, the value and the range."""


class Dialect(Struct, frozen=True):
    """The spelling of the frames of one program.

    `head` is the first word of readings and of named frames (all but `General` and `LoneHash`). With
    `swaps_green_and_blue`, place 7 has 3 for blue and 4 for green
    (docs/reference/protocol.md#programs-that-people-have).
    """

    head: str = STANDARD_HEAD
    swaps_green_and_blue: bool = False


STANDARD: Final = Dialect()


class General(Struct, frozen=True):
    """The nine-field frame. It always carries a motion.

    All other fields but `light` are one-shot: if they are sent again, they act again (the fan toggles, the speed
    increases). To a program with `Profile.fan_is_level`, `fan` is no one-shot: True turns the fan on, False off.
    """

    motion: Motion
    whistle: bool = False
    speed: SpeedStep | None = None
    servo: ServoAction | None = None
    sing: bool = False
    light: Light | None = None
    fan: bool = False


class Ptz(Struct, frozen=True):
    """The angle of the front servo, 0..180 degrees, as on the wire.

    The vendor's programs drive the servo to 180 - deg, some forks to deg (`Profile.ptz_direct`).
    """

    deg: int


class ColorLed(Struct, frozen=True):
    """The color LED, 0..255 each."""

    r: int
    g: int
    b: int


class ModeOpen(Struct, frozen=True):
    """Enter a mode. `Mode.MANUAL` (`MODE01`) is not allowed."""

    mode: Mode


class ModeClose(Struct, frozen=True):
    """Stop the motors and return to mode 0. `Mode.MANUAL` (`MODE00`) closes any mode."""

    mode: Mode = Mode.MANUAL


class ArmSet(Struct, frozen=True):
    """The six joints of an arm, 0..180 degrees each."""

    joint_deg: tuple[int, ...]


class LoneHash(Struct, frozen=True):
    """A lone `#`. It ends half a frame in the car's buffer, and the car obeys the motion of that half.

    If the buffer is empty, it stops a car in mode 0.
    """


_Word = TypeVar("_Word", bound=StrEnum)
Frame = General | Ptz | ColorLed | ModeOpen | ModeClose | ArmSet | LoneHash


def encode(frame: Frame, dialect: Dialect = STANDARD) -> bytes:
    """Return the bytes of a frame. Raises EncodeError for a value that the protocol does not allow."""
    match frame:
        case General():
            return _encode_general(frame, dialect)
        case LoneHash():
            return b"#"
        case _:
            return b"$%b,%b#" % (dialect.head.encode(), _encode_named(frame))


def _encode_named(frame: Ptz | ColorLed | ModeOpen | ModeClose | ArmSet) -> bytes:
    match frame:
        case Ptz(deg):
            return b"PTZ%d" % _check_range("deg", deg, DEG_MAX)
        case ColorLed(r, g, b):
            rgb = (_check_range("r", r, COLOR_MAX), _check_range("g", g, COLOR_MAX), _check_range("b", b, COLOR_MAX))
            return b"CLR%d,CLG%d,CLB%d" % rgb
        case ModeOpen(mode):
            digit = MODES[_check_member("mode", mode, Mode)].digit
            if not digit:
                words = "Close a mode with ModeClose, or open one of the other six"
                raise EncodeError(f"mode: manual cannot be opened (MODE01). {words}")
            return b"MODE%d1" % digit
        case ModeClose(mode):
            return b"MODE%d0" % MODES[_check_member("mode", mode, Mode)].digit
        case ArmSet(joints):
            if len(joints) != ARM_JOINTS:
                raise EncodeError(f"joint_deg: {len(joints)} values, allowed are {ARM_JOINTS}, each 0..{DEG_MAX}")
            degs = tuple(_check_range(f"joint_deg[{i}]", deg, DEG_MAX) for i, deg in enumerate(joints))
            return b"ServoJ1%d,J2%d,J3%d,J4%d,J5%d,J6%d" % degs


def parse_sent(data: bytes, dialect: Dialect = STANDARD) -> Frame | None:
    """Return the frame with these bytes. None if they are not one whole frame of the protocol.

    Rotation takes precedence over place 1, as in the car. Return None also for frames that a `Frame` cannot express:
    MODE01, and a servo that moves (place 5) and resets (place 9) at once.
    """
    if data == b"#":
        return LoneHash()
    if found := _GENERAL.fullmatch(data):
        return _parse_general(dialect, *map(int, found.groups()))
    head = f"${dialect.head},".encode()
    if data.startswith(head) and (found := _NAMED.fullmatch(data, len(head))):
        frame = _parse_named({name: int(text) for name, text in found.groupdict().items() if text is not None})
        try:
            encode(frame)  # the pattern allows numbers that are out of range
        except EncodeError:
            return None
        return frame
    return None


def _encode_general(frame: General, dialect: Dialect) -> bytes:
    run, spin = _MOTION_DIGITS[_check_member("motion", frame.motion, Motion)]
    speed = 0 if frame.speed is None else _SPEED_DIGITS[_check_member("speed", frame.speed, SpeedStep)]
    servo, reset = (0, 0) if frame.servo is None else _SERVO_DIGITS[_check_member("servo", frame.servo, ServoAction)]
    light = 0 if frame.light is None else _light_digit(_check_member("light", frame.light, Light), dialect)
    places = (run, spin, bool(frame.whistle), speed, servo, bool(frame.sing), light, bool(frame.fan), reset)
    return b"$%d,%d,%d,%d,%d,%d,%d,%d,%d#" % places


def _light_digit(light: Light, dialect: Dialect) -> int:
    return _LIGHT_DIGITS[_SWAPPED.get(light, light) if dialect.swaps_green_and_blue else light]


def _check_range(field: str, value: int, top: int) -> int:
    if type(value) is not int or not 0 <= value <= top:
        raise EncodeError(f"{field}: {value!r}, allowed are whole numbers 0..{top}")
    return value


def _check_member(field: str, value: _Word, kind: type[_Word]) -> _Word:
    if not isinstance(value, kind):
        raise EncodeError(f"{field}: {value!r}, allowed are {', '.join(kind)}")
    return value


def _parse_general(
    dialect: Dialect,
    run: int,
    spin: int,
    whistle: int,
    speed: int,
    servo: int,
    sing: int,
    light: int,
    fan: int,
    reset: int,
) -> General | None:
    if servo and reset:
        return None
    color = _LIGHT_AT.get(light)
    return General(
        motion=_MOTION_AT[(0, spin) if spin else (run, 0)],
        whistle=bool(whistle),
        speed=_SPEED_AT.get(speed),
        servo=_SERVO_AT.get((servo, reset)),
        sing=bool(sing),
        light=_SWAPPED.get(color, color) if color and dialect.swaps_green_and_blue else color,
        fan=bool(fan),
    )


def _parse_named(value: dict[str, int]) -> Frame:
    if "deg" in value:
        return Ptz(value["deg"])
    if "r" in value:
        return ColorLed(value["r"], value["g"], value["b"])
    if "mode" in value:
        mode = _MODE_AT[value["mode"]]
        return ModeOpen(mode) if value["open"] else ModeClose(mode)
    return ArmSet(tuple(value[f"j{joint}"] for joint in range(1, ARM_JOINTS + 1)))


# docs/reference/protocol.md#general-frame
_MOTION_DIGITS: Final = {
    Motion.STOP: (0, 0),
    Motion.FORWARD: (1, 0),
    Motion.BACK: (2, 0),
    Motion.LEFT: (3, 0),
    Motion.RIGHT: (4, 0),
    Motion.SPIN_LEFT: (0, 1),
    Motion.SPIN_RIGHT: (0, 2),
}
"""Places 1 (motion) and 2 (rotate in place); a spin leaves place 1 at 0."""
_SPEED_DIGITS: Final = {SpeedStep.UP: 1, SpeedStep.DOWN: 2}
"""Place 4; 0 keeps the speed."""
_SERVO_DIGITS: Final = {
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
"""Places 5 (servos) and 9 (servo reset)."""
_LIGHT_DIGITS: Final = {
    Light.WHITE: 1,
    Light.RED: 2,
    Light.GREEN: 3,
    Light.BLUE: 4,
    Light.CYAN: 5,
    Light.MAGENTA: 6,
    Light.YELLOW: 7,
    Light.OFF: 8,
}
"""Place 7; 0 means no change."""

_MOTION_AT = {digits: motion for motion, digits in _MOTION_DIGITS.items()}
_SPEED_AT = {digit: step for step, digit in _SPEED_DIGITS.items()}
_SERVO_AT = {digits: action for action, digits in _SERVO_DIGITS.items()}
_LIGHT_AT = {digit: light for light, digit in _LIGHT_DIGITS.items()}
_SWAPPED = {Light.GREEN: Light.BLUE, Light.BLUE: Light.GREEN}
_MODE_AT = {row.digit: mode for mode, row in MODES.items()}

# Nine one-digit fields, always all nine (docs/reference/protocol.md#general-frame).
_GENERAL = re.compile(rb"\$([0-4]),([0-2]),([01]),([0-2]),([0-8]),([01]),([0-8]),([01]),([01])#")
# docs/reference/protocol.md#named-frames
_NAMED = re.compile(
    rb"(?:PTZ(?P<deg>\d{1,3})"
    rb"|CLR(?P<r>\d{1,3}),CLG(?P<g>\d{1,3}),CLB(?P<b>\d{1,3})"
    rb"|MODE(?P<mode>[%b])(?P<open>[01])"
    rb"|ServoJ1(?P<j1>\d{1,3}),J2(?P<j2>\d{1,3}),J3(?P<j3>\d{1,3}),J4(?P<j4>\d{1,3}),J5(?P<j5>\d{1,3}),J6(?P<j6>\d{1,3})"
    rb")#" % b"".join(b"%d" % digit for digit in _MODE_AT)
)

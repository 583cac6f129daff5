"""The sensors frame: a table of its fields in wire order, its reading (`Sensors`), and the parser that makes one.

The parser, the published messages and the signatures of the modes (`modes`) follow from the table. A new field is a row
of `SENSOR_FIELDS`, an attribute of `Sensors`, and a variable in `read_sensors`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from schemas.words import Cause

Value = bool | int | float | tuple[float, ...]
Fields = dict[str, Value]
"""The values of one message, by field."""

RANGE_STEP_M: Final = 0.0001
"""Resolution of a published distance: cars send hundredths of a centimeter."""
_BITS_2: Final = {b"%d%d" % (a, b): (bool(a), bool(b)) for a in (0, 1) for b in (0, 1)}
_BITS_4: Final = {left + right: (*_BITS_2[left], *_BITS_2[right]) for left in _BITS_2 for right in _BITS_2}


class SensorField(Struct, frozen=True):
    """One field of the sensors frame.

    `measurement` is its name in modes, profiles, conditions and in its topic `sensor/<measurement>`. `attribute` is its
    name in `Sensors`, `word` its name in the frame. `pattern` matches the text of its value. `read` turns that text
    into the value, or into None for bits that are neither 0 nor 1. `to_message` turns the value into the fields of its
    message. `maximum` is the upper end of the range of a number; the lower end is 0.
    """

    measurement: str
    attribute: str
    word: bytes
    pattern: bytes
    read: Callable[[bytes], Any]
    to_message: Callable[[Any], Fields]
    maximum: float | None = None

    @property
    def topic(self) -> str:
        """The topic of the messages with this field."""
        return f"sensor/{self.measurement}"

    def accepts(self, text: bytes) -> bool:
        """Return True if a text that matches the pattern is in range."""
        value = self.read(text)
        return value is not None and (self.maximum is None or value <= self.maximum)


def _range(range_cm: float) -> Fields:
    # A range of 0 is no echo, not a distance (docs/reference/protocol.md#ranges). So no distance is rounded to 0.
    return {"no_echo": False, "range_m": max(RANGE_STEP_M, round(range_cm / 100, 4))} if range_cm else {"no_echo": True}


def _line(bits: tuple[bool, bool, bool, bool]) -> Fields:
    return dict(zip(("left_outer", "left_inner", "right_inner", "right_outer"), bits, strict=True))


def _sides(bits: tuple[bool, bool]) -> Fields:
    return {"left": bits[0], "right": bits[1]}


# docs/reference/protocol.md#ranges and docs/reference/protocol.md#spellings. Numbers have no sign, and only CSB and PV
# have decimals. A field of bits may contain any digit here; `read` rejects those that are not 0 or 1. The maxima are
# the highest of any car: a battery of three cells, a grayscale of 12 bits. `Profile` has the maxima of one car.
SENSOR_FIELDS: Final = (
    SensorField("range", "range_cm", b"CSB", rb"[0-9]+(?:\.[0-9]+)?", float, _range, 1200.0),
    SensorField(
        "battery", "voltage_v", b"PV", rb"[0-9]+(?:\.[0-9]+)?", float, lambda volts: {"voltage_v": volts}, 13.0
    ),
    SensorField("grayscale", "grayscale", b"GS", rb"[0-9]+", int, lambda raw: {"raw": raw}, 4095),
    SensorField("line", "line", b"LF", rb"[0-9]{4}", _BITS_4.get, _line),
    SensorField("obstacle", "obstacle", b"HW", rb"[0-9]{2}", _BITS_2.get, _sides),
    SensorField("light", "light", b"GM", rb"[0-9]{2}", _BITS_2.get, _sides),
)


class FrameWords(Struct, frozen=True):
    """The words of one kind of frame, in wire order."""

    words: tuple[bytes, ...]

    def missing(self, found: Sequence[bytes]) -> list[bytes]:
        """Return the words that the frame must have and does not have."""
        return [word for word in self.words if word not in found]

    def are_in_order(self, found: Sequence[bytes]) -> bool:
        """Return True if a frame has exactly these words, each once and in its place."""
        return tuple(found) == self.words


SENSOR_WORDS: Final = FrameWords(tuple(field.word for field in SENSOR_FIELDS))
ATTRIBUTES: Final = {field.measurement: field.attribute for field in SENSOR_FIELDS}


class RejectedField(Struct, frozen=True):
    """One field of a good frame whose value is out of its range. `word` is its name in the frame."""

    word: str
    text: str
    cause: Cause = Cause.OUT_OF_RANGE


class Sensors(Struct, frozen=True):
    """The sensors frame, each field as on the wire. None where the field was rejected.

    `at` is the time of its last byte. `range_cm` 0 means no echo, not a distance. `line` is left-outer, left-inner,
    right-inner, right-outer. In mode following, the car sends `obstacle` inverted; `Profile.obstacle` undoes that. In
    most modes, some fields are constant filler; `Profile.measured` tells which fields are measured.
    `modes.candidate_modes` tells which modes send this text.
    """

    raw: bytes
    at: float
    range_cm: float | None
    voltage_v: float | None
    grayscale: int | None
    line: tuple[bool, bool, bool, bool] | None
    obstacle: tuple[bool, bool] | None
    light: tuple[bool, bool] | None
    rejects: tuple[RejectedField, ...] = ()
    terminated: bool = True
    """True if the frame ends with `#`."""
    by_silence: bool = False
    """True if the frame has no `#`, and no byte came after it for 50 ms or until the link ended. The `#` may still
    come."""


# `read_sensors` reads the fields one by one, because a loop over the table would take 1.5 us more per frame: a third of
# the decoding.
_RANGE, _BATTERY, _GRAYSCALE, _LINE, _OBSTACLE, _LIGHT = SENSOR_FIELDS
_CSB_MAX, _PV_MAX, _GS_MAX = _RANGE.maximum or 0.0, _BATTERY.maximum or 0.0, _GRAYSCALE.maximum or 0.0
# Bind these once here, because looking a method up in the function takes longer in CPython 3.11.
_read_line, _read_obstacle, _read_light = _LINE.read, _OBSTACLE.read, _LIGHT.read
assert tuple(field.attribute for field in SENSOR_FIELDS) == Sensors.__struct_fields__[2:8], (
    "Sensors: the table's fields, in order"
)


def read_sensors(found: re.Match[bytes], at: float, *, terminated: bool = True, by_silence: bool = False) -> Sensors:
    """Return the reading of a match of `sensors_pattern`. Fields out of range are None, and listed in `rejects`."""
    csb, pv, gs, lf, hw, gm = texts = found.groups()
    range_cm, voltage_v, grayscale = float(csb), float(pv), int(gs)
    line, obstacle, light = _read_line(lf), _read_obstacle(hw), _read_light(gm)
    reading = Sensors(found[0], at, range_cm, voltage_v, grayscale, line, obstacle, light, (), terminated, by_silence)
    # Each field of bits is a tuple, which is true even if all its bits are False, or None if it cannot be read.
    if range_cm <= _CSB_MAX and voltage_v <= _PV_MAX and grayscale <= _GS_MAX and line and obstacle and light:
        return reading
    rejected = [(field, text) for field, text in zip(SENSOR_FIELDS, texts, strict=True) if not field.accepts(text)]
    rejects = tuple(RejectedField(field.word.decode(), text.decode()) for field, text in rejected)
    removed: dict[str, Any] = dict.fromkeys((field.attribute for field, _ in rejected), None)
    return replace(reading, rejects=rejects, **removed)


def sensors_pattern(filler: Mapping[str, bytes] | None = None, *, head: bytes = b"[0-9A-Za-z]+") -> bytes:
    """Return the pattern of a sensors frame without its `#`, one group per field.

    `filler` is the exact text of some fields, by measurement. `head` is the pattern of its first word.
    """
    texts = {name: re.escape(text) for name, text in (filler or {}).items()}
    return (
        rb"\$"
        + head
        + b"".join(b",%b(%b)" % (field.word, texts.get(field.measurement, field.pattern)) for field in SENSOR_FIELDS)
    )


class SensorsMatcher:
    """Matches the sensors frames that begin with one head: the first word of a frame, such as `4WD`."""

    def __init__(self, head: str) -> None:
        text = sensors_pattern(head=re.escape(head.encode()))
        self.match_ended = re.compile(text + rb"#").match
        """Matches a frame with its `#` at a position."""
        self.fullmatch_unended = re.compile(text).fullmatch
        """Matches a frame without its `#`."""

    def is_complete(self, raw: bytes | bytearray) -> bool:
        """Return True if these bytes are a whole sensors frame that only lacks its `#`."""
        return SENSOR_FIELDS[-1].word in raw and self.fullmatch_unended(raw) is not None


@cache
def sensors_matcher(head: str) -> SensorsMatcher:
    """Return the matcher for a head."""
    return SensorsMatcher(head)


_ANY_HEAD: Final = re.compile(sensors_pattern(head=rb"([A-Za-z0-9]{2,8})") + rb"#?")


def head_of(raw: bytes) -> str | None:
    """Return the first word of a sensors frame with any head. None if these bytes are not a sensors frame."""
    found = _ANY_HEAD.fullmatch(raw)
    return found[1].decode() if found else None

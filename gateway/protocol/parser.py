"""Parses one whole frame from the car into its reading, or into the cause of its rejection.

`decoder` finds the frames in a stream.
"""

import re
from typing import Any, Final

from gateway.protocol.events import ArmReading, Cause, Event, ImuReading, Reject, Rejected, Sensors
from gateway.protocol.sensor_fields import SENSOR_FIELDS, sensors_pattern

JOINT_MAX: Final = 180.0  # docs/reference/protocol.md#ranges: "ranges a reading must be in"

_SENSORS_TEXT: Final = sensors_pattern()
match_ended_sensors = re.compile(_SENSORS_TEXT + rb"#").match
fullmatch_sensors = re.compile(_SENSORS_TEXT).fullmatch

_SENSORS: Final = tuple(field.word for field in SENSOR_FIELDS)
_ARM: Final = (b"J1", b"J2", b"J3", b"J4", b"J5", b"J6")
_IMU: Final = (b"MPUgx", b"MPUgy", b"MPUgz", b"MPUax", b"MPUay", b"MPUaz")
_WORD: Final = re.compile(rb"(%b|(?:Servo)?J1|J[2-6]|MPU[ga][xyz])(.*)" % b"|".join(_SENSORS), re.DOTALL)
_UNSIGNED, _SIGNED = re.compile(rb"[0-9]+(?:\.[0-9]+)?"), re.compile(rb"-?[0-9]+(?:\.[0-9]+)?")
_NUMBER: Final = {
    **{field.word: re.compile(field.pattern) for field in SENSOR_FIELDS},
    **dict.fromkeys(_ARM, _UNSIGNED),
    **dict.fromkeys(_IMU, _SIGNED),
}
# Unpacked by hand below: a loop over the table would take 1.5 us more per frame, a third of the decoding.
_RANGE, _BATTERY, _GRAYSCALE, _LINE, _OBSTACLE, _LIGHT = SENSOR_FIELDS
_CSB_MAX, _PV_MAX, _GS_MAX = _RANGE.maximum or 0.0, _BATTERY.maximum or 0.0, _GRAYSCALE.maximum or 0.0
# Bound here once: CPython 3.11 takes longer for a method of an imported name in the function.
_read_line, _read_obstacle, _read_light = _LINE.read, _OBSTACLE.read, _LIGHT.read
assert tuple(field.attribute for field in SENSOR_FIELDS) == Sensors._fields[2:8], (
    "Sensors: the table's fields, in order"
)


def read_sensors(found: re.Match[bytes], at: float, *, terminated: bool = True, by_silence: bool = False) -> Sensors:
    """Return the reading of a match of a sensors pattern; reject each field that is out of range."""
    csb, pv, gs, lf, hw, gm = texts = found.groups()
    range_cm, voltage_v, grayscale = float(csb), float(pv), int(gs)
    line, obstacle, light = _read_line(lf), _read_obstacle(hw), _read_light(gm)
    reading = Sensors(found[0], at, range_cm, voltage_v, grayscale, line, obstacle, light, (), terminated, by_silence)
    if range_cm <= _CSB_MAX and voltage_v <= _PV_MAX and grayscale <= _GS_MAX and line and obstacle and light:
        return reading
    rejected = [(field, text) for field, text in zip(SENSOR_FIELDS, texts, strict=True) if not field.accepts(text)]
    rejects = tuple(Reject(field.word.decode(), text.decode()) for field, text in rejected)
    without: dict[str, Any] = dict.fromkeys((field.attribute for field, _ in rejected), None)
    return reading._replace(rejects=rejects, **without)


def is_complete(raw: bytes | bytearray) -> bool:
    """Return True if these bytes are a whole sensors frame that only lacks its `#`."""
    return _SENSORS[-1] in raw and fullmatch_sensors(raw) is not None


def parse(raw: bytes, at: float) -> Event:
    """Return the event of one frame, whose `raw` goes from its `$` to its `#`; never raise."""
    if found := match_ended_sensors(raw):
        return read_sensors(found, at)
    head, *fields = raw[1:-1].split(b",")
    if head != b"4WD":
        return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_printable(head)} is not 4WD")
    words: list[bytes] = []
    texts: list[bytes] = []
    for field in fields:
        found = _WORD.fullmatch(field)
        if not found:
            return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_printable(field)} begins with no word of the table")
        words.append(found[1].removeprefix(b"Servo"))
        texts.append(found[2])
    table = next((known for known in (_SENSORS, _ARM, _IMU) if words and words[0] in known), _SENSORS)
    if missing := [word.decode() for word in table if word not in words]:
        return Rejected(raw, at, Cause.MISSING_WORD, f"no {', '.join(missing)}")
    if tuple(words) != table:
        return Rejected(raw, at, Cause.UNKNOWN_WORD, "a word twice, out of its order, or of another frame")
    for word, text in zip(words, texts, strict=True):
        if not _NUMBER[word].fullmatch(text):
            return Rejected(raw, at, Cause.BAD_NUMBER, f"{word.decode()} {_printable(text)}")
    if table is _ARM:
        degs = [float(text) for text in texts]
        rejects = (Reject(f"J{i}", texts[i - 1].decode()) for i, deg in enumerate(degs, 1) if deg > JOINT_MAX)
        return ArmReading(raw, at, tuple(deg if deg <= JOINT_MAX else None for deg in degs), tuple(rejects))
    gx, gy, gz, ax, ay, az = map(float, texts)
    return ImuReading(raw, at, (gx, gy, gz), (ax, ay, az))


def _printable(text: bytes) -> str:
    return ascii(text[:20].decode("ascii", "backslashreplace"))

"""One whole frame from the car, to its reading or the cause why it is none.

Finding frames in a stream is not done here (see `decode`).
"""

import re
from typing import Final

from gateway.protocol.events import ArmReading, Cause, Event, ImuReading, Reject, Rejected, Sensors

# docs/reference/protocol.md#ranges
CSB_MAX: Final = 1200.0
PV_MAX: Final = 12.0
GS_MAX: Final = 1023
JOINT_MAX: Final = 180.0

# An unsigned number, decimals only for CSB and PV, bits as digits (docs/reference/protocol.md#spellings). `[0-9]` in a
# bytes pattern is ASCII only.
_SENSORS_TEXT = (
    rb"\$4WD,CSB([0-9]+(?:\.[0-9]+)?),PV([0-9]+(?:\.[0-9]+)?),GS([0-9]+),LF([0-9]{4}),HW([0-9]{2}),GM([0-9]{2})"
)
match_ended_sensors = re.compile(_SENSORS_TEXT + rb"#").match
fullmatch_sensors = re.compile(_SENSORS_TEXT).fullmatch

_WORD = re.compile(rb"(CSB|PV|GS|LF|HW|GM|(?:Servo)?J1|J[2-6]|MPU[ga][xyz])(.*)", re.DOTALL)
_SENSORS = (b"CSB", b"PV", b"GS", b"LF", b"HW", b"GM")
_ARM = (b"J1", b"J2", b"J3", b"J4", b"J5", b"J6")
_IMU = (b"MPUgx", b"MPUgy", b"MPUgz", b"MPUax", b"MPUay", b"MPUaz")
_UNSIGNED, _SIGNED = re.compile(rb"[0-9]+(?:\.[0-9]+)?"), re.compile(rb"-?[0-9]+(?:\.[0-9]+)?")
_NUMBER = {
    b"CSB": _UNSIGNED,
    b"PV": _UNSIGNED,
    b"GS": re.compile(rb"[0-9]+"),
    b"LF": re.compile(rb"[0-9]{4}"),
    b"HW": re.compile(rb"[0-9]{2}"),
    b"GM": re.compile(rb"[0-9]{2}"),
    **dict.fromkeys(_ARM, _UNSIGNED),
    **dict.fromkeys(_IMU, _SIGNED),
}

_BOTH = {b"%d%d" % (a, b): (bool(a), bool(b)) for a in (0, 1) for b in (0, 1)}
_FOUR = {left + right: (*_BOTH[left], *_BOTH[right]) for left in _BOTH for right in _BOTH}


def sensors(found: re.Match[bytes], at: float, *, terminated: bool = True, by_silence: bool = False) -> Sensors:
    """The reading of a match of a sensors pattern; fields out of range are rejected one by one."""
    csb, pv, gs, lf, hw, gm = found.groups()
    range_cm, voltage_v, grayscale = float(csb), float(pv), int(gs)
    line, obstacle, light = _FOUR.get(lf), _BOTH.get(hw), _BOTH.get(gm)
    good = Sensors(found[0], at, range_cm, voltage_v, grayscale, line, obstacle, light, (), terminated, by_silence)
    if range_cm <= CSB_MAX and voltage_v <= PV_MAX and grayscale <= GS_MAX and line and obstacle and light:
        return good
    checks = (
        ("CSB", csb, range_cm <= CSB_MAX),
        ("PV", pv, voltage_v <= PV_MAX),
        ("GS", gs, grayscale <= GS_MAX),
        ("LF", lf, line),
        ("HW", hw, obstacle),
        ("GM", gm, light),
    )
    return good._replace(
        range_cm=range_cm if range_cm <= CSB_MAX else None,
        voltage_v=voltage_v if voltage_v <= PV_MAX else None,
        grayscale=grayscale if grayscale <= GS_MAX else None,
        rejects=tuple(Reject(word, text.decode()) for word, text, in_range in checks if not in_range),
    )


def parse(raw: bytes, at: float) -> Event:
    """The event of one frame, `raw` from its `$` up to its `#`; never raises."""
    if found := match_ended_sensors(raw):
        return sensors(found, at)
    head, *fields = raw[1:-1].split(b",")
    if head != b"4WD":
        return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_shown(head)} is not 4WD")
    words: list[bytes] = []
    texts: list[bytes] = []
    for field in fields:
        found = _WORD.fullmatch(field)
        if not found:
            return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_shown(field)} begins with no word of the table")
        words.append(found[1].removeprefix(b"Servo"))
        texts.append(found[2])
    table = next((known for known in (_SENSORS, _ARM, _IMU) if words and words[0] in known), _SENSORS)
    if missing := [word.decode() for word in table if word not in words]:
        return Rejected(raw, at, Cause.MISSING_WORD, f"no {', '.join(missing)}")
    if tuple(words) != table:
        return Rejected(raw, at, Cause.UNKNOWN_WORD, "a word twice, out of its order, or of another frame")
    for word, text in zip(words, texts, strict=True):
        if not _NUMBER[word].fullmatch(text):
            return Rejected(raw, at, Cause.BAD_NUMBER, f"{word.decode()} {_shown(text)}")
    if table is _ARM:
        degs = [float(text) for text in texts]
        rejects = (Reject(f"J{i}", texts[i - 1].decode()) for i, deg in enumerate(degs, 1) if deg > JOINT_MAX)
        return ArmReading(raw, at, tuple(deg if deg <= JOINT_MAX else None for deg in degs), tuple(rejects))
    gx, gy, gz, ax, ay, az = map(float, texts)
    return ImuReading(raw, at, (gx, gy, gz), (ax, ay, az))


def _shown(text: bytes) -> str:
    return ascii(text[:20].decode("ascii", "backslashreplace"))

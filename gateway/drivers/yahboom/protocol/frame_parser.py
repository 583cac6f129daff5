"""Parses one whole frame from the car into its reading, or into the cause of its rejection.

`frame_splitter` finds the frames in a stream.
"""

import re
from typing import Final

from gateway.control.driver import Rejected
from gateway.drivers.yahboom.protocol.sensors import (
    SENSOR_FIELDS,
    SENSOR_WORDS,
    FrameWords,
    RejectedField,
    read_sensors,
    sensors_matcher,
)
from gateway.drivers.yahboom.protocol.wire_events import ArmReading, Event, ImuReading
from schemas.words import Cause

JOINT_MAX: Final = 180.0  # docs/reference/protocol.md#ranges: "ranges a reading must be in"

_ARM: Final = FrameWords((b"J1", b"J2", b"J3", b"J4", b"J5", b"J6"))
_IMU: Final = FrameWords((b"MPUgx", b"MPUgy", b"MPUgz", b"MPUax", b"MPUay", b"MPUaz"))
_SENSOR_WORD: Final = b"|".join(field.word for field in SENSOR_FIELDS)
_WORD: Final = re.compile(rb"(%b|(?:Servo)?J1|J[2-6]|MPU[ga][xyz])(.*)" % _SENSOR_WORD, re.DOTALL)
_UNSIGNED, _SIGNED = re.compile(rb"[0-9]+(?:\.[0-9]+)?"), re.compile(rb"-?[0-9]+(?:\.[0-9]+)?")
_NUMBER: Final = {
    **{field.word: re.compile(field.pattern) for field in SENSOR_FIELDS},
    **dict.fromkeys(_ARM.words, _UNSIGNED),
    **dict.fromkeys(_IMU.words, _SIGNED),
}


def parse(raw: bytes, at: float, head: str) -> Event:
    """Return the event of one frame, whose `raw` is all bytes from its `$` to its `#`. Never raise.

    `head` is the first word of the frames of this car.
    """
    if found := sensors_matcher(head).match_ended(raw):
        return read_sensors(found, at)
    first, *fields = raw[1:-1].split(b",")
    if first != head.encode():
        return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_printable(first)} is not {head}")
    words: list[bytes] = []
    texts: list[bytes] = []
    for field in fields:
        found = _WORD.fullmatch(field)
        if not found:
            return Rejected(raw, at, Cause.UNKNOWN_WORD, f"{_printable(field)} begins with no word of the table")
        words.append(found[1].removeprefix(b"Servo"))
        texts.append(found[2])
    table = next((known for known in (_ARM, _IMU) if words and words[0] in known.words), SENSOR_WORDS)
    if missing := table.missing(words):
        return Rejected(raw, at, Cause.MISSING_WORD, f"no {', '.join(word.decode() for word in missing)}")
    if not table.are_in_order(words):
        return Rejected(raw, at, Cause.UNKNOWN_WORD, "a word that is doubled, out of order, or of another frame")
    for word, text in zip(words, texts, strict=True):
        if not _NUMBER[word].fullmatch(text):
            return Rejected(raw, at, Cause.BAD_NUMBER, f"{word.decode()} {_printable(text)}")
    if table is _ARM:
        degs = [float(text) for text in texts]
        rejects = (RejectedField(f"J{i}", texts[i - 1].decode()) for i, deg in enumerate(degs, 1) if deg > JOINT_MAX)
        return ArmReading(raw, at, tuple(deg if deg <= JOINT_MAX else None for deg in degs), tuple(rejects))
    gx, gy, gz, ax, ay, az = map(float, texts)
    return ImuReading(raw, at, (gx, gy, gz), (ax, ay, az))


def _printable(text: bytes) -> str:
    return ascii(text[:20].decode("ascii", "backslashreplace"))

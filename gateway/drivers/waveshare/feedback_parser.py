"""Turns one line of a Waveshare car into events. Pure. Any bytes are allowed.

The firmwares mix JSON with text, and print some JSON without a line end. So a line may contain text, several objects,
and the beginning of a line that the link has truncated. Each of these becomes an event.
"""

import json
import math
from typing import Any, Final

from msgspec import Struct

from gateway.control.driver import Event, Rejected, TextLine
from gateway.drivers.waveshare.firmware import MAX_V, UgvFirmware, firmware_of
from schemas.words import Cause

FEEDBACK: Final = 1001
"""Value of `T` in a feedback."""
MAX_M_S: Final = 5.0
"""Maximum speed of a wheel. A greater number is not a measurement."""
_IMU: Final = ("gx", "gy", "gz", "ax", "ay", "az")
_OF_ARM: Final = frozenset({"torB", "torS", "torE", "torH"})
"""Fields that only a car with an arm sends. Such a car sends positions of the arm in the fields of the yaw or the
acceleration."""
_DECODER: Final = json.JSONDecoder()


class Feedback(Struct, frozen=True):
    """One report. An optional field is None if the report does not have it, or if its value cannot be used.

    `at` is the time of the last byte.
    """

    raw: bytes
    at: float
    firmware: UgvFirmware | None
    """None if the fields of the report fit neither firmware, or both."""
    left_m_s: float
    right_m_s: float
    """Speeds of the wheels as the car reports them. They are measured only if `Chassis.has_encoders`."""
    voltage_v: float | None
    attitude_rad: tuple[float, float, float] | None
    """Roll, pitch, yaw, each -pi..pi."""
    odometer_m: tuple[float, float] | None
    imu_raw: tuple[float, ...] | None
    """Gyroscope and acceleration x, y, z, without a unit."""


def read_line(line: bytes, at: float) -> list[Event]:
    """Return the events in one line, which is given without the characters that end it."""
    text = line.decode("latin-1")
    events: list[Event] = []
    place = 0
    while place < len(text):
        start = text.find("{", place)
        plain = text[place : start if start >= 0 else len(text)]
        if plain.strip(" .\r\t"):
            events.append(TextLine(plain.encode("latin-1"), at))
        if start < 0:
            break
        try:
            found, place = _DECODER.raw_decode(text, start)
        except (ValueError, RecursionError):
            # A truncated object and a whole one can share a line, so the next `{` may begin a whole one.
            following = text.find("{", start + 1)
            place = following if following >= 0 else len(text)
            events.append(Rejected(text[start:place].encode("latin-1"), at, Cause.TRUNCATED))
            continue
        events.append(_event(found, text[start:place].encode("latin-1"), at))
    return events


def _event(found: Any, raw: bytes, at: float) -> Event:
    if not isinstance(found, dict) or found.get("T") != FEEDBACK:
        return TextLine(raw, at)
    left, right = _number(found, "L"), _number(found, "R")
    if left is None or right is None:
        return Rejected(raw, at, Cause.BAD_NUMBER if "L" in found and "R" in found else Cause.MISSING_WORD)
    if max(abs(left), abs(right)) > MAX_M_S:
        return Rejected(raw, at, Cause.OUT_OF_RANGE)
    firmware = firmware_of(found, _number(found, "v") or 0.0)
    has_arm = not _OF_ARM.isdisjoint(found)
    has_attitude = firmware is UgvFirmware.GENERAL and not has_arm
    attitude = _tuple(found, ("r", "p", "y"), math.radians(1.0)) if has_attitude else None
    if attitude is not None:  # there is no checksum, and a lost decimal point makes an angle of more than a full turn
        is_angle = max(map(abs, attitude)) <= math.tau
        attitude = tuple(math.remainder(each, math.tau) for each in attitude) if is_angle else None
    odometer = _tuple(found, ("odl", "odr"), 0.01) if firmware is UgvFirmware.ROS else None
    imu = _tuple(found, _IMU, 1.0) if firmware is UgvFirmware.ROS and not has_arm else None
    return Feedback(raw, at, firmware, left, right, _voltage(found, firmware), attitude, odometer, imu)


def _voltage(found: dict[str, Any], firmware: UgvFirmware | None) -> float | None:
    """Return the voltage, V. GENERAL sends volts, ROS hundredths of a volt."""
    volts = (_number(found, "v") or 0.0) / (100 if firmware is UgvFirmware.ROS else 1)
    return volts if firmware is not None and 0.0 < volts <= MAX_V else None


def _tuple(found: dict[str, Any], names: tuple[str, ...], scale: float) -> Any:
    values = [_number(found, name) for name in names]
    return None if any(each is None for each in values) else tuple(scale * (each or 0.0) for each in values)


def _number(found: dict[str, Any], name: str) -> float | None:
    value = found.get(name)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9:  # also rejects NaN
        return float(value)
    return None

"""What a line of a car is: a feedback of one of two firmwares, text, damage, or several of them."""

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.driver import Rejected, TextLine
from gateway.drivers.waveshare.feedback_parser import Feedback, read_line
from gateway.drivers.waveshare.firmware import UgvFirmware
from schemas.words import Cause

GENERAL: dict[str, Any] = {"T": 1001, "L": 0, "R": 0.25, "r": 1, "p": -2, "y": 90, "temp": 40.5, "v": 11.64}
ROS: dict[str, Any] = {
    "T": 1001,
    "L": -0.1,
    "R": 0.1,
    "ax": 1,
    "ay": 2,
    "az": 3,
    "gx": 4,
    "gy": 5,
    "gz": 6,
    "mx": 7,
    "my": 8,
    "mz": 9,
    "odl": 120,
    "odr": -3,
    "v": 1164,
}


def read(fields: dict[str, Any]) -> Any:
    """Return the only event of a feedback with these fields."""
    (event,) = read_line(json.dumps(fields).encode(), 1.0)
    return event


def test_firmwares_are_told_apart_and_read_in_one_unit() -> None:
    one, two = read(GENERAL), read(ROS)
    assert (one.firmware, one.left_m_s, one.right_m_s, one.voltage_v) == (UgvFirmware.GENERAL, 0.0, 0.25, 11.64)
    assert one.attitude_rad == pytest.approx((math.radians(1), math.radians(-2), math.pi / 2))
    assert (two.firmware, two.voltage_v, two.odometer_m) == (UgvFirmware.ROS, 11.64, pytest.approx((1.2, -0.03)))
    assert two.imu_raw == (4, 5, 6, 1, 2, 3)
    assert one.odometer_m is one.imu_raw is two.attitude_rad is None


def test_numbers_of_an_arm_are_no_angles() -> None:
    """Another program may say at any time that there is one. Its places have the names of other fields."""
    one, two = read({**GENERAL, "y": -194.1, "torB": -56}), read({**ROS, "ax": 310.2, "torS": 12})
    assert one.attitude_rad is None
    assert two.imu_raw is None
    assert (one.voltage_v, two.odometer_m) == (11.64, pytest.approx((1.2, -0.03)))


@pytest.mark.parametrize(
    ("yaw_deg", "yaw_rad"),
    [(180, math.pi), (-180, -math.pi), (270, -math.pi / 2), (-188.5, math.radians(171.5)), (360, 0.0), (12345, None)],
)
def test_angles_are_within_half_a_turn_or_none(yaw_deg: float, yaw_rad: float | None) -> None:
    attitude = read({**GENERAL, "y": yaw_deg}).attitude_rad
    assert attitude is None if yaw_rad is None else attitude[2] == pytest.approx(yaw_rad)


@pytest.mark.parametrize(
    ("fields", "cause"),
    [
        ({"T": 1001, "R": 0}, Cause.MISSING_WORD),
        ({"T": 1001, "L": "0", "R": 0}, Cause.BAD_NUMBER),
        ({"T": 1001, "L": True, "R": 0}, Cause.BAD_NUMBER),
        ({"T": 1001, "L": 5.1, "R": 0}, Cause.OUT_OF_RANGE),
    ],
)
def test_damaged_feedback_is_rejected_with_its_cause(fields: dict[str, Any], cause: Cause) -> None:
    assert read(fields).cause is cause


@pytest.mark.parametrize("volts", [None, "x", 0, -1, 14, math.inf])
def test_impossible_voltage_is_not_measured(volts: Any) -> None:
    assert read(GENERAL | {"v": volts}).voltage_v is None


def test_fields_of_both_or_of_neither_firmware_show_none() -> None:
    assert read(GENERAL | {"odl": 1, "odr": 2}).firmware is None
    assert read({"T": 1001, "L": 0, "R": 0}).firmware is None


def test_text_glued_objects_and_a_cut_one_share_a_line() -> None:
    whole = json.dumps(GENERAL)
    kinds = [type(each) for each in read_line(f'AP SSID: UGV{{"T":405}}{whole}..{whole[:20]}'.encode(), 1.0)]
    assert kinds == [TextLine, TextLine, Feedback, Rejected]
    assert [type(each) for each in read_line(f"{whole[:20]}{whole}".encode(), 1.0)] == [Rejected, Feedback]
    assert read_line(b"......", 1.0) == []


@given(st.binary(max_size=200))
def test_no_bytes_raise(line: bytes) -> None:
    for event in read_line(line, 1.0):
        assert event.raw in line

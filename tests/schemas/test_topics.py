"""Which topic a wrong name means."""

import pytest

from schemas.topics import likely_name


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("sensor/rang", "sensor/range"),
        ("sensor/distance", "sensor/range"),
        ("distance", "sensor/range"),
        ("sensor/dist", "sensor/range"),
        ("sensor/range_m", "sensor/range"),
        ("sensor/voltage", "sensor/battery"),
        ("battery/voltage_v", "sensor/battery"),
        ("sensor/accelerometer", "sensor/imu"),
        ("state/motors", "state/safety"),
        ("sensors", "sensor/*"),
        ("sensor/temperature", None),
        ("state/parking", None),
        ("@recorder/state", None),
        ("sensor/the", None),
    ],
)
def test_unknown_topic_suggests_matching_one(wrong: str, meant: str | None) -> None:
    assert likely_name(wrong) == meant

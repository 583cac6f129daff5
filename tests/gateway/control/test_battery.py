"""What a battery voltage means; 6.4 V empty to 8.4 V full (protocol.md, readings)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.battery import BatteryLevel, charge, level


@pytest.mark.parametrize(
    ("voltage_v", "expected", "share"),
    [
        (12.0, BatteryLevel.OK, 1.0),
        (8.4, BatteryLevel.OK, 1.0),
        (7.4, BatteryLevel.OK, 0.5),
        (7.0, BatteryLevel.OK, 0.3),
        (6.99, BatteryLevel.LOW, 0.295),
        (6.6, BatteryLevel.LOW, 0.1),
        (6.59, BatteryLevel.CRITICAL, 0.095),
        (6.4, BatteryLevel.CRITICAL, 0.0),
        (0.0, BatteryLevel.CRITICAL, 0.0),
    ],
)
def test_level_and_charge(voltage_v: float, expected: BatteryLevel, share: float) -> None:
    assert level(voltage_v) is expected
    assert charge(voltage_v, loaded=False) == (pytest.approx(share), 0.15)


def test_under_load_the_estimate_is_worse_not_other() -> None:
    assert charge(7.4, loaded=True) == (pytest.approx(0.5), pytest.approx(0.35))


@given(st.floats(0, 12), st.booleans())
def test_always_a_share_and_an_error(voltage_v: float, loaded: bool) -> None:
    share, error = charge(voltage_v, loaded=loaded)
    assert 0 <= share <= 1
    assert 0 < error <= 1

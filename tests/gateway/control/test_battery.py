"""Tests of the battery estimate. 6.4 V is empty, 8.4 V is full (docs/reference/protocol.md#readings)."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.battery import LEVEL_DEBOUNCE_S, LOAD_RECOVERY_S, Battery, BatteryPolicy, charge
from schemas.battery_levels import LOW_V
from schemas.words import BatteryAction, BatteryLevel


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
    assert BatteryPolicy().level(voltage_v) is expected
    assert charge(voltage_v, loaded=False) == (pytest.approx(share), 0.15)


def test_where_a_level_begins_may_be_told() -> None:
    policy = BatteryPolicy(low_v=7.4, critical_v=7.2)
    assert [policy.level(volts) for volts in (7.4, 7.39, 7.2, 7.19)] == ["ok", "low", "low", "critical"]


def test_battery_under_load_is_estimated_at_rest_less_surely() -> None:
    assert charge(7.4, loaded=True) == (pytest.approx(0.6), pytest.approx(0.25))


@given(st.floats(0, 12), st.booleans())
def test_always_a_share_and_an_error(voltage_v: float, loaded: bool) -> None:
    share, error = charge(voltage_v, loaded=loaded)
    assert 0 <= share <= 1
    assert 0 < error <= 1


@pytest.mark.parametrize(
    ("cells", "voltage_v", "is_known"), [(2, 9.0, True), (2, 9.1, False), (3, 9.1, True), (3, 12.6, True)]
)
def test_no_charge_of_a_voltage_that_these_cells_cannot_have(cells: int, voltage_v: float, *, is_known: bool) -> None:
    battery = Battery(cells=cells)
    assert battery.charge is None, "nothing was measured"
    battery.on_voltage(voltage_v, loaded=False, now=0.0)
    assert (battery.charge is not None) is is_known
    assert ("charge" in battery.words) is is_known


def test_charge_is_less_sure_until_the_voltage_has_recovered_from_a_load() -> None:
    battery = Battery()
    hear(battery, 7.4, loaded=True)
    errors = [battery.after(7.4, loaded=False, now=now).charge for now in (0.0, LOAD_RECOVERY_S - 0.1, LOAD_RECOVERY_S)]
    assert [error[1] for error in errors if error] == [pytest.approx(each) for each in (0.25, 0.25, 0.15)]


def hear(battery: Battery, *voltages: float, loaded: bool = False, from_s: float = 0.0) -> list[float]:
    """Feed one reading a second. Return the times at which the level changed."""
    start = max(battery.measured_at + 1.0, from_s)
    return [
        start + second
        for second, voltage_v in enumerate(voltages)
        if battery.on_voltage(voltage_v, loaded=loaded, now=start + second)
    ]


def test_nothing_measured_is_no_level_and_refuses_nothing() -> None:
    battery = Battery()
    assert (battery.level, battery.action, battery.refusal, battery.words) == (None, None, "", "")


@pytest.mark.parametrize(
    ("voltage_v", "expected", "action", "refuses"),
    [
        (8.0, "ok", None, False),
        (6.9, "low", BatteryAction.WARN, False),
        (6.5, "critical", BatteryAction.REFUSE, True),
    ],
)
def test_first_battery_readings_count_after_holding(
    voltage_v: float, expected: str, action: BatteryAction | None, refuses: bool
) -> None:
    battery = Battery()
    assert not hear(battery, *[voltage_v] * 5)
    assert (battery.level, battery.action) == ("ok", None)
    assert bool(battery.refusal) is refuses, "a mode would be open before the level follows from readings"
    assert bool(hear(battery, voltage_v)) is (expected != "ok")
    assert (battery.level, battery.action, bool(battery.refusal)) == (expected, action, refuses)


def test_voltage_under_load_is_settled_only_after_a_rest() -> None:
    battery = Battery()
    hear(battery, 7.5, *[6.5] * 20, loaded=True)
    assert (battery.level, bool(battery.refusal)) == (BatteryLevel.LOW, True), "without the load it may be critical"
    assert "battery critical by its first readings: 6.50 V" in battery.refusal
    hear(battery, *[7.5] * 20)
    assert not battery.refusal
    hear(battery, *[6.5] * 20, loaded=True)
    assert (battery.level, battery.refusal) == (BatteryLevel.LOW, ""), "this battery is known, and only sags"


def test_battery_level_changes_after_holding_not_by_one_reading() -> None:
    battery = Battery()
    assert not hear(battery, 7.2, 6.9, 6.9, 7.1, 6.9, 6.9, 6.9, 6.9, 6.9)
    assert hear(battery, 6.9)
    assert battery.level is BatteryLevel.LOW
    assert not hear(battery, *[7.1] * 60), "not above the hysteresis"
    assert hear(battery, *[7.2] * 6)
    assert battery.level is BatteryLevel.OK


def test_critical_leads_back_over_low() -> None:
    battery = Battery()
    hear(battery, 6.5, *[6.8] * 9)
    assert battery.level is BatteryLevel.LOW
    assert "battery low: 6.80 V, charge 20% +- 15%" in battery.words


def test_sag_of_drive_and_recovery_change_no_level() -> None:
    battery = Battery()
    hear(battery, *[7.15] * 10)
    for _ in range(20):
        assert not hear(battery, *[6.85] * 30, loaded=True)
        assert not hear(battery, 6.9, 6.95, 6.99, 7.0)
        assert not hear(battery, *[7.1] * 30)
    assert battery.level is BatteryLevel.OK


def test_battery_low_under_any_load_is_low_while_driving() -> None:
    battery = Battery()
    hear(battery, 7.5)
    assert hear(battery, *[6.5] * 20, loaded=True)
    assert battery.level is BatteryLevel.LOW


@given(st.integers(0, 2**32))
def test_noise_around_a_threshold_does_not_flap(seed: int) -> None:
    moments = random.Random(seed)
    battery = Battery()
    changes = hear(battery, *(LOW_V + 0.14 * (moments.random() - 0.5) for _ in range(600)))
    assert len(changes) <= 2


@given(st.integers(0, 2**32), st.sampled_from([7.6, 7.25, 6.85, 6.4]), st.booleans())
def test_level_does_not_flap_from_the_first_reading_on(seed: int, rest_v: float, from_a_drive: bool) -> None:
    """A gateway starts, sometimes while motors run. Once they stop, the voltage recovers. Some readings are damaged.

    From the first reading on the level only falls, never rises.
    """
    moments = random.Random(seed)
    battery, levels = Battery(), ["ok"]
    stops_at = moments.uniform(0, 12) if from_a_drive else 0.0
    now = 0.0
    while now < 60.0:
        sag_v = 0.35 if now < stops_at else 0.35 * max(0.0, 1 - (now - stops_at) / 4) if from_a_drive else 0.0
        voltage_v = rest_v - sag_v + moments.uniform(-0.04, 0.04)
        if moments.random() < 0.1:
            voltage_v = moments.choice([0.0, 12.0])
        battery.on_voltage(voltage_v, loaded=now < stops_at, now=now)
        assert battery.level is not None
        if battery.level != levels[-1]:
            levels.append(str(battery.level))
        now += moments.uniform(0.04, 1.2)
    assert levels in (["ok"], ["ok", "low"], ["ok", "critical"], ["ok", "low", "critical"])


def test_readings_on_both_sides_of_critical_are_low_at_least() -> None:
    battery = Battery()
    assert hear(battery, *[6.58, 6.62] * 4) == [5.0]
    assert battery.level is BatteryLevel.LOW


def test_policy_may_stop_or_only_warn() -> None:
    assert BatteryPolicy(on_critical=BatteryAction.STOP).action(BatteryLevel.CRITICAL) is BatteryAction.STOP
    warns = Battery(BatteryPolicy(on_critical=BatteryAction.WARN))
    hear(warns, *[6.0] * 6)
    assert (warns.action, warns.refusal) == (BatteryAction.WARN, "")
    refuses = Battery(BatteryPolicy(on_low=BatteryAction.REFUSE))
    hear(refuses, *[6.9] * 6)
    assert refuses.refusal.startswith("battery low: 6.90 V, charge 25% +- 15%. Charge it")


def test_hold_outlasts_a_few_readings() -> None:
    assert LEVEL_DEBOUNCE_S > 3.0, "a report comes every one to two seconds"

"""A function of a plan's condition is one row: `rate`, and here one over three readings and one with a range."""

from collections.abc import Sequence

import pytest

from fleet.client import car_state
from fleet.client.condition import KeyCondition
from fleet.conditions import BadExpression, is_contradictory
from fleet.conditions import parse as parse_condition
from fleet.conditions.functions import FUNCTIONS, ConditionFunction, rate
from fleet.conditions.satisfiability import explain_impossible
from fleet.coordinator.observer import FleetObserver
from fleet.policy.lint.reachability import list_unmeasured
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import ALIASES, NAMES
from gateway import drivers
from schemas import topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Mode
from tests.support.text_parts import has_parts


def slope(readings: Sequence[tuple[float, float]]) -> float | None:
    (first_at, first), (last_at, last) = readings[0], readings[-1]
    return None if first_at == last_at else (last - first) / (last_at - first_at)


@pytest.fixture(autouse=True)
def _rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FUNCTIONS, "slope", ConditionFunction("slope", slope, readings=3))
    monkeypatch.setitem(FUNCTIONS, "size", ConditionFunction("size", lambda seen: abs(seen[-1][1]), range=(0.0, 9.0)))
    monkeypatch.setattr(car_state, "KEPT_READINGS", 3)


def needs(condition: str) -> str:
    return f"roles: {{scout: {{mode: manual, needs: {condition}}}}}"


def came(observer: FleetObserver, at: float, range_m: float | None) -> None:
    payload, encoding = pb.Range(car="red", range_m=range_m).SerializeToString(), topics.TOPICS["sensor/range"].encoding
    observer.on_sample(Sample("fleet/red/sensor/range", payload, encoding, 0, 1), at, None)


def test_plan_reads_a_function_of_the_newest_readings() -> None:
    expression = parse(needs("slope(range_m) < -0.5")).roles["scout"].needs
    assert expression is not None
    assert parse(needs(str(expression))).roles["scout"].needs == expression, "its text is a condition, too"
    observer = FleetObserver()
    observer.on_token("red", 0.0, alive=True)
    held = []
    for at, range_m in ((0.0, 9.0), (1.0, 2.0), (2.0, 1.9), (2.5, None), (3.0, 1.8)):
        came(observer, at, range_m)
        held.append(observer.snapshot(()).holds(expression, "red", at))
    assert held == [None, True, True, False, False], "three readings back, and one of them measured nothing"
    used = observer.snapshot(()).describe_readings(expression, "red", 3.0)
    assert used == ("red/sensor/range slope(range_m)=-0.1 (0.0 s old)",)
    observer.on_sleep(60.0)
    assert observer.snapshot(()).holds(expression, "red", 3.0) is None, "stale"
    assert observer.snapshot(()).holds(expression, "red", 3.0, old=True) is False, "all of them slept alike"


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("pace(range_m) < 1", "pace … value"),
        ("rate < 1", "rate … value"),
        ("rate(left) < 1", "left … value"),
        ("rate(mode.asked) < 1", "rate … field … number"),
        ("rate(3) < 1", "rate … field … number"),
        ("rate(rate(range_m)) < 1", "rate … field … number"),
        ("rate(range_m < 1", "( of rate … closed"),
        ("rate(range_m)", "rate(range_m) … number, … condition"),
    ],
)
def test_wrong_call_is_an_error(condition: str, words: str) -> None:
    with pytest.raises(BadExpression) as found:
        parse_condition(condition, NAMES, ALIASES, FUNCTIONS)
    assert has_parts(found.value.words, words)


def test_function_has_range_and_needs_measured_field() -> None:
    expression = parse(needs("size(range_m) > 9.5")).roles["scout"].needs
    assert expression is not None
    assert "0 .. 9" in explain_impossible(expression)
    assert not explain_impossible(parse(needs("size(range_m) > 8")).roles["scout"].needs or expression)
    assert is_contradictory(parse(needs("size(range_m) > 8 and size(range_m) < 7")).roles["scout"].needs or expression)
    arduino = drivers.profile_of("arduino")
    assert list_unmeasured(expression, arduino, Mode.MANUAL) == ()
    assert list_unmeasured(expression, arduino, Mode.TRACKING) == ("size(range.range_m)",)
    placed = parse(needs("pose.x_m > 1")).roles["scout"].needs
    assert placed is not None
    assert list_unmeasured(placed, arduino, Mode.TRACKING) == (), "a program outside of the car may measure it"


def test_watch_rejects_functions_without_history() -> None:
    with pytest.raises(BadExpression, match="rate "):
        KeyCondition.of("rate(range_m) < 1", "fleet/red/sensor/range")


def test_rate_is_change_per_second_of_two_newest_readings() -> None:
    assert rate([(1.0, 2.0)]) is None
    assert rate([(0.0, 9.0), (1.0, 2.0), (3.0, 1.0)]) == -0.5
    assert rate([(1.0, 2.0), (1.0, 1.0)]) is None
    expression = parse(needs("rate(range_m) < -0.2")).roles["scout"].needs
    assert expression is not None
    observer = FleetObserver()
    observer.on_token("red", 0.0, alive=True)
    held = []
    for at, range_m in ((0.0, 2.0), (1.0, 1.9), (2.0, 1.5), (3.0, 1.5)):
        came(observer, at, range_m)
        held.append(observer.snapshot(()).holds(expression, "red", at))
    assert held == [None, False, True, False]

"""A dry run decides first what a coordinator would, and the changes of a plan are told part by part."""

import pytest
from msgspec.structs import replace

from fleet.policy.plan.plan_parser import parse
from fleet.policy.plan_changes import plan_changes
from fleet.policy.snapshot import FleetSnapshot
from fleet.policy.trial import PlanInForce, try_plan
from tests.fleet.policy.cars import HERE, PolicyRun

TWO = "roles:\n  guide: {mode: tracking}\n  rest: {mode: manual, count: all, priority: -1}\n"
NEW = "roles:\n  scout: {mode: light_seeking}\n  rest: {mode: manual, count: all, priority: -1}\n"


@pytest.mark.parametrize(
    ("before", "after", "changes"),
    [
        (TWO, TWO, []),
        (TWO, TWO.replace("tracking", "following"), [("role guide", [("mode", "tracking", "following")])]),
        (TWO, TWO.replace("count: all, ", ""), [("role rest", [("count", "all", "1")])]),
        (
            TWO,
            NEW,
            [
                ("role guide", [("mode", "tracking", ""), ("count", "1", "")]),
                ("role scout", [("mode", "", "light_seeking"), ("count", "", "1")]),
            ],
        ),
        (TWO, f"{TWO}fixed: {{blue: {{role: rest}}}}\n", [("car blue", [("role", "", "rest")])]),
        (TWO, f"{TWO}without_role: leave_alone\n", [("cars without a role", [("mode", "manual", "left alone")])]),
        (
            f"{TWO}rules:\n  - {{name: lamp, when: light.left, then: {{who: this_car, mode: manual}}}}\n",
            f"{TWO}rules:\n  - {{name: lamp, when: light.right, then: {{who: this_car, mode: manual, led: red}}}}\n",
            [
                (
                    "rule lamp",
                    [
                        ("when", "any car: light.left", "any car: light.right"),
                        ("then", "this_car mode manual", "this_car mode manual, LED #ff0000"),
                    ],
                )
            ],
        ),
        (
            f"{TWO}phases:\n  go: {{roles: [guide], timeout_s: 5, next: go}}\n",
            f"{TWO}phases:\n  go: {{timeout_s: 6, next: go}}\n",
            [("phase go", [("roles", "guide", "all"), ("timeout", "5 s", "6 s")])],
        ),
    ],
)
def test_each_part_that_differs_is_told_with_its_fields(
    before: str, after: str, changes: list[tuple[str, list[tuple[str, str, str]]]]
) -> None:
    found = plan_changes(parse(before), parse(after))
    assert [(each.part, list(each.fields)) for each in found] == changes


def test_dry_run_is_the_first_decision_of_a_coordinator() -> None:
    run = PolicyRun(parse(TWO), "red", "blue")
    real = run.at(0.0)
    tried = try_plan(parse(TWO), FleetSnapshot(dict.fromkeys(("red", "blue"), HERE)), None, 0.0)
    assert {each.car: each.role for each in tried.cars} == dict(real.roles)
    assert [each.decision for each in tried.cars] == [each for each in real.decisions if each.car in ("red", "blue")]
    assert {each.car: each.is_changed for each in tried.cars} == {"blue": True, "red": True}


def test_dry_run_keeps_roles_in_force_and_tells_lacking_cars() -> None:
    cars = FleetSnapshot(dict.fromkeys(("red", "blue"), HERE))
    for holder, other in (("red", "blue"), ("blue", "red")):
        in_force = PlanInForce(parse(TWO), {holder: "guide", other: "rest"})
        tried = try_plan(parse(TWO), cars, in_force, 0.0)
        assert {each.car: each.role for each in tried.cars} == {holder: "guide", other: "rest"}
        assert {each.car for each in tried.cars if each.is_changed} == {holder}, "it is in mode manual yet"
    tried = try_plan(parse("roles:\n  guide: {mode: tracking, count: 3}\n"), cars, None, 0.0)
    assert [(each.role, each.decided) for each in tried.places] == [("guide", "2 of 3")]


def test_car_that_is_left_alone_changes_nothing() -> None:
    held = FleetSnapshot({"red": replace(HERE, held_by="mia")})
    (found,) = try_plan(parse(TWO), held, PlanInForce(parse(TWO), {"red": "left alone"}), 0.0).cars
    assert (found.role_before, found.role, found.is_changed) == ("", "", False)

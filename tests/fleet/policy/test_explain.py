"""The text of each kind of decision is that of tests/vectors/decisions.tsv, on the case that the row names."""

from typing import Any

import pytest
from msgspec.structs import replace

from fleet.policy.decision import DecisionKind
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import Refusal
from tests.fleet.policy.cars import HERE, PolicyRun, observed
from tests.support.vectors import rows

SCOUT = parse("""
roles:
  scout: {mode: tracking, needs: battery.voltage_v > 7.0}
  seeker: {mode: light_seeking, given_by: rules}
rules:
  - name: lamp
    when: {any_car: light.left, for_s: 1}
    then: [{who: this_car, role: seeker}, {who: other_cars, mode: color_led}]
""")
STAND_IN = parse(
    "roles: {first: {mode: tracking, cars: [red], if_none: second}, second: {mode: following, given_by: rules}}"
)
PHASES = parse(
    """
roles: {any_car: {mode: manual}}
phases:
  look: {until: {any_car: light.left}, next: go, timeout_s: 30, on_timeout: rest}
  go: {}
  rest: {}
rules: [{name: enough, when: {car: red, is: motion.fan}, then: {phase: rest}}]
""".replace("{any_car: {mode", "{some: {mode")
)
CHANGES: dict[str, dict[str, Any]] = {
    "free place": {},
    "already in it": {"mode": "tracking"},
    "battery too low": {},
    "battery not known": {},
    "platform": {"platform": "raspberry_pi"},
    "not in the fleet file": {"roles": frozenset({"seeker"})},
    "refused": {"refused": Refusal("tracking", "battery_low", "6.5 V", 10.0)},
    "contradicted": {"mode": "tracking", "verdict": "contradicted", "evidence": "silent for 3.1 s"},
    "not on the bus": {"present": False, "mode": ""},
    "not heard yet": {"mode": ""},
    "in recovery": {"motors": "unknown"},
    "in doubt": {"doubted": True},
    "link lost": {"link": "lost"},
    "on hold": {"held_by": "ann@laptop-4711"},
    "e-stopped": {"estopped_by": "ann@laptop-4711"},
    "paused": {"paused_by": "ann@laptop-4711"},
    "lent": {"lent_to": "ann"},
    "driven": {"driven_by": "bob@laptop-4711"},
}


def _last(case: str) -> PolicyRun:
    """Return a coordinator that has made the decision."""
    run = PolicyRun(SCOUT, "red", obey=False)
    run.memory = replace(run.memory, started_at=0.0)
    run.readings["red"] = (
        {} if "not known" in case else {"sensor/battery": observed("sensor/battery", 9.5, voltage_v=7.4)}
    )
    if "too low" in case or case == "role lacks a car":
        run.readings["red"] = {"sensor/battery": observed("sensor/battery", 9.5, voltage_v=6.8)}
    match case:
        case "in place of another" | "no place left" | "role lacks a car" | "rule gives a role" | "rule gives a mode":
            run.cars["blue"] = HERE
            run.readings["blue"] = {"sensor/battery": observed("sensor/battery", 9.5, voltage_v=7.4)}
            run.cars["red"] = replace(HERE, mode="tracking")
    match case:
        case "in place of another":
            run.at(8.0)
            run.change("red", held_by="ann")
        case "no place left":
            run.change("red", mode="manual")
            run.change("blue", mode="tracking")
        case "rule gives a role" | "rule gives a mode":
            for at in (7.5, 8.4):
                run.readings["red"]["sensor/light"] = observed("sensor/light", at, left=True)
                run.at(at)
            run.readings["red"]["sensor/light"] = observed("sensor/light", 9.5, left=True)
        case "role lacks a car":
            run.cars["blue"] = replace(HERE, present=False)
        case "role filled again":
            run.change("red", held_by="ann")
            run.at(8.0)
            run.change("red", held_by=None)
        case "away for a moment":
            run.at(8.0)
            run.change("red", present=False, mode="")
        case "contradicted":
            run.change("red", mode="tracking")
            run.readings["red"] = {"sensor/battery": observed("sensor/battery", 7.5, voltage_v=7.4)}
            run.at(8.0)
    run.change("red", **CHANGES.get(case, {}))
    run.at(10.0)
    return run


def _stand_in() -> PolicyRun:
    run = PolicyRun(STAND_IN, "blue", "red")
    run.change("red", held_by="ann")
    run.at(10.0)
    return run


def _phase(case: str) -> PolicyRun:
    run = PolicyRun(PHASES, "red")
    run.at(0.0)
    if case == "phase by condition":
        run.readings["red"] = {"sensor/light": observed("sensor/light", 9.5, left=True)}
    elif case == "phase by rule":
        run.readings["red"] = {"state/motion": observed("state/motion", 9.5, fan=True)}
    if case != "phase at the start":
        run.at(30.0 if case == "phase by time-out" else 10.0)
    return run


LATE = parse("""
roles: {late: {mode: tracking}}
phases: {look: {timeout_s: 9, next: rest}, rest: {roles: []}}
""")
PAIR = parse("roles: {pair: {mode: tracking, count: 2}}")
PASSED_OVER = parse("""
roles: {lead: {mode: tracking, cars: [red]}}
rules: [{when: {car: red, is: light.left}, then: {who: other_cars, mode: color_led}}]
""")


def _out(case: str) -> PolicyRun:
    run = PolicyRun(LATE if case == "phase without a role" else STAND_IN, "blue", "red")
    for car in ("blue", "red"):
        run.change(car, held_by="ann")
    run.at(0.0)
    assert any(each.kind == DecisionKind.VACANT for each in run.last.changed)
    run.at(0.1)  # the phase does not wait for cars on hold: its timeout counts from its start
    run.change("red", held_by=None)
    run.at(10.0)
    return run


def _pair(case: str) -> PolicyRun:
    run = PolicyRun(PAIR, "red")
    run.at(0.0)
    if case == "two of two":
        run.cars["blue"] = HERE
        run.at(10.0)
        assert run.of("red") in run.last.reworded
        assert run.of("red").since == 0.0, "it is told since when, not when it was said"
    return run


LEFT_OVER = parse("roles: {lead: {mode: tracking, cars: [red]}, rest: {mode: manual, count: all}}")
REST = parse("roles: {rest: {mode: manual, count: all}}")
CERTAIN = parse("roles: {lead: {mode: tracking, cars: [red], count: 2}, rest: {mode: manual}}")
UNSEEN = parse("""
roles: {guide: {mode: tracking}}
rules:
  - name: weak
    when: {any_car: battery.level == 'low', with_role: guide, for_s: 5}
    then: {who: this_car, mode: manual}
""")
HANGING = parse("""
roles: {patrol: {mode: obstacle_avoidance, count: all}}
phases: {search: {until: {any_car: light.left}, next: gather}, gather: {}}
""")
OF_ALL = {
    "all that are left": (LEFT_OVER, ("blue", "green", "red")),
    "all but one on hold": (LEFT_OVER, ("blue", "green", "red")),
    "all on hold": (REST, ("red",)),
    "all there are": (REST, ("blue", "red")),
    "given to no other": (CERTAIN, ("blue", "red")),
    "not measured in its mode": (UNSEEN, ("red",)),
    "phase that nothing ends": (HANGING, ("red",)),
}


def _of_all(case: str) -> PolicyRun:
    plan, cars = OF_ALL[case]
    run = PolicyRun(plan, *cars)
    if case == "all but one on hold":
        run.change("green", held_by="ann")
    if case == "all on hold":
        run.change("red", held_by="ann")
    if case == "phase that nothing ends":
        run.change("red", mode="obstacle_avoidance")
    run.at(0.0)
    return run


def _in_vain() -> PolicyRun:
    run = PolicyRun(parse("roles: {one: {mode: tracking}}"), "green", "red", obey=False)
    run.change("green", mode="tracking", verdict="contradicted", evidence="silent for 3.1 s")
    run.change("red", held_by="ann")
    run.until(5.0)
    run.change("red", held_by=None)
    run.at(10.0)
    return run


def _passed_over() -> PolicyRun:
    run = PolicyRun(PASSED_OVER, "red", "pi")
    run.change("pi", platform="raspberry_pi")
    run.readings["red"] = {"sensor/light": observed("sensor/light", 0.0, left=True)}
    run.at(0.0)
    return run


TABLE = rows("decisions")


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"{row['case']}, {row['subject']}")
def test_decision_is_explained(row: dict[str, str]) -> None:
    case, subject = row["case"], row["subject"]
    if case in OF_ALL:
        run = _of_all(case)
    elif case.startswith("phase ") and case != "phase without a role":
        run = _phase(case)
    elif case in ("phase without a role", "on call no more"):
        run = _out(case)
    elif case.endswith("of two"):
        run = _pair(case)
    elif case == "does not do it":
        run = _in_vain()
    elif case == "rule passes over":
        run = _passed_over()
    elif case == "stands in" or subject == "role first":
        run = _stand_in()
    else:
        run = _last(case)
    found = run.of(subject)
    assert (found.kind, found.decided, found.why) == (row["kind"], row["decided"], row["why"])
    assert "; ".join(found.readings) == row["with"]
    assert found.would_change == row["changes_by"]
    assert found in (*run.last.changed, *run.last.reworded)


def test_table_has_every_kind() -> None:
    assert {row["kind"] for row in TABLE} == set(DecisionKind)

"""Requests of people for the plan in force: restart, next phase, stop. A stopped plan drives no car again by itself."""

from typing import Any

import pytest

from fleet.policy.plan.plan_parser import parse
from fleet.policy.plan_requests import PlanRequest, RequestRefused, check_sender, on_request
from fleet.policy.snapshot import FleetSnapshot, Refusal
from fleet.policy.state import PersistedPolicy, carry_over, restore, to_persisted
from schemas.rights import People
from tests.fleet.policy.cars import PolicyRun

PHASES = parse(
    """
roles: {line: {mode: tracking, count: all}, light: {mode: light_seeking, count: all}}
phases:
  first: {roles: [line], timeout_s: 60, on_timeout: second}
  second: {roles: [light], until: {any_car: light.left}, next: third}
  third: {roles: [line]}
"""
)
FLAT = parse("roles: {line: {mode: tracking, count: all}}")


def ask(run: PolicyRun, request: str) -> str:
    run.memory, words = on_request(PlanRequest(request), run.plan, run.memory, "ann", run.now)
    return words


def started(plan: Any = PHASES, *cars: str, obey: bool = True) -> PolicyRun:
    run = PolicyRun(plan, *(cars or ("red", "blue")), obey=obey)
    run.until(3.0)
    return run


def test_next_steps_through_phases_and_is_refused_at_end() -> None:
    run = started()
    assert ask(run, "next").endswith(": second")
    run.until(4.0)
    assert run.of("red").mode == "light_seeking"
    assert run.of("phase").why.startswith("ann ")
    assert run.of("phase").why.endswith("from first")
    ask(run, "next")
    run.until(5.0)
    assert run.memory.phase.name == "third"
    with pytest.raises(RequestRefused, match=r"third .* `fleet plan restart` .*\[unsupported\]$"):
        ask(run, "next")
    ask(run, "restart")
    run.until(6.0)
    assert (run.memory.phase.name, run.of("red").mode) == ("first", "tracking")


def test_next_is_refused_without_phases_and_while_stopped() -> None:
    with pytest.raises(RequestRefused, match="has no phases"):
        ask(started(FLAT), "next")
    run = started()
    ask(run, "stop")
    with pytest.raises(RequestRefused, match=r"stopped \(by ann\)"):
        ask(run, "next")


def test_stopped_plan_brings_cars_to_rest_once() -> None:
    run = started(FLAT)
    assert "blue, red brought " in ask(run, "stop")
    run.asked.clear()
    step = run.at(3.1)
    assert run.asked == [(3.1, "blue", "manual"), (3.1, "red", "manual")]
    assert run.of("red").why.startswith("ann ")
    assert "to rest" in run.of("red").why
    assert {each.subject for each in step.changed} == {"red", "blue", "role line"}
    run.until(4.0)
    assert not run.memory.to_rest
    assert run.of("red").decided == "left alone"
    run.change("red", mode="light_seeking")  # set by a person
    run.until(90.0, every=1.0)
    assert len(run.asked) == 2
    assert "already" in ask(run, "stop")


def test_command_on_its_way_does_not_count_as_rest() -> None:
    """The car still reports manual, because the mode command before the stop has no outcome yet."""
    run = started(FLAT, "red", obey=False)
    ask(run, "stop")
    run.change("red", busy=True)
    run.asked.clear()
    run.until(4.0)
    assert run.memory.to_rest == {"red"}
    run.change("red", busy=False)
    run.at(4.1)
    assert run.asked == [(4.1, "red", "manual")], "it may be in tracking by now"
    run.change("red", mode="tracking")
    run.until(5.5)
    assert run.memory.to_rest == {"red"}
    assert [car for _, car, _ in run.asked] == ["red", "red"]
    run.change("red", mode="manual")
    run.at(5.6)
    assert not run.memory.to_rest


@pytest.mark.parametrize(
    "fields",
    [{"held_by": "bob"}, {"estopped_by": "bob"}, {"paused_by": "bob"}, {"lent_to": "bob"}, {"driven_by": "bob"}],
)
def test_stopped_plan_leaves_car_taken_by_person_alone(fields: dict[str, str]) -> None:
    run = started(FLAT, "red")
    ask(run, "stop")
    run.asked.clear()
    run.change("red", **fields)
    run.at(3.1)
    run.change("red", **dict.fromkeys(fields))
    run.until(10.0)
    assert (run.asked, run.memory.to_rest) == ([], frozenset())


def test_lost_car_is_brought_to_rest_on_return_and_refusal_is_no_rest() -> None:
    run = started(FLAT, "red")
    run.change("red", link="lost")
    run.at(3.1)
    ask(run, "stop")
    run.asked.clear()
    run.until(10.0)
    assert run.memory.to_rest == {"red"}
    run.obey = False
    run.change("red", link="online", mode="manual")
    run.at(10.1)
    run.change("red", refused=Refusal("manual", "link_down", "", 10.1))
    run.at(10.2)
    assert run.memory.to_rest == {"red"}
    run.change("red", refused=None)
    run.at(10.3)
    assert not run.memory.to_rest
    assert len(run.asked) == 1


@pytest.mark.parametrize("plan", [FLAT, PHASES])
def test_coordinator_that_is_started_again_stays_stopped(plan: Any) -> None:
    run = started(FLAT)
    ask(run, "stop")
    kept = to_persisted(FLAT, run.memory, run.now, 1000.0)
    run.plan, run.memory = plan, restore(plan, FleetSnapshot(run.cars), kept, 50.0, 1050.0)
    run.asked.clear()
    run.now = 50.0
    run.until(60.0)
    assert {mode for _, _, mode in run.asked} == {"manual"}
    assert (run.memory.stopped_by, run.memory.to_rest) == ("ann", frozenset())


@pytest.mark.parametrize("how", ["restart", "set"])
def test_restart_and_set_go_on(how: str) -> None:
    run = started(FLAT)
    ask(run, "stop")
    run.until(5.0)
    run.asked.clear()
    if how == "restart":
        ask(run, "restart")
    else:
        run.memory, run.plan = carry_over(run.memory, FLAT, PHASES), PHASES
    run.until(8.0)
    assert {(car, mode) for _, car, mode in run.asked} == {("red", "tracking"), ("blue", "tracking")}
    assert to_persisted(run.plan, run.memory, run.now, 0.0).stopped_by == PersistedPolicy().stopped_by


SAY = "Say who you are with `--as NAME` or FLEET_AS. [not_allowed]"
ONLY_A_LEAD, UNLISTED = "Only a lead may (teacher).", "{} watches and stops: the fleet file does not list {}."
EVERYONE = People()
NO_LEADS = People.parse(["ann", "bob"])
LEADS = People.parse(["teacher:lead", "ann", "bob"])


@pytest.mark.parametrize(
    ("people", "by", "words"),
    [
        *((EVERYONE, by, None) for by in ("teacher@lab-1", "ann@lab-2", "zed", "anonymous", "@supervisor")),
        *((NO_LEADS, by, None) for by in ("ann@lab-2", "bob", "@supervisor")),
        *((NO_LEADS, by, UNLISTED) for by in ("teacher@lab-1", "zed@x", "anonymous", "@lead")),
        *((LEADS, by, None) for by in ("teacher", "teacher@lab-1", "@supervisor")),
        *((LEADS, by, ONLY_A_LEAD) for by in ("ann@lab-2", "zed@x", "anonymous", "ann@teacher", "teacher2")),
        (People.merged([EVERYONE, LEADS]), "ann", ONLY_A_LEAD),
        (People.merged([EVERYONE, NO_LEADS]), "ann", None),
        (People.merged([NO_LEADS, LEADS]), "zed", ONLY_A_LEAD),
        (People.merged([EVERYONE, EVERYONE]), "zed", None),
        (People.merged([]), "zed", None),
    ],
)
def test_where_there_are_leads_only_they_change_the_plan(people: People, by: str, words: str | None) -> None:
    if words is None:
        check_sender(people, by)
        return
    with pytest.raises(RequestRefused) as refused:
        check_sender(people, by)
    person = by.partition("@")[0]
    assert str(refused.value) == f"{words.format(person, person)} {SAY}"
    assert refused.value.reason == "not_allowed"

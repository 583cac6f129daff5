"""Decisions by snapshots, step by step on virtual time: cars take roles, and no role flaps."""

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.examples import EXAMPLES
from fleet.policy.decide import step
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot, Refusal
from fleet.policy.state import HUB_RETURN_GRACE_S, PolicyState, carry_over, on_hub_back, restore, to_persisted
from schemas.colors import format_color
from tests.fleet.policy.cars import GONE, HERE, PolicyRun

FIXED = parse("fixed: {red: {mode: tracking}}")
ONE = parse("roles: {scout: {mode: tracking}}")
TWO = parse("roles: {patrol: {mode: obstacle_avoidance, count: 2, priority: 1}, scout: {mode: tracking}}")
STRONG = parse("roles: {scout: {mode: tracking, needs: battery.voltage_v > 7.0}}")
LAMP = parse("""
roles:
  wait: {mode: manual, count: all}
  leader: {mode: light_seeking, given_by: rules}
  follower: {mode: following, count: all, given_by: rules}
rules:
  - when: {any_car: light.left or light.right, for_s: 1}
    then: [{who: this_car, role: leader}, {who: other_cars, role: follower}]
""")


@pytest.mark.parametrize(
    ("car", "mode", "asks"),
    [
        (HERE, "tracking", True),
        (replace(HERE, mode="tracking"), "tracking", False),
        (replace(HERE, mode="tracking", verdict="assumed"), "tracking", False),
        (replace(HERE, mode="tracking", verdict="contradicted"), "tracking", True),
        (replace(HERE, mode="unknown"), "tracking", True),
        (replace(HERE, link="stale"), "tracking", True),
        (replace(HERE, busy=True), "tracking", False),
        (CarSnapshot(), None, False),
        (replace(HERE, held_by="ann"), None, False),
        (replace(HERE, estopped_by="ann"), None, False),
        (replace(HERE, paused_by="ann"), None, False),
        (replace(HERE, lent_to="ann"), None, False),
        (replace(HERE, mode="tracking", verdict="contradicted", held_by="ann"), None, False),
        (replace(HERE, driven_by="ann"), None, False),
        (replace(HERE, present=False), None, False),
        (replace(HERE, link="lost"), None, False),
        (replace(HERE, motors="unknown"), None, False),
        (replace(HERE, doubted=True), None, False),
        (replace(HERE, motors="unknown", verdict="contradicted", mode="tracking"), "tracking", True),
    ],
)
def test_decision_commands_mode_only_if_car_is_usable(car: CarSnapshot, mode: str | None, asks: bool) -> None:
    result = step(FIXED, FleetSnapshot({"red": car}), PolicyState(started_at=-9.0), 0.0)
    (decision, *_) = result.decisions
    assert decision.mode == mode
    assert bool(result.commands) is asks


def test_doubted_car_is_left_alone_and_delays_no_phase() -> None:
    run = PolicyRun(ONE, "green", "red")
    run.at(0.0)
    run.change("green", doubted=True, motors="unknown")
    run.until(1.7)
    assert run.roles == {"red": "scout"}
    assert "in doubt" in run.of("green").why
    assert "`fleet stop green`" in run.of("green").would_change
    assert "`fleet resume green`" in run.of("green").would_change
    run.change("green", doubted=False, motors="off")
    run.until(3.0)
    assert "in doubt" not in run.of("green").why, "it is free again"


def test_role_moves_after_debounce_and_does_not_return() -> None:
    run = PolicyRun(ONE, "green", "red")
    assert run.at(0.0).roles == {"green": "scout"}
    run.change("green", present=False, mode="")
    run.until(1.5)
    assert run.roles == {"green": "scout"}, "it is kept for a moment"
    run.until(1.7)
    assert run.roles == {"red": "scout"}
    assert run.of("red").why.startswith("role scout (1 of 1): ")
    assert "in place of green: " in run.of("red").why
    run.cars["green"] = HERE
    run.until(9.0)
    assert run.roles == {"red": "scout"}
    assert [ask[1:] for ask in run.asked] == [("green", "tracking"), ("red", "tracking")]


def test_short_link_loss_keeps_role() -> None:
    run = PolicyRun(ONE, "green", "red")
    run.at(0.0)
    for begin in (1.0, 4.0, 7.0):
        run.until(begin)
        run.change("green", link="lost")
        run.until(begin + 1.4)
        run.change("green", link="online")
        run.until(begin + 2.0)
    assert run.roles == {"green": "scout"}
    assert len(run.asked) == 1


def test_hold_by_person_frees_role_at_once() -> None:
    run = PolicyRun(ONE, "green", "red")
    run.at(0.0)
    run.change("green", held_by="ann")
    assert run.at(0.1).roles == {"red": "scout"}


def test_paused_fleet_leaves_plan_and_continues_after() -> None:
    run = PolicyRun(ONE, "green", "red")
    before = run.at(0.0).roles
    for car in run.cars:
        run.change(car, paused_by="teacher", mode="manual")
    run.until(30.0)
    assert run.roles == {}
    assert run.of("red").why.endswith("by teacher")
    asked = len(run.asked)
    for car in run.cars:
        run.change(car, paused_by=None)
    run.until(32.0)
    assert run.roles == before
    assert len(run.asked) == asked + 1


def test_higher_priority_is_filled_first_at_least_cost() -> None:
    run = PolicyRun(TWO, "blue", "green", "red")
    run.change("red", mode="tracking")
    assert run.at(0.0).roles == {"blue": "patrol", "green": "patrol", "red": "scout"}
    run.change("blue", held_by="ann")
    assert run.at(0.1).roles == {"green": "patrol", "red": "patrol"}
    assert "hold by ann; green: " in run.of("role scout").why


def test_flickering_needs_change_nothing_and_old_values_count() -> None:
    run = PolicyRun(STRONG, "green", "red")
    for car in ("green", "red"):
        run.sees(car, battery={"voltage_v": 7.4})
    run.at(0.0)
    assert run.roles == {"green": "scout"}
    for turn in range(20):
        run.sees("green", battery={"voltage_v": 7.1 if turn % 2 else 6.9})
        run.until(run.now + 1.0)
    assert run.roles == {"green": "scout"}
    assert len(run.asked) == 1
    run.until(60.0)  # in tracking a car measures no battery
    assert run.roles == {"green": "scout"}
    run.sees("green", battery={"voltage_v": 6.9})
    run.until(62.0)
    assert run.roles == {"red": "scout"}
    assert run.of("green").kind == "idle"


def test_car_with_unknown_need_does_not_take_role() -> None:
    run = PolicyRun(STRONG, "red")
    run.at(0.0)
    assert run.roles == {}
    assert "not known" in run.of("role scout").why


def test_contradicted_mode_is_retried_slower_then_reassigned() -> None:
    run = PolicyRun(ONE, "green", "red", obey=False)
    run.change("green", mode="tracking", verdict="contradicted", evidence="silent for 3.1 s")
    run.change("red", mode="manual", held_by="ann")
    run.until(20.0)
    times = [at for at, car, _ in run.asked if car == "green"]
    assert [round(after - before) for before, after in pairwise(times)] == [1, 2, 4, 8]
    assert "silent for 3.1 s" in run.of("green").why
    run.change("red", held_by=None)
    run.until(20.2)
    assert run.roles == {"red": "scout"}


def test_car_that_lost_its_mode_once_keeps_its_role_while_it_changes_back() -> None:
    """A car that had reset after 11 s in its mode was replaced in the moment in which it was asked the second time."""
    run = PolicyRun(ONE, "green", "red")
    run.until(11.0)
    assert run.asked == [(0.1, "green", "tracking")]
    run.obey = False
    run.change("green", verdict="contradicted", evidence="silent for 1.2 s")
    run.at(11.1)
    run.change("green", busy=True)
    run.until(12.0)
    run.change("green", mode="manual", verdict="assumed")  # its gateway stops it first
    run.until(16.0)
    run.change("green", mode="tracking", busy=False)
    run.until(60.0)
    assert run.asked == [(0.1, "green", "tracking"), (11.1, "green", "tracking")]
    assert run.roles == {"green": "scout"}


def test_car_that_does_not_change_back_is_replaced() -> None:
    run = PolicyRun(ONE, "green", "red")
    run.until(11.0)
    run.change("green", verdict="contradicted", evidence="silent for 1.2 s")
    run.obey = False
    run.until(14.0)
    assert [car for _, car, mode in run.asked if mode == "tracking"] == ["green", "green", "red"]
    assert run.roles == {"red": "scout"}


def test_role_goes_to_another_car_after_refusal() -> None:
    run = PolicyRun(ONE, "green", "red", obey=False)
    run.at(0.0)
    run.change("green", refused=Refusal("tracking", "battery_low", "battery critical: 6.4 V", 0.2))
    run.at(0.2)
    assert run.roles == {"red": "scout"}


def test_car_that_refuses_every_mode_does_not_make_others_change_roles() -> None:
    """Both cars changed roles ten times a second: only the last refusal was known, so each role was tried again."""
    run = PolicyRun(parse("roles: {patrol: {mode: obstacle_avoidance}, guide: {mode: tracking}}"), "blue", "red")
    run.change("red", mode="obstacle_avoidance")
    run.obey = False
    for _ in range(600):
        before = len(run.asked)
        run.until(run.now + 0.1)
        for _, car, mode in run.asked[before:]:
            if car == "blue":
                run.refuse(car, mode, "battery_low")
            else:
                run.change(car, mode=mode, verdict="assumed")
    changes = [mode for _, car, mode in run.asked if car == "red"]
    assert len(changes) <= 1, "only the first refusal shows that red has to take the other role"
    assert list(run.roles) == ["red"]
    assert len([car for _, car, _ in run.asked if car == "blue"]) <= 8, "it is tried again each 10 s"
    blue = run.of("blue").why
    assert "battery_low" in blue


def test_car_that_accepts_again_gets_its_role_after_refusals() -> None:
    run = PolicyRun(parse("roles: {patrol: {mode: obstacle_avoidance}, guide: {mode: tracking}}"), "blue", obey=False)
    run.at(0.0)
    run.refuse("blue", "obstacle_avoidance", "link_down")
    run.at(0.1)
    run.refuse("blue", "tracking", "link_down")
    run.until(10.0)
    assert run.roles == {}
    run.obey = True
    run.until(10.3)
    assert run.roles == {"blue": "patrol"}
    assert run.cars["blue"].with_outcome("tracking", None).refusal_of("tracking") is None


def test_leader_sees_lamp_and_keeps_role_during_mode_change() -> None:
    run = PolicyRun(LAMP, "blue", "green", "red")
    for car in run.cars:
        run.sees(car, light={"left": False, "right": False})
    run.at(0.0)
    assert set(run.roles.values()) == {"wait"}
    for _ in range(12):
        run.sees("green", light={"left": True, "right": False})
        run.until(run.now + 0.1)
    assert run.roles == {"blue": "follower", "green": "leader", "red": "follower"}
    run.until(run.now + 7.0)  # 3.5 s of opening a mode, and a reading is not stale for 3 s
    assert run.roles["green"] == "leader"
    run.until(run.now + 3.0)
    assert set(run.roles.values()) == {"wait"}


def test_first_true_rule_wins() -> None:
    plan = parse("""
fixed: {red: {mode: tracking}, blue: {mode: manual}}
rules:
  - {when: {car: red, is: range.range_m < 0.3, for_s: 1}, then: {who: blue, mode: obstacle_avoidance}}
  - {when: {car: red, is: battery.level == 'critical'}, then: {who: blue, mode: color_led}}
""")
    run = PolicyRun(plan, "red", "blue")
    run.sees("red", range={"range_m": 0.2}, battery={"level": "critical"})
    run.at(0.0)
    assert run.of("blue").mode == "color_led"
    run.sees("red", range={"range_m": 0.2}, battery={"level": "critical"})
    run.at(1.0)
    assert run.of("blue").mode == "obstacle_avoidance"
    assert run.of("blue").readings == ("red/sensor/range range_m=0.2 (1.0 s old)",)


def test_car_off_the_line_drives_on_unless_stopped() -> None:
    """The rule ends without `fleet resume`. docs/how-to/write-a-plan.md warns of this."""
    plan = parse("""
roles: {guide: {mode: tracking}}
rules:
  - when: {any_car: not (line.left_inner or line.right_inner), with_role: guide, for_s: 5}
    then: {who: this_car, mode: manual}
""")
    run = PolicyRun(plan, "red")

    def until(end: float, on_line: bool) -> None:
        while run.now < end:
            run.sees("red", line={"left_inner": on_line, "right_inner": on_line})
            run.at(round(run.now + 0.1, 6))

    until(12.0, on_line=False)
    assert run.of("red").mode == "manual"
    until(16.0, on_line=True)
    assert run.of("red").mode == "tracking"
    until(30.0, on_line=False)
    run.change("red", held_by="ann")
    until(40.0, on_line=True)
    assert run.of("red").mode is None, "after `fleet stop red` the plan leaves it alone"
    assert run.asked[-1][1:] == ("red", "manual")


@pytest.mark.parametrize(
    ("back_s", "kept"), [(0.3, True), (HUB_RETURN_GRACE_S - 0.2, True), (HUB_RETURN_GRACE_S + 0.2, False)]
)
def test_role_waits_for_last_returning_car_after_hub_outage(back_s: float, kept: bool) -> None:
    """Without a hub, the coordinator decides nothing. A car that was only unreachable then is not lost."""
    run = PolicyRun(ONE, "blue", "green", "red")
    run.until(1.0)
    (scout,) = run.roles
    here = dict(run.cars)
    run.cars = dict.fromkeys(here, GONE)
    run.at(1.1)
    run.memory = on_hub_back(run.memory, 9.0)
    for car in here.keys() - {scout}:
        run.cars[car] = here[car]
    run.at(9.0)
    assert run.of(scout).why.startswith(f"{scout} ")
    assert run.of(scout).why.endswith(" 5 s")
    run.until(9.0 + back_s)
    run.cars[scout] = here[scout]
    run.until(20.0)
    assert (run.roles == {scout: "scout"}) is kept
    assert (len(run.asked) == 1) is kept


def test_phases_follow_conditions_and_time_outs() -> None:
    plan = parse("""
roles: {look: {mode: manual, count: all}, go: {mode: tracking, count: all}}
phases:
  search: {roles: [look], until: {any_car: light.left}, timeout_s: 30, next: run, on_timeout: give_up}
  run: {roles: [go], timeout_s: 5, next: search}
  give_up: {roles: [look]}
""")
    run = PolicyRun(plan, "red")
    run.at(0.0)
    run.until(2.0)
    run.sees("red", light={"left": True})
    assert run.at(2.1).roles == {"red": "go"}
    assert run.of("phase").why.endswith("car: light.left")
    run.until(7.0)
    assert run.roles == {"red": "go"}
    run.until(7.2)
    assert run.roles == {"red": "look"}
    run.until(40.0)
    assert run.memory.phase.name == "give_up"


def test_phases_with_the_shortest_time_outs_do_not_flap() -> None:
    plan = parse("""
roles: {look: {mode: manual}, go: {mode: tracking}}
phases: {a: {roles: [look], timeout_s: 0.01, next: b}, b: {roles: [go], timeout_s: 0.01, next: a}}
""")
    run = PolicyRun(plan, "red")
    run.at(0.0)
    run.until(15.0)
    assert all(after - before >= 1.5 for (before, *_), (after, *_) in pairwise(run.asked))


def test_role_without_car_falls_back_to_if_none() -> None:
    plan = parse("""
roles:
  strong: {mode: tracking, cars: [red], if_none: weak}
  weak: {mode: following, given_by: rules}
""")
    run = PolicyRun(plan, "blue", "red")
    assert run.at(0.0).roles == {"red": "strong"}
    run.change("red", held_by="ann")
    assert run.at(0.1).roles == {"blue": "weak"}
    assert "for strong" in run.of("blue").why
    run.change("red", held_by=None)
    assert run.at(0.2).roles == {"red": "strong"}


def test_light_effect_is_asked_once_in_mode_that_obeys() -> None:
    plan = parse("""
fixed: {red: {mode: tracking}, green: {mode: manual}}
rules: [{when: {car: green, is: light.left}, then: {who: red, mode: manual, led: '#090000'}}]
""")
    run, coloured = PolicyRun(plan, "green", "red", obey=False), list[float]()

    def until(end: float) -> None:
        while run.now < end:
            run.sees("green", light={"left": True})
            result = run.at(round(run.now + 0.1, 6))
            coloured.extend(run.now for ask in result.commands if ask.led is not None)

    run.change("red", mode="tracking")
    until(1.0)
    run.change("red", busy=True, mode="manual")
    until(2.0)
    assert coloured == [], "it would be refused"
    run.change("red", busy=False)
    until(9.0)
    assert coloured == [2.1]
    kept = to_persisted(plan, run.memory, run.now, 100.0)
    run.memory = restore(plan, FleetSnapshot(run.cars), kept, run.now, 100.0)
    until(12.0)
    assert coloured == [2.1], "nor by a coordinator that takes over"


@pytest.mark.parametrize("led", ["red", "{color: red}"])
def test_led_that_a_car_lacks_is_not_used(led: str) -> None:
    """A car got its color although the fleet file says that its LED is broken, and an stm32 car refused it for ever."""
    rules = f"rules: [{{when: light.left, then: {{who: all_cars, led: {led}}}}}]"
    run = PolicyRun(parse(f"roles: {{rest: {{mode: manual, count: all}}}}\n{rules}"), "blue", "green", "red", "white")
    run.change("green", platform="stm32")
    run.change("red", listed=True, capabilities=frozenset({"drive", "manual"}))
    run.change("white", listed=True, capabilities=frozenset({"drive", "manual", "led"}))
    run.sees("blue", light={"left": True})
    told = set[str]()
    for tenths in range(30):
        told |= {ask.car for ask in run.at(tenths / 10).commands if ask.led is not None}
    assert told == {"blue", "white"}


def test_led_blinks_while_rule_is_in_force() -> None:
    plan = parse("""
fixed: {red: {mode: manual}}
rules: [{when: {car: red, is: light.left}, then: {who: this_car, led: {color: red, blink_s: 0.5}}}]
""")
    run, told = PolicyRun(plan, "red"), list[tuple[float, str]]()

    def until(end: float, light: bool) -> None:
        while run.now < end:
            run.sees("red", light={"left": light})
            for ask in run.at(round(run.now + 0.1, 6)).commands:
                if ask.led is not None:
                    told.append((run.now, format_color(ask.led)))

    until(1.6, light=True)
    assert told == [(0.1, "red"), (0.6, "black"), (1.1, "red"), (1.6, "black")]
    run.change("red", held_by="ann")
    until(2.5, light=True)
    assert len(told) == 4, "a car that a person has stopped is left alone"
    run.change("red", held_by=None)
    until(2.7, light=True)
    assert told[4:] == [(2.6, "red")]
    until(9.0, light=False)
    assert [color for _, color in told[5:]][-1] == "black"
    assert told[-1][0] < 5.0, "the rule ends 1.5 s after its condition, and the LED with it"


@pytest.mark.parametrize("priority", [-1, 0, 1])
def test_stand_in_takes_no_car_from_its_role_or_higher_priority(
    priority: int,
) -> None:
    plan = parse(f"""
roles:
  scout: {{mode: tracking, priority: {priority + 1}}}
  pair: {{mode: following, count: 3, priority: {priority}, if_none: rest}}
  rest: {{mode: manual, given_by: rules}}
""")
    run = PolicyRun(plan, "blue", "green", "pi")
    run.change("pi", platform="raspberry_pi")
    run.change("green", held_by="ann")
    assert run.at(0.0).roles == {"blue": "scout", "pi": "rest"}
    run.change("green", held_by=None)
    run.until(3.0)
    assert run.roles == {"blue": "scout", "green": "pair", "pi": "rest"}
    run.cars["red"] = HERE
    run.until(6.0)
    assert run.roles == {"blue": "scout", "green": "pair", "pi": "rest", "red": "pair"}
    assert [ask[1:] for ask in run.asked] == [("blue", "tracking"), ("green", "following"), ("red", "following")]


def test_coordinator_restart_keeps_modes_and_roles() -> None:
    run = PolicyRun(TWO, "blue", "green", "red")
    run.change("red", mode="obstacle_avoidance")
    run.at(0.0)
    before, asked = run.roles, len(run.asked)
    run.memory = PolicyState()
    run.at(10.0)
    assert len(run.asked) == asked
    assert run.roles == before
    same = parse("roles: {a: {mode: tracking}, b: {mode: tracking}}")
    run = PolicyRun(same, "green", "red")
    run.at(0.0)
    kept = replace(to_persisted(same, run.memory, 1.0, 100.0), roles={"green": "b", "red": "a"})
    run.memory = restore(same, FleetSnapshot(run.cars), kept, 2.0, 101.0)
    run.at(2.0)
    assert run.roles == {"green": "b", "red": "a"}
    assert len(run.asked) == 2


def test_carry_over_keeps_roles_of_new_plan() -> None:
    run = PolicyRun(TWO, "blue", "green", "red")
    run.at(0.0)
    before, asked = run.roles, len(run.asked)
    after = parse(TWO.text + "\nrules: [{when: {any_car: light.left}, then: {who: this_car, mode: manual}}]")
    run.memory, run.plan = carry_over(run.memory, run.plan, after), after
    run.at(0.1)
    assert (run.roles, len(run.asked)) == (before, asked)


def test_roles_wait_at_start_for_unheard_cars() -> None:
    run = PolicyRun(ONE, "green", "red")
    run.change("red", mode="")
    assert run.at(0.0).decisions == ()
    run.change("red", mode="tracking")
    assert run.at(0.3).roles == {"red": "scout"}
    assert run.asked == []


REST = "rest: {mode: manual, count: all}"
PATROL = "patrol: {mode: tracking, count: 1}"


def test_role_for_all_others_starves_no_other_role() -> None:
    run = PolicyRun(parse(f"roles: {{{REST}}}"), "blue", "green", "red")
    run.until(2.0)
    assert set(run.roles.values()) == {"rest"}
    for roles in (f"{PATROL}, {REST}", f"{REST}, {PATROL}"):
        after = parse(f"roles: {{{roles}}}")
        memory, again = carry_over(run.memory, run.plan, after), PolicyRun(after, *run.cars)
        again.memory, again.now = memory, run.now
        again.until(4.0)
        assert sorted(again.roles.values()) == ["patrol", "rest", "rest"]
        assert len(again.asked) == 1, "and only one car changes its mode"


def test_after_all_were_stopped_the_counted_role_is_filled_first() -> None:
    run = PolicyRun(parse(f"roles: {{{PATROL}, {REST}}}"), "blue", "green", "red")
    run.at(0.0)
    for car in run.cars:
        run.change(car, held_by="ann", mode="manual")
    run.until(3.0)
    for car in ("red", "green", "blue"):
        run.change(car, held_by=None)
        run.until(run.now + 1.0)
        assert list(run.roles.values()).count("patrol") == 1
    run.until(60.0)
    assert [mode for _, _, mode in run.asked] == ["tracking", "tracking"], "and nothing flaps"


def test_next_phase_takes_cars_from_role_for_all_others() -> None:
    plan = parse("""
roles: {a: {mode: tracking}, b: {mode: following, count: 2}, c: {mode: manual, count: all}}
phases: {one: {roles: [a, c], timeout_s: 5, next: two}, two: {roles: [b, c]}}
""")
    run = PolicyRun(plan, "blue", "green", "red")
    run.until(4.0)
    assert sorted(run.roles.values()) == ["a", "c", "c"]
    run.until(6.0)
    assert sorted(run.roles.values()) == ["b", "b", "c"]


def test_failing_car_swaps_role_with_role_for_all_others() -> None:
    run = PolicyRun(parse(f"roles: {{{PATROL}, {REST}}}"), "blue", "red", obey=False)
    run.change("blue", mode="tracking")
    run.until(1.0)
    assert run.roles == {"blue": "patrol", "red": "rest"}
    run.change("blue", verdict="contradicted", evidence="silent for 3.1 s")
    run.until(6.0)
    assert run.roles == {"blue": "rest", "red": "patrol"}


CARS = ("a", "b", "c", "d")
PLANS = (
    TWO,
    STRONG,
    LAMP,
    parse("""
fixed: {d: {mode: manual}}
roles: {x: {mode: tracking, count: 2, if_none: y}, y: {mode: following, needs: battery.voltage_v > 7, priority: 3}}
rules: [{when: {all_cars: not obstacle.left, for_s: 1}, then: {who: all_cars, mode: color_led}}]
"""),
)
changes = st.tuples(
    st.sampled_from(CARS),
    st.sampled_from(
        [
            {"present": False, "mode": ""},
            {"present": True, "mode": "manual"},
            {"held_by": "ann"},
            {"held_by": None},
            {"estopped_by": "ann"},
            {"estopped_by": None},
            {"driven_by": "bob"},
            {"driven_by": None},
            {"link": "lost"},
            {"link": "online"},
            {"verdict": "contradicted"},
            {"platform": "raspberry_pi"},
            {"motors": "unknown"},
            {"motors": "off"},
            {"doubted": True},
            {"doubted": False},
            {"light": True},
            {"light": False},
            {"voltage": 6.5},
            {"voltage": 7.5},
        ]
    ),
    st.sampled_from([0.1, 0.7, 1.6, 3.1]),
)


def _run(plan: Any, course: list[Any]) -> tuple[list[Any], PolicyRun]:
    run = PolicyRun(plan, *CARS)
    told = []
    for car, fields, wait_s in course:
        if "light" in fields:
            run.sees(car, light={"left": fields["light"], "right": False})
        elif "voltage" in fields:
            run.sees(car, battery={"voltage_v": fields["voltage"]})
        else:
            run.change(car, **fields)
        told.append(run.at(round(run.now + wait_s, 6)))
    return told, run


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(PLANS), st.lists(changes, max_size=30))
def test_decisions_are_deterministic_for_random_courses(plan: Any, course: list[Any]) -> None:
    told, _ = _run(plan, course)
    again, _ = _run(plan, course)
    assert told == again, "the same input gives the same decisions"
    run = PolicyRun(plan, *CARS)
    for (car, fields, wait_s), result in zip(course, told, strict=True):
        if not {"light", "voltage"} & set(fields):
            run.change(car, **fields)
        run.at(round(run.now + wait_s, 6))
        assert not {ask.car for ask in result.commands} & {
            name for name, known in run.cars.items() if known.held_by or known.estopped_by
        }
        for name, known in run.cars.items():
            if (known.held_by or known.estopped_by) and known.mode:  # else no state is known
                assert name not in result.roles
        for role in plan.roles.values():
            if role.count is not None and not any(other.if_none == role.name for other in plan.roles.values()):
                assert list(result.roles.values()).count(role.name) <= role.count
        subjects = [decision.car for decision in result.decisions if decision.car is not None]
        assert len(subjects) == len(set(subjects)), "no car has two decisions"


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(PLANS[:2]), st.lists(changes, max_size=12))
def test_decisions_settle_without_changes(plan: Any, course: list[Any]) -> None:
    _, run = _run(plan, course)
    for car in CARS:
        run.change(car, verdict="assumed", busy=False)
    run.until(run.now + 12.0, 0.5)
    for _ in range(20):
        run.at(run.now + 0.5)
        assert run.last.changed == ()
        assert run.last.commands == ()


def test_gone_is_gone() -> None:
    assert step(FIXED, FleetSnapshot({"red": GONE}), PolicyState(started_at=-9.0), 0.0).commands == ()


EXAMPLE = parse((EXAMPLES / "plans" / "2-line-guide.yaml").read_text(encoding="utf-8"))
LINE = dict.fromkeys(("left_outer", "left_inner", "right_inner", "right_outer"), False)


def test_example_plan_guide_stands_without_line() -> None:
    run = PolicyRun(EXAMPLE, "blue", "green", "red")
    for car in run.cars:
        run.sees(car, battery={"voltage_v": 7.9, "level": "ok"})
    run.until(2.0)
    (guide,) = (car for car, role in run.roles.items() if role == "guide")
    while run.now < 8.0:
        run.sees(guide, line=LINE)
        run.until(run.now + 0.5)
    assert (run.of(guide).mode, run.of(guide).kind) == ("manual", "rule")
    while run.now < 11.0:
        run.sees(guide, line={**LINE, "left_inner": True})
        run.until(run.now + 0.5)
    assert run.of(guide).mode == "tracking"


def test_example_plan_blinks_weak_car() -> None:
    run = PolicyRun(EXAMPLE, "blue", "red")
    run.sees("blue", battery={"voltage_v": 7.9, "level": "ok"})
    asked = []
    while run.now < 8.0:
        run.sees("red", battery={"voltage_v": 6.8, "level": "low"})
        asked += [(ask.car, ask.led) for ask in run.until(run.now + 0.5, every=0.5).commands if ask.led is not None]
    assert asked[:2] == [("red", (255, 0, 0)), ("red", (0, 0, 0))]
    assert run.roles == {"blue": "patrol"}


def test_doubted_car_does_not_block_phase_timeout() -> None:
    plan = parse(
        """
roles: {scout: {mode: tracking, count: 1}}
phases:
  look: {timeout_s: 2, on_timeout: rest}
  rest: {}
"""
    )
    recovering, doubted = PolicyRun(plan, "green", "red"), PolicyRun(plan, "green", "red")
    recovering.change("red", motors="unknown")
    doubted.change("red", motors="unknown", doubted=True)
    for run in (recovering, doubted):
        run.at(0.0)
        run.until(4.0)
    assert (recovering.memory.phase.name, doubted.memory.phase.name) == ("look", "rest")

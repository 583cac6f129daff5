"""The check finds rules and phases on readings that no car measures in the modes of the plan."""

import pytest

from fleet.policy.lint.lint import Severity, check
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import CarSnapshot
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from tests.support.text_parts import has_parts


def listed(platform: str) -> CarSnapshot:
    profile = parse_platform(platform)
    able = frozenset(str(word) for word in (*profile.capabilities, *profile.modes))
    return CarSnapshot(platform=platform, capabilities=able, listed=True)


TWO = {"red": listed("arduino"), "blue": listed("arduino")}
THREE = {**TWO, "green": listed("arduino")}
GUIDE = "roles: {guide: {mode: tracking, count: all}}\n"
PATROL = "roles: {patrol: {mode: obstacle_avoidance, count: all}}\n"
SEARCH = """
roles: {patrol: {mode: obstacle_avoidance, count: all}, rest: {mode: manual, count: all, priority: -1}}
phases: {search: {SEARCH, until: {any_car: light.left or light.right, for_s: 1}, next: gather}, gather: {roles: [rest]}}
"""
LIGHT = "rules: [{when: {any_car: light.left or light.right, for_s: 1}, then: {who: other_cars, mode: following}}]"


def found(text: str, fleet: dict[str, CarSnapshot] | None, severity: Severity) -> list[str]:
    return [str(each) for each in check(parse(text), fleet) if each.severity is severity]


@pytest.mark.parametrize("fleet", [None, THREE], ids=["any cars", "three cars"])
@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            (
                "roles: {guide: {mode: tracking}}\n"
                "rules: [{when: {any_car: battery.level == 'low', with_role: guide}, then: {who: red, mode: manual}}]"
            ),
            "rule 1: it never fires. … battery.level … role guide, … always in tracking. … only in manual.",
        ),
        (
            GUIDE
            + "rules: [{when: {any_car: range.range_m < 0.3, with_role: guide}, then: {who: this_car, mode: manual}}]",
            "rule 1: it never fires. … range.range_m … role guide",
        ),
        (
            GUIDE
            + "rules: [{when: {any_car: light.left, with_role: guide}, then: {who: this_car, mode: light_seeking}}]",
            "only in manual or light_seeking.",
        ),
        (PATROL + LIGHT, "rule 1: it never fires. … light.left … always in"),
        (
            SEARCH.replace("SEARCH", "roles: [patrol]"),
            (
                "phase search: it never ends. … light.left … obstacle_avoidance in phase search. … "
                "only in manual or light_seeking. … timeout_s."
            ),
        ),
        # Two rules, each of which could only fire after the other one.
        (
            GUIDE
            + "rules:\n  - {when: {any_car: light.left}, then: {who: all_cars, mode: following}}\n"
            + "  - {when: {any_car: obstacle.left}, then: {who: all_cars, mode: light_seeking}}",
            "rule 1: it never fires. … light.left",
        ),
        # A role that only such a rule assigns.
        (
            (
                "roles: {guide: {mode: tracking, count: all}, seek: {mode: light_seeking, given_by: rules}}\n"
                "rules:\n  - {when: {any_car: light.left}, then: {who: this_car, role: seek}}\n"
                "  - {when: {any_car: light.right, with_role: seek}, then: {who: this_car, mode: manual}}"
            ),
            "rule 2: it never fires. … role seek.",
        ),
        # Each field is measured in some mode, but no mode of the plan measures both.
        (
            (
                "roles: {guide: {mode: tracking, count: all}, seek: {mode: light_seeking, count: all}}\n"
                "rules: [{when: {any_car: light.left and line.left_outer}, then: {who: this_car, mode: manual}}]"
            ),
            "rule 1: it never fires. … all of light.left, line.left_outer ",
        ),
    ],
)
def test_condition_on_never_measured_reading_is_error(
    text: str, told: str, fleet: dict[str, CarSnapshot] | None
) -> None:
    assert any(has_parts(each, told) for each in found(text, fleet, Severity.ERROR)), check(parse(text), fleet)


@pytest.mark.parametrize(
    ("text", "fleet", "told"),
    [
        (
            PATROL.replace("count: all", "count: all, needs: battery.voltage_v > 7") + LIGHT,
            None,
            "rule 1: it fires only … no role … battery.voltage_v > 7",
        ),
        (
            SEARCH.replace("SEARCH", "timeout_s: 60, roles: [patrol]"),
            THREE,
            "phase search: only its timeout … light.left … always in obs",
        ),
        (
            SEARCH.replace("SEARCH", "roles: [patrol]")
            + "rules: [{name: home, when: {car: red, is: motion.fan}, then: {phase: gather}, during: [search]}]",
            THREE,
            "phase search: only rule home ends it. It waits for light.left from cars, but they are always in obs",
        ),
        (
            SEARCH.replace("SEARCH", "timeout_s: 1.6, roles: [rest]").replace("for_s: 1", "for_s: 2"),
            THREE,
            "phase search: only its timeout … `until` … 2 s, … timeout_s … 1.6.",
        ),
    ],
)
def test_condition_on_rarely_measured_reading_is_warning(
    text: str, fleet: dict[str, CarSnapshot] | None, told: str
) -> None:
    assert any(has_parts(each, told) for each in found(text, fleet, Severity.WARNING)), check(parse(text), fleet)
    assert found(text, fleet, Severity.ERROR) == []


TWO_PATROLS = PATROL.replace("count: all", "count: 2")


@pytest.mark.parametrize(
    ("text", "fleet"),
    [
        (TWO_PATROLS + LIGHT, None),  # a third car has no role, and stands
        (TWO_PATROLS + LIGHT, THREE),
        (SEARCH.replace("SEARCH", "roles: [rest]"), None),
        # One measured alternative is enough.
        (
            GUIDE + "rules: [{when: {any_car: light.left or line.left_outer}, then: {who: this_car, mode: manual}}]",
            THREE,
        ),
        # The first rule brings the cars into the mode in which the second rule has its reading.
        (
            GUIDE
            + "rules:\n  - {when: line.left_outer, until: light.left, then: {who: this_car, mode: manual}}\n"
            + "  - {when: {any_car: light.left, for_s: 9}, then: {phase: b}}\nphases: {a: {}, b: {}}",
            THREE,
        ),
        # A rule about the needs of a role is for the cars that lack them.
        (
            (
                "roles: {guide: {mode: tracking, count: all, needs: battery.voltage_v > 7}}\n"
                "rules: [{when: {any_car: battery.level == 'low', for_s: 5}, then: {who: this_car, led: red}}]"
            ),
            THREE,
        ),
        (
            (
                "roles: {guide: {mode: manual, count: all}}\nphases: {b: {}, a: {}}\n"
                "rules: [{when: {any_car: imu.gyro_x_raw > 9}, then: {phase: a}}]"
            ),
            None,
        ),
    ],
)
def test_condition_on_measured_reading_has_no_finding(text: str, fleet: dict[str, CarSnapshot] | None) -> None:
    assert [str(each) for each in check(parse(text), fleet) if "measured" in str(each) or "only" in str(each)] == []


def test_two_cars_for_two_places_leave_none_that_stands() -> None:
    (told,) = found(TWO_PATROLS + LIGHT, TWO, Severity.ERROR)
    assert told.startswith("rule 1: it never fires. It waits for light.left from cars")


def test_large_fleet_and_long_plan_are_checked_in_time() -> None:
    """The check handles a hundred cars, each with a role of its own, and the maximum number of rules in time."""
    cars = {f"car{number}": listed("arduino") for number in range(100)}
    roles = "".join(f"  role{number}: {{mode: tracking, count: 5}}\n" for number in range(20))
    rules = "".join(
        f"  - {{when: {{any_car: range.range_m < 0.{number + 1}}}, then: {{who: this_car, mode: following}}}}\n"
        for number in range(200)
    )
    plan = parse(f"roles:\n{roles}rules:\n{rules}")
    told = check(plan, cars)
    assert len([each for each in told if "it never fires. It waits for range.range_m" in str(each)]) == 200

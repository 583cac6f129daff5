"""`fleet check` finds parts of a plan that can never work, and accepts all others."""

import pytest
from msgspec.structs import replace

from fleet.policy.lint.lint import Severity, check, find_faults
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import CarSnapshot
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from tests.support.text_parts import has_parts


def listed(platform: str, *roles: str) -> CarSnapshot:
    profile = parse_platform(platform)
    able = frozenset(str(word) for word in (*profile.capabilities, *profile.modes))
    return CarSnapshot(platform=platform, capabilities=able, roles=frozenset(roles) or None, listed=True)


FLEET = {"red": listed("arduino"), "green": listed("arduino", "scout"), "pi": listed("raspberry_pi")}
SCOUT = "roles: {scout: {mode: tracking}}\n"


@pytest.mark.parametrize(
    ("text", "part", "told"),
    [
        ("roles: {x: {mode: tracking, cars: [pi]}}", "role x", "raspberry_pi"),
        ("roles: {x: {mode: tracking, capabilities: [arm]}}", "role x", "red: … arm"),
        (
            "roles: {x: {mode: tracking, needs: battery.voltage_v > 8 and battery.voltage_v < 7}}",
            "role x",
            "is never true",
        ),
        (
            "roles: {x: {mode: manual, cars: [pi], needs: battery.voltage_v > 7}}",
            "role x",
            "and never measures battery.voltage_v",
        ),
        ("roles: {x: {mode: tracking, given_by: rules}}", "role x", "no rule"),
        ("fixed: {purple: {mode: manual}}", "car purple", "no such car. … green, pi, red."),
        (
            SCOUT + "rules: [{when: {car: zed, is: light.left}, then: {who: red, mode: manual}}]",
            "car zed",
            "no such car",
        ),
        (
            SCOUT
            + "rules: [{when: {any_car: range.range_m < 1 and range.range_m > 2}, then: {who: red, mode: manual}}]",
            "rule 1",
            "it never fires. range.range_m < 1 and range.range_m > 2 is never true",
        ),
        (
            SCOUT + "rules: [{when: {any_car: light.left, with_role: scout}, then: {who: all_cars, mode: tracking}}]",
            "rule 1",
            "never fires. … light.left … role scout, … tracking.",
        ),
        (
            SCOUT + "rules: [{when: {car: red, is: line.left_outer}, then: {who: pi, mode: tracking}}]",
            "rule 1",
            "raspberry_pi car, … mode tracking",
        ),
        (
            SCOUT
            + "rules:\n  - {when: {any_car: line.left_outer}, then: {who: red, mode: manual}}\n"
            + "  - {when: {any_car: line.left_outer}, then: {who: red, mode: following}}",
            "rule 2",
            "it contradicts rule 1",
        ),
        (SCOUT + "phases: {x: {}, y: {}}", "phase y", "nothing leads"),
        (
            SCOUT + "phases: {x: {until: {car: red, is: imu.gyro_x_raw > 3}, next: x}}",
            "phase x",
            "never ends. … imu.gyro_x_raw from red, … no mode ",
        ),
        ("roles: {x: {mode: tracking, needs: battery.voltage_v > 20}}", "role x", "battery.voltage_v is 0 .. 13"),
        (
            SCOUT + "rules: [{when: {any_car: mode.asked == 'dancing'}, then: {who: red, mode: manual}}]",
            "rule 1",
            "never fires. mode.asked == 'dancing' … mode.asked … manual, remote_control,",
        ),
        (
            SCOUT + "rules: [{when: {any_car: mode.asked == 'manual'}, then: {who: this_car, mode: following}}]",
            "rule 1",
            "undoes itself … mode following, mode.asked == 'manual' … `until`.",
        ),
        (
            SCOUT
            + "rules:\n  - {when: {any_car: range.range_m < 0.5}, then: {who: all_cars, mode: manual}}\n"
            + "  - {when: {car: red, is: range.range_m < 0.3}, then: {who: this_car, mode: following}}",
            "rule 2",
            "it contradicts rule 1: whenever it is true, that one is, too, and wants the same car to be manual",
        ),
        (
            SCOUT
            + "rules:\n  - {when: {any_car: line.left_outer}, then: {who: red, led: '#090000'}}\n"
            + "  - {when: {any_car: line.left_outer}, then: {who: red, led: '#000900'}}",
            "rule 2",
            "it contradicts rule 1: whenever it is true, that one is, too, and wants red to be #090000",
        ),
        (
            SCOUT + "rules: [{when: line.left_outer, then: [{who: red, mode: manual}, {who: red, mode: following}]}]",
            "rule 1",
            "it contradicts itself",
        ),
        (
            SCOUT + "rules: [{when: {any_car: line.left_outer}, then: {who: red, mode: following, led: '#090000'}}]",
            "rule 1",
            "its color",
        ),
        (
            SCOUT + "rules: [{when: {any_car: line.left_outer}, then: {who: pi, role: scout}}]",
            "rule 1",
            "role scout: raspberry_pi cars … mode tracking",
        ),
        (
            (
                "roles: {x: {mode: tracking}, y: {mode: manual}}\n"
                "phases: {a: {roles: [x], timeout_s: 9, next: b}, b: {}}\n"
                "rules: [{when: {any_car: battery.level == 'low', with_role: y}, then: {who: red, mode: manual},"
                " during: [a]}]"
            ),
            "rule 1",
            "never fires. … Role y … phase a.",
        ),
        (
            (
                "roles: {x: {mode: tracking}, y: {mode: manual}}\n"
                "phases: {a: {roles: [x], timeout_s: 9, next: b}, b: {}}\n"
                "rules: [{when: {any_car: line.left_outer}, then: {who: red, role: y}, during: [a]}]"
            ),
            "rule 1",
            "no effect. … Role y … phase a.",
        ),
        (
            (
                "roles: {x: {mode: tracking}, y: {mode: manual}}\n"
                "phases: {a: {roles: [x], until: {any_car: battery.level == 'low', with_role: y}, next: b}, b: {}}"
            ),
            "phase a",
            "never ends. … Role y ",
        ),
        (
            SCOUT
            + "rules: [{when: {any_car: line.left_outer}, until: {any_car: line.left_outer or line.right_outer},"
            + " then: {who: all_cars, mode: following}}]",
            "rule 1",
            "never fires. … `until` (any car: line.left_outer or line.right_outer) ",
        ),
    ],
)
def test_lint_errors_of_impossible_plan_parts(text: str, part: str, told: str) -> None:
    errors = [each for each in check(parse(text), FLEET) if each.severity is Severity.ERROR]
    assert [each.part for each in errors if has_parts(each.words, told)] == [part], [str(each) for each in errors]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("roles: {x: {mode: tracking, count: 3}}", "3 cars, … only red"),
        (SCOUT + "phases: {a: {timeout_s: 0.01, next: b}, b: {timeout_s: 9, next: a}}", "it lasts 1.5 s at least"),
        (
            SCOUT + "rules: [{when: {car: red, is: range.range_m < 0.3}, then: {who: red, mode: tracking}}]",
            "ends itself. … mode tracking … range.range_m. … `until`.",
        ),
        ("roles: {x: {mode: tracking}, y: {mode: manual}}\nphases: {p: {roles: [x]}}", "no phase"),
        (
            SCOUT + "phases: {a: {next: b}, b: {}}",
            "`fleet plan next` … until nor timeout_s.",
        ),
        (
            (
                "roles: {patrol: {mode: obstacle_avoidance}, rest: {mode: manual}}\n"
                "rules: [{when: battery_v < 7, then: {who: this_car, mode: manual}}]"
            ),
            "never sees … role patrol: in obstacle_avoidance … battery.voltage_v.",
        ),
        (
            "roles: {patrol: {mode: obstacle_avoidance, count: all}, guide: {mode: tracking, needs: battery_v > 7}}",
            "may never … obstacle_avoidance, … battery.voltage_v.",
        ),
        (
            SCOUT
            + "rules:\n  - {when: {any_car: line.left_outer}, then: {who: red, mode: manual}}\n"
            + "  - {when: {any_car: line.right_outer}, then: {who: red, mode: following}}",
            "with rule 1, ",
        ),
    ],
)
def test_lint_warnings_of_partly_possible_plan_parts(text: str, told: str) -> None:
    found = check(parse(text), FLEET)
    assert [each.severity for each in found if has_parts(each.words, told)] == [Severity.WARNING], [
        str(each) for each in found
    ]
    assert not [each for each in found if each.severity is Severity.ERROR]


@pytest.mark.parametrize(
    ("who", "told"),
    [("all_cars", "no car has a color LED"), ("green", "green has no color LED"), ("red", "red has no color LED")],
)
def test_color_that_no_car_can_show_is_told(who: str, told: str) -> None:
    fleet = {"red": replace(listed("arduino"), capabilities=frozenset({"tracking"})), "green": listed("stm32")}
    plan = parse(SCOUT + f"rules: [{{when: {{car: red, is: light.left}}, then: {{who: {who}, led: red}}}}]")
    found = [each for each in check(plan, fleet) if has_parts(each.words, f"never seen: {told}")]
    assert [(each.severity, each.part) for each in found] == [(Severity.WARNING, "rule 1")]
    able = {**fleet, "red" if who == "all_cars" else who: listed("arduino")}
    assert not any("LED" in each.words for each in check(plan, able))


@pytest.mark.parametrize(
    "others",
    [
        "patrol: {mode: obstacle_avoidance, needs: battery_v > 6, count: all}",  # manual until the battery is measured
        "patrol: {mode: obstacle_avoidance, count: all, priority: -1}, rest: {mode: manual}",
        "patrol: {mode: obstacle_avoidance, cars: [green], count: all}",
    ],
)
def test_need_measured_before_role_is_accepted(others: str) -> None:
    plan = parse(f"roles: {{{others}, guide: {{mode: tracking, needs: battery_v > 7}}}}")
    assert [each.words for each in check(plan, {**FLEET, "blue": listed("arduino")}) if "never get" in each.words] == []


def test_good_plan_passes_with_and_without_fleet_file() -> None:
    plan = parse("""
roles: {scout: {mode: tracking, needs: battery.voltage_v > 7}, rest: {mode: manual, count: all, priority: -1}}
rules: [{when: {any_car: line.left_outer, with_role: scout, for_s: 1}, then: {who: other_cars, mode: color_led}}]
phases: {one: {timeout_s: 9, next: two}, two: {until: {car: red, is: line.left_outer}, next: one}}
""")
    assert check(plan) == ()
    assert check(plan, FLEET) == ()


@pytest.mark.parametrize(
    "more",
    [
        # The narrower rule comes first, so the overlap is intended.
        (
            "rules: [{when: {any_car: range.range_m < 0.1}, then: {who: red, mode: manual}},"
            " {when: {any_car: range.range_m < 0.9}, then: {who: red, mode: following}}]"
        ),
        (
            "rules: [{when: {car: red, is: line.left_outer and not line.right_outer}, then: {who: red, mode: manual}},"
            " {when: {car: red, is: line.right_outer}, then: {who: red, mode: following}}]"
        ),
        (
            "rules: [{when: {any_car: line.left_outer}, then: {who: red, mode: manual}},"
            " {when: {any_car: line.right_outer}, then: {who: green, mode: following}}]"
        ),
        (
            "rules: [{when: {any_car: line.left_outer}, then: {phase: b}}]\nphases: {a: {timeout_s: 9, next: b},"
            " b: {until: {any_car: line.left_outer}, next: a}}"
        ),
        "phases: {a: {until: line.left_outer, next: b}, b: {until: not line.left_outer, next: a}}",
    ],
)
def test_plan_without_conflicts_passes(more: str) -> None:
    plan = parse("roles: {scout: {mode: tracking, count: all}, near: {mode: manual}}\n" + more)
    assert [
        str(each) for each in check(plan, FLEET) if each.severity is Severity.ERROR or "together" in str(each)
    ] == []


BROKEN = parse("""
fixed: {purple: {mode: tracking}}
roles:
  patrol: {mode: tracking, cars: [orange]}
  ghost: {mode: following, needs: battery.voltage_v > 9 and battery.voltage_v < 8}
""")


def test_unreachable_plan_with_fleet_file_is_refused_with_all_faults() -> None:
    refusal = find_faults(BROKEN, FLEET).refusal("plan.yaml")
    assert [line.split(": ")[2] for line in refusal.splitlines()] == [
        "car purple",
        "car orange",
        "role ghost",
    ], "by line, and a car that is missing once"
    assert all(line.startswith("plan.yaml:") for line in refusal.splitlines())


def test_named_absent_car_without_fleet_file_is_warning() -> None:
    plan = parse("fixed: {purple: {mode: tracking}, red: {mode: manual}}")
    assert find_faults(plan).warnings == ()
    found = find_faults(plan, None, {"red", "green"})
    (warning,) = found.warnings
    assert str(warning).startswith("car purple: ")
    assert str(warning).endswith(": green, red.")
    assert found.refusal() == ""
    assert "role ghost: " in find_faults(BROKEN).refusal(), "what no car could do is refused anyway"


def test_misspelled_word_for_cars_is_an_error_once() -> None:
    plan = parse(SCOUT + "rules: [{when: line.left_outer, then: {who: this_cars, mode: manual}}]")
    for cars in (None, FLEET):
        (error,) = find_faults(plan, cars, {"red"}).errors
        assert (error.part, error.line) == ("car this_cars", plan.places["car this_cars"][0])
        assert error.words.endswith("Did you mean this_car?")
    assert find_faults(plan, None, {"red"}).warnings == ()
    named = parse(SCOUT + "rules: [{when: {car: rad, is: line.left_outer}, then: {who: rad, mode: manual}}]")
    (error,) = find_faults(named, FLEET).errors
    assert str(error).startswith("car rad: ")
    assert str(error).endswith(" mean red?")
    assert find_faults(named).errors == ()


def test_fleet_file_role_missing_in_plan_is_told() -> None:
    fleet = {"red": listed("arduino", "patroll", "patrol"), "blue": listed("arduino")}
    (found,) = check(parse("roles: {patrol: {mode: tracking}}"), fleet)
    assert found.severity is Severity.WARNING
    assert str(found).startswith("car red: ")
    assert "role patroll" in found.words
    assert " mean patrol?" in found.words

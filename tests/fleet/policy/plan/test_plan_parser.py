"""The fields of a plan. All mistakes are reported at once, with line, column and the allowed values."""

from pathlib import Path

import pytest

from fleet.examples import EXAMPLES
from fleet.policy.lint.lint import check
from fleet.policy.plan.plan import Quantifier
from fleet.policy.plan.plan_parser import parse
from schemas.words import Mode
from schemas.yaml_document.document import BadFile
from tests.support.text_parts import has_parts


@pytest.mark.parametrize("path", sorted((EXAMPLES / "plans").glob("*.yaml")), ids=lambda path: path.name)
def test_example_plans_are_plans(path: Path) -> None:
    plan = parse(path.read_text(encoding="utf-8"))
    assert plan.roles
    assert check(plan) == ()


def test_fixed_mode_of_car_is_own_role() -> None:
    plan = parse(
        "fixed: {red: {mode: tracking}, blue: {mode: tracking}, green: {role: patrol}}\n"
        "roles: {patrol: {mode: following}}"
    )
    assert plan.roles["tracking"].cars == ("red", "blue")
    assert plan.roles["tracking"].count == 2
    assert plan.roles["patrol"].mode is Mode.FOLLOWING
    assert plan.may("green", plan.roles["patrol"])
    assert not plan.may("red", plan.roles["patrol"])
    assert plan.version == parse(plan.text).version != parse(plan.text + "#").version


def test_on_no_and_y_are_names_and_not_yaml_1_1_booleans() -> None:
    plan = parse("fixed: {on: {mode: manual}, no: {mode: tracking}, 'off': {mode: manual}, y: {mode: manual}}")
    assert list(plan.fixed) == ["on", "no", "off", "y"]


def test_text_of_a_condition_has_its_cars_and_its_time() -> None:
    plan = parse(
        "fixed: {red: {mode: tracking}}\n"
        "rules: [{when: {all_cars: not (light.left), for_s: 2}, then: {who: all_cars, mode: manual}}]"
    )
    (rule,) = plan.rules
    assert rule.when.of is Quantifier.ALL
    assert rule.when.text == "all cars: not light.left for 2 s"


ROLE = "roles: {a: {mode: tracking}, b: {mode: manual}}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "p:1:1: error: … empty"),
        ("{}", "p:1:1: error: … roles. … `roles: {"),
        ("fixed: {red: {role: fast}}", "p:1:21: error: fixed.red.role: … role fast. "),
        ("fixed: {red: {mode: manual}, red: {mode: tracking}}", "p:1:30: error: fixed.red: is given twice"),
        ("fixed: {Red: {mode: manual}}", "p:1:9: error: fixed.Red"),
        (
            "rolls: {}",
            "p:1:1: error: rolls: … mean roles?",
        ),
        (
            "roles: {a: {mode: tracking, count: 0}}",
            "p:1:36: error: roles.a.count: 0 … whole number, … 1",
        ),
        (
            "roles: {a: {mode: tracking, count: two}}",
            "'two' … whole number, … 1 … 1000 … all.",
        ),
        (
            "roles: {a: {mode: tracking}}\nrules: [{when: line.left_inner, then: {who: this_car, mode: trakcing}}]",
            "rule 1, then.mode: 'trakcing' … mean tracking?",
        ),
        (
            "fixed: {Red: {mode: manual}}",
            "fixed.Red: name 'Red' … 1 to 32 of a-z, 0-9, _ and -, ",
        ),
        (
            "roles: {a: {}}",
            "p:1:9: error: roles.a.mode: is missing. … manual, remote_con",
        ),
        ("roles: {a: {mode: tracking, needs: volts > 7}}", "volts … value. … range.range_m"),
        (
            "roles: {a: {mode: tracking, needs: battery > 7.0}}",
            "battery … value. … battery.voltage_v or",
        ),
        ("roles: {a: {mode: tracking, platforms: [raspberry_pi]}}", "raspberry_pi cars … mode tracking"),
        ("roles: {a: {mode: tracking, if_none: b}}", "roles.a.if_none: … role b. … only a."),
        ("roles: {a: {mode: tracking, if_none: a}}", "each other: a -> a"),
        ("roles: {a: {mode: tracking, capabilities: [wings]}}", "capability wings"),
        ("roles: {a: {mode: tracking, capabilities: [wings]}}", "roles.a, capability 1"),
        (ROLE + "fixed: {red: {role: a, mode: manual}}", "fixed.red: … role … mode. … one of them."),
        (
            ROLE + "rules: [{when: true, then: {who: red, mode: manual}}]",
            "rule 1, when: true … quotes or fields, `name: value`.",
        ),
        (ROLE + "rules: [{when: light.left, then: []}]", "rule 1, then: has no effect. … who"),
        (
            ROLE + "phases: {p: {}}\nrules: [{when: light.left, then: {phase: p}, during: []}]",
            "rule 1, during: has 0 items. … at least 1",
        ),
        ("roles: {other_cars: {mode: tracking}}", "other_cars … word of rules"),
        ("roles: {a: {mode: tracking, cars: [all_cars]}}", "all_cars … word of rules"),
        (
            ROLE + "rules: [{when: light.left, then: {who: all, mode: manual}}]",
            "all … word of rules",
        ),
        (
            ROLE + "rules: [{when: {car: this_car, is: light.left}, then: {who: red, mode: manual}}]",
            "this_car … word of rules",
        ),
        ("fixed: {a: {role: b}}\n" + ROLE, "in `fixed` "),
        (
            ROLE + "rules: [{when: {any_car: light.left, all_cars: light.left}, then: {phase: x}}]",
            "needs one of any_car, all_cars, car",
        ),
        (ROLE + "rules: [{when: {car: red}, then: {who: red, role: a}}]", "car needs `is`"),
        (ROLE + "rules: [{when: {any_car: light.left}, then: {who: red}}]", "needs who … role, mode, led"),
        (
            ROLE + "rules: [{when: {any_car: light.left}, then: {who: red, role: c}}]",
            "rule 1, then.role: … role c. … a, b.",
        ),
        (
            ROLE + "rules: [{when: {all_cars: light.left}, then: {who: this_car, role: a}}]",
            "with `all_cars` ",
        ),
        (ROLE + "rules: [{when: {any_car: light.left}, then: {phase: x}}]", "phase x. "),
        (ROLE + "phases: {x: {until: {any_car: light.left}}}", "phases.x.until: it needs next"),
        (ROLE + "phases: {x: {timeout_s: 3}}", "phases.x.timeout_s: it needs on_timeout, or next"),
        ("cars: !!python/name:os.system {}", "the tag"),
        (
            "a: &a [x]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\n"
            + "".join(
                f"{name}: &{name} [{','.join(['*' + before] * 9)}]\n"
                for before, name in zip("bcdefgh", "cdefghi", strict=True)
            ),
            "more than 20000 values",
        ),
    ],
)
def test_each_mistake_has_place_and_reason(text: str, message: str) -> None:
    with pytest.raises(BadFile) as raised:
        parse(text, "p")
    assert has_parts(str(raised.value), message)


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(BadFile) as raised:
        parse(
            "roles:\n  a: {mode: tracking, needs: volts > 7}\n  b: {mode: manual, if_none: c}\n"
            "fixed: {red: {role: fast}}\n",
            "p",
        )
    assert [line.split(":")[1] for line in str(raised.value).splitlines()] == ["2", "3", "4"]


EVERYTHING_WRONG = """\
roles:
  Big Role: {mode: tracking, needs: volts > 7}
  a: {mode: dancing, needs: battery > 7.0, count: two}
  b: {if_none: zed}
  c: 5
fixed: {red: {role: fast}, Blue: {mode: manual}}
rules:
  - 7
  - {when: {any_car: light.left}, then: {who: this_car, role: c}}
  - {when: {any_car: light.leftt}, then: {who: this_car, role: nobody}}
  - {when: {car: red}, then: {whoo: that, role: a}}
  - {then: {who: this_car, mode: flying}}
  - {when: {any_car: light.left}, then: [{who: this_car, mode: 3}, {who: X Y, phase: q}]}
phases:
  x: {until: {any_car: light.left}, nxt: y}
  y: {timeout_s: soon, next: z}
"""


def test_forbidden_field_hides_no_other_fault() -> None:
    """Faults in names, types, references and conditions are reported at once, without follow-up errors."""
    with pytest.raises(BadFile) as raised:
        parse(EVERYTHING_WRONG, "p")
    assert [(each.line, each.field) for each in raised.value.problems] == [
        (2, "roles.'Big Role'"),
        (2, "roles.'Big Role'.needs"),
        (3, "roles.a.mode"),
        (3, "roles.a.needs"),
        (3, "roles.a.count"),
        (4, "roles.b.mode"),
        (4, "roles.b.if_none"),
        (5, "roles.c"),
        (6, "fixed.red.role"),
        (6, "fixed.Blue"),
        (8, "rule 1"),
        (10, "rule 3, when.any_car"),
        (10, "rule 3, then.role"),
        (11, "rule 4, when"),
        (11, "rule 4, then.whoo"),
        (12, "rule 5, when"),
        (12, "rule 5, then.mode"),
        (13, "rule 6, effect 1, mode"),
        (13, "rule 6, effect 2"),
        (13, "rule 6, effect 2, who"),
        (13, "rule 6, effect 2, phase"),
        (15, "phases.x.nxt"),
        (16, "phases.y.timeout_s"),
        (16, "phases.y.next"),
    ]


@pytest.mark.parametrize("text", ["7", "[]", "roles: 7", "roles: [a]\nrules: 3", "cars: {red: !!set {}}", "rules: {}"])
def test_plan_with_little_sound_content_has_a_fault(text: str) -> None:
    with pytest.raises(BadFile):
        parse(text, "p")

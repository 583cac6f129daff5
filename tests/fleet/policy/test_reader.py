"""What a plan may say, and that every mistake in it is told at once, with line, column and what is allowed."""

from pathlib import Path

import pytest

from fleet.marked import BadFile
from fleet.policy.plan import Of
from fleet.policy.reader import parse
from gateway.protocol.values import Mode

DEPLOY = Path(__file__).parents[3] / "deploy"


@pytest.mark.parametrize("path", sorted(DEPLOY.glob("plan*.yaml")), ids=lambda path: path.name)
def test_the_plans_in_deploy_are_some(path: Path) -> None:
    plan = parse(path.read_text(encoding="utf-8"))
    assert plan.rules


def test_a_mode_for_a_car_is_a_role_of_its_own() -> None:
    plan = parse("cars: {red: tracking, blue: tracking, green: patrol}\nroles: {patrol: {mode: following}}")
    assert plan.roles["tracking"].cars == ("red", "blue")
    assert plan.roles["tracking"].count == 2
    assert plan.roles["patrol"].mode is Mode.FOLLOWING
    assert plan.may("green", plan.roles["patrol"])
    assert not plan.may("red", plan.roles["patrol"])
    assert plan.version == parse(plan.text).version != parse(plan.text + "#").version


def test_words_that_yaml_1_1_takes_for_something_else_are_words() -> None:
    plan = parse("cars: {on: manual, no: tracking, 'off': manual, y: manual}")
    assert list(plan.fixed) == ["on", "no", "off", "y"]


def test_a_condition_is_told_as_it_was_meant() -> None:
    plan = parse(
        "cars: {red: tracking}\nrules: [{when: {all: not (light.left), for_s: 2}, then: {who: all, mode: manual}}]"
    )
    (rule,) = plan.rules
    assert rule.when.of is Of.ALL
    assert rule.when.text == "all car: not light.left for 2 s"


ROLE = "roles: {a: {mode: tracking}, b: {mode: manual}}\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "p:1:1: is empty"),
        ("{}", "p:1:1: a plan has `cars:` or `roles:`"),
        ("cars: {red: fast}", "p:1:13: cars.red: there is no role or mode fast: there are manual, "),
        ("cars: {red: manual, red: tracking}", "p:1:21: cars.red: is given twice"),
        ("cars: {Red: manual}", "p:1:8: cars.Red"),
        (
            "rolls: {}",
            "there is no such field here: allowed are cars, idle, phases, roles, rules; did you mean 'roles'?",
        ),
        (
            "roles: {a: {mode: tracking, count: 0}}",
            "p:1:36: roles.a.count: 0 is not allowed: a whole number, at least 1",
        ),
        ("roles: {a: {mode: tracking, needs: volts > 7}}", "column 1: there is no volts"),
        ("roles: {a: {mode: tracking, platforms: [raspberry_pi]}}", "raspberry_pi cars do not know mode tracking"),
        ("roles: {a: {mode: tracking, fallback: b}}", "roles.a.fallback: there is no role b: there are a"),
        ("roles: {a: {mode: tracking, fallback: a}}", "roles that stand in for each other: a -> a"),
        ("roles: {a: {mode: tracking, capabilities: [wings]}}", "there is no capability wings"),
        ("roles: {others: {mode: tracking}}", "others is a word of rules"),
        ("cars: {a: b}\n" + ROLE, "a car has this name"),
        (
            ROLE + "rules: [{when: {any: light.left, all: light.left}, then: {phase: x}}]",
            "exactly one of any, all, car",
        ),
        (ROLE + "rules: [{when: {car: red}, then: {who: red, role: a}}]", "car needs `is`"),
        (ROLE + "rules: [{when: {any: light.left}, then: {who: red}}]", "who with one of role and mode, or led"),
        (ROLE + "rules: [{when: {any: light.left}, then: {who: red, role: c}}]", "there is no role c: there are a, b"),
        (ROLE + "rules: [{when: {all: light.left}, then: {who: that, role: a}}]", "with `all` there is no car"),
        (ROLE + "rules: [{when: {any: light.left}, then: {phase: x}}]", "there is no phase x: there is none"),
        (
            ROLE + "phases: {x: {next: y}, y: {next: x}}",
            "p:2:13: phases.x: a cycle of phases without a condition or a time-out: x -> y -> x",
        ),
        (ROLE + "phases: {x: {next: y}, y: {}}", "phases.x.next: nothing ends x: give it until, or timeout_s"),
        (ROLE + "phases: {x: {until: {any: light.left}}}", "phases.x.until: it needs next"),
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
def test_a_mistake_is_named(text: str, told: str) -> None:
    with pytest.raises(BadFile) as raised:
        parse(text, "p")
    assert told in str(raised.value)


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(BadFile) as raised:
        parse(
            "roles:\n  a: {mode: tracking, needs: volts > 7}\n  b: {mode: manual, fallback: c}\ncars: {red: fast}\n",
            "p",
        )
    assert [line.split(":")[1] for line in str(raised.value).splitlines()] == ["2", "3", "4"]

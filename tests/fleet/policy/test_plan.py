"""What a plan may say, and that every mistake names the file, the place, the value and what is allowed."""

from pathlib import Path

import pytest

from fleet.policy.plan import BadPlan, Comparison, Condition, parse
from gateway.protocol.values import Mode

GOOD = """
cars:
  red: tracking
  blue: manual
rules:
  - when: {car: red, reading: sensor/range, field: range_m, below: 0.3, for_s: 2}
    then: {car: blue, mode: obstacle_avoidance}
"""


def test_a_plan() -> None:
    plan = parse(GOOD)
    assert dict(plan.cars) == {"red": Mode.TRACKING, "blue": Mode.MANUAL}
    (rule,) = plan.rules
    assert (rule.car, rule.mode) == ("blue", Mode.OBSTACLE_AVOIDANCE)
    assert rule.when == Condition("red", "sensor/range", "range_m", Comparison.BELOW, 0.3, 2.0)
    assert plan.version == parse(GOOD).version != parse(GOOD + "#").version


def test_the_plan_in_deploy_is_one() -> None:
    path = Path(__file__).parents[3] / "deploy" / "plan.yaml"
    assert parse(path.read_text(encoding="utf-8")).rules


def test_words_that_yaml_1_1_takes_for_something_else_are_words() -> None:
    plan = parse("cars: {on: manual, no: tracking, 'off': manual, y: manual, 1e: manual, 0x1f: manual, 1_0: manual}")
    assert list(plan.cars) == ["on", "no", "off", "y", "1e", "0x1f", "1_0"]


def _rule(when: str, then: str = "{car: red, mode: manual}") -> str:
    return f"cars: {{red: tracking}}\nrules:\n  - when: {when}\n    then: {then}\n"


RANGE = "car: red, reading: sensor/range, field: range_m"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "p.yaml: nothing is not allowed: a mapping with cars"),
        ("[]", "p.yaml: [] is not allowed: a mapping with cars"),
        ("cars: {}", "p.yaml: cars: {} is not allowed: at least one car"),
        ("cars: red", "p.yaml: cars: 'red' is not allowed: a mapping of cars to modes"),
        ("rules: []", "p.yaml: cars: it is missing here"),
        ("cars: {red: manual}\nrule: []", "p.yaml: rule: there is no such entry here: cars, rules"),
        ("cars: {red: fast}", "p.yaml: cars.red: 'fast' is not allowed: one of manual, "),
        ("cars: {red: 2}", "p.yaml: cars.red: 2 is not allowed: one of manual, "),
        ("cars: {red: [manual]}", "p.yaml: cars.red: ['manual'] is not allowed: one of manual, "),
        ("cars: {Red: manual}", "p.yaml: cars.Red: 'Red' is not allowed: a car's name is 1 to 32"),
        ("cars: {7: manual}", "p.yaml: cars.7: 7 is not allowed: a car's name in quotes"),
        ("cars: {true: manual}", "p.yaml: cars.True: true is not allowed: a car's name in quotes"),
        ("cars:\n  red: manual\n  red: tracking", "p.yaml: line 3, column 3: 'red' is given twice"),
        ("cars: {red: manual", "p.yaml: line 1, column 19: expected ',' or '}'"),
        ("cars: !!python/name:os.system {}", "p.yaml: line 1, column 7: could not determine a constructor"),
        ("cars: \x00", "p.yaml: "),
        ("cars: {? [a] : manual}", "p.yaml: line 1, column 10: a key that is no word"),
        ("cars: {red: manual}\nrules: {}", "p.yaml: rules: {} is not allowed: a list"),
        ("cars: {red: manual}\nrules: [3]", "p.yaml: rules[0]: 3 is not allowed: a mapping with when, then"),
        (_rule(f"{{{RANGE}}}"), "exactly one of below, above, equals"),
        (_rule(f"{{{RANGE}, below: 1, above: 2}}"), "exactly one of below, above, equals"),
        (_rule(f"{{{RANGE}, below: near}}"), "p.yaml: rules[0].when.below: 'near' is not allowed: a number"),
        (_rule(f"{{{RANGE}, below: 1:30}}"), "p.yaml: rules[0].when.below: '1:30' is not allowed: a number"),
        (_rule(f"{{{RANGE}, below: true}}"), "p.yaml: rules[0].when.below: true is not allowed: a number"),
        (_rule(f"{{{RANGE}, below: .inf}}"), "p.yaml: rules[0].when.below: '.inf' is not allowed: a number"),
        (_rule(f"{{{RANGE}, below: 1, for_s: -1}}"), "p.yaml: rules[0].when.for_s: -1 is not allowed: a number, 0 or"),
        (
            _rule("{car: red, reading: sensor/sonar, field: range_m, below: 1}"),
            "p.yaml: rules[0].when.reading: 'sensor/sonar' is not allowed: one of sensor/range, ",
        ),
        (
            _rule("{car: red, reading: sensor/range, field: range, below: 1}"),
            "p.yaml: rules[0].when.field: 'range' is not allowed: one of range_m, no_echo",
        ),
        (
            _rule("{car: red, reading: sensor/range, field: no_echo, above: 1}"),
            "p.yaml: rules[0].when.above: 1 is not allowed: no_echo is no number: only equals",
        ),
        (
            _rule("{car: red, reading: sensor/range, field: no_echo, equals: yes}"),
            "p.yaml: rules[0].when.equals: 'yes' is not allowed: true or false",
        ),
        (
            _rule("{car: red, reading: sensor/battery, field: level, equals: 3}"),
            "p.yaml: rules[0].when.equals: 3 is not allowed: a word",
        ),
        (
            _rule(f"{{{RANGE}, below: 1}}", "{car: blue, mode: manual}"),
            "p.yaml: rules[0].then.car: 'blue' is not allowed: one of red",
        ),
        (_rule(f"{{{RANGE}, below: 1}}", "{car: red}"), "p.yaml: rules[0].then.mode: it is missing here"),
    ],
)
def test_a_mistake_is_named(text: str, told: str) -> None:
    with pytest.raises(BadPlan) as raised:
        parse(text, "p.yaml")
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text",
    [
        "cars: {red: !!bool zz}",
        "cars: {red: !!int zz}",
        "cars: {red: !!float zz}",
        "cars: {red: !!timestamp zz}",
        f"cars: {'[' * 5000}",
        f"cars: {'{a: ' * 3000}",
        "cars: {red: " + "9" * 5000 + "}",
        _rule(f"{{{RANGE}, below: {'9' * 400}}}"),
    ],
)
def test_what_no_plan_needs_is_refused_and_the_file_named(text: str) -> None:
    with pytest.raises(BadPlan, match=r"^a\.yaml") as caught:
        parse(text, "a.yaml")
    assert len(str(caught.value).splitlines()) == 1

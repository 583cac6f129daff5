"""Any text as a plan is put in force or rejected with the declared error. No other exception occurs."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.conditions.condition_parser import MAX_CONDITION_LENGTH, MAX_PARENTHESES
from fleet.policy.decide import step
from fleet.policy.lint.lint import find_faults
from fleet.policy.plan.plan import Plan
from fleet.policy.plan.plan_parser import parse
from fleet.policy.snapshot import NAMES, CarSnapshot, FleetSnapshot
from fleet.policy.state import PolicyState
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.words import Mode
from schemas.yaml_document.document import BadFile
from tests.fleet.policy.cars import HERE, seen

FLEET = {
    car: CarSnapshot(platform=platform, capabilities=frozenset(map(str, parse_platform(platform).modes)), listed=True)
    for car, platform in (("red", "arduino"), ("pi", "raspberry_pi"))
}
LOW = "battery.voltage_v < 7"
PLACES = (
    "roles: {{scout: {{mode: tracking, needs: {0}}}}}",
    "roles: {{scout: {{mode: tracking}}}}\nrules: [{{when: {{any_car: {0}}}, then: {{who: this_car, mode: manual}}}}]",
    "roles: {{scout: {{mode: tracking}}}}\nphases: {{a: {{until: {{all_cars: {0}}}, next: b}}, b: {{}}}}",
)
"""Plans with room for a condition: of a role, a rule, a phase."""


def put_in_force(text: str) -> Plan | None:
    """Parse and check a text as a coordinator does. Return the plan, None if it was rejected."""
    try:
        plan = parse(text)
    except BadFile:
        return None
    for cars in (None, FLEET):
        str(find_faults(plan, cars, ["red"]).refusal())
    picture = FleetSnapshot({"red": HERE, "pi": HERE}, {"red": seen(0.0, battery={"voltage_v": 6.0})})
    memory = PolicyState()
    for now in (0.0, 2.0, 90_000.0):
        memory = step(plan, picture, memory, now).memory
    return plan


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("length", [949, 950, 975, MAX_CONDITION_LENGTH - 1, MAX_CONDITION_LENGTH])
def test_condition_of_maximum_length_is_accepted(place: str, length: int) -> None:
    filler = " or mode.asked == 'manual'"
    count = (length - len(LOW)) // len(filler)
    condition = LOW + " " * (length - len(LOW) - count * len(filler)) + filler * count
    assert len(condition) == length
    assert put_in_force(place.format(json.dumps(condition))) is not None
    assert (
        put_in_force(place.format(json.dumps(f"{condition}   "[: MAX_CONDITION_LENGTH + 1]))) is None
        or length < MAX_CONDITION_LENGTH
    )


@pytest.mark.parametrize("place", PLACES)
def test_condition_of_maximum_depth_is_accepted(place: str) -> None:
    for depth, allowed in (
        (MAX_PARENTHESES - 1, True),
        (MAX_PARENTHESES, True),
        (MAX_PARENTHESES + 1, False),
    ):
        for begin, end in (("(", ")"), ("not (", ")"), ("(link.state != 'lost' and ", ")")):
            condition = begin * depth + LOW + end * depth
            assert (put_in_force(place.format(json.dumps(condition))) is not None) is allowed, (depth, begin)


NUMBERS = st.one_of(
    st.floats().map(repr),
    st.integers().map(str),
    st.integers(1, 400).map(lambda digits: "9" * digits),
    st.sampled_from(["1e308", "1e309", "-1e-400", "0x10", "1_000", "007", ".5", "5.", "+3", "1e", "0" * 900]),
)
WORDS = st.one_of(
    st.sampled_from(["and", "or", "not", "(", ")", "true", "false", "'", '"', "''", *"=!<>&|-"]),
    st.sampled_from(["<", "<=", ">", ">=", "==", "!="]),
    st.sampled_from(sorted(NAMES)),
    st.text(max_size=6),
    st.text(max_size=6).map(lambda text: f"'{text}'"),
    NUMBERS,
)
COMPARISONS = st.one_of(
    st.tuples(
        st.sampled_from(sorted(name for name, kind in NAMES.items() if kind is float)),
        st.sampled_from(["<", "<=", ">", ">=", "==", "!="]),
        NUMBERS,
    ).map(" ".join),
    st.tuples(
        st.sampled_from(sorted(name for name, kind in NAMES.items() if kind is str)),
        st.sampled_from([" == ", " != "]),
        st.text(max_size=8).map(lambda text: f"'{text}'"),
    ).map("".join),
    st.sampled_from(sorted(name for name, kind in NAMES.items() if kind is bool)),
    st.sampled_from(["true", "false"]),
)
SENSIBLE = st.recursive(
    COMPARISONS,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from([" and ", " or ", ") == (", ") != ("]), inner).map(
            lambda x: f"({''.join(x)})"
        ),
        inner.map(lambda text: f"not ({text})"),
        st.tuples(inner, st.sampled_from([" and ", " or "]), st.integers(2, 40)).map(
            lambda x: x[1].join([x[0]] * x[2])[:MAX_CONDITION_LENGTH]
        ),
    ),
    max_leaves=12,
)
CONDITIONS = st.one_of(st.lists(WORDS, max_size=20).map(" ".join), SENSIBLE, st.text())
"""Valid, nearly valid and invalid conditions."""
FIELDS = (
    *(
        "roles",
        "cars",
        "fixed",
        "rules",
        "phases",
        "without_role",
        "mode",
        "needs",
        "count",
        "priority",
        "capabilities",
        "platforms",
    ),
    *(
        "if_none",
        "given_by",
        "name",
        "when",
        "then",
        "until",
        "during",
        "who",
        "role",
        "led",
        "phase",
        "any_car",
        "all_cars",
    ),
    *(
        "car",
        "all_cars",
        "with_role",
        "blink_s",
        "color",
        "is",
        "for_s",
        "timeout_s",
        "next",
        "on_timeout",
        "a",
        "b",
        "red",
        "x",
    ),
)
VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        CONDITIONS,
        st.sampled_from([*Mode, "red", "pi", "scout", "this_car", "other_cars", "all_cars", "all", "a", "b"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(FIELDS), inner, max_size=4)),
    max_leaves=10,
)
WHOLE = st.fixed_dictionaries(
    {"roles": st.one_of(st.just({"scout": {"mode": "tracking"}}), VALUES)},
    optional={
        "cars": st.one_of(st.just({"red": "scout", "pi": "manual"}), VALUES),
        "rules": VALUES,
        "phases": VALUES,
        "idle": VALUES,
    },
).map(json.dumps)
SIGNS = (
    *("\n- ", "\nroles: ", "cars: ", "rules: ", "phases: ", "when: ", "then: ", "who: ", "mode: ", "scout: ", "red"),
    *(
        "{",
        "}",
        "[",
        "]",
        ", ",
        "? ",
        "! ",
        "--- ",
        "...\n",
        "# ",
        "'",
        '"',
        ">\n ",
        "|\n ",
        "=",
        "<<: *a",
        "&a ",
        "*a ",
    ),
    *("!!int ", "!!python/object:os.system ", "!!binary ", "%YAML 1.1\n", "%YAML 99999999999\n", "%TAG ! x\n"),
    *("\x00", "\ud800", "\\ud800", "\t", "\ufeff", "\u2028", "\x85", "~", "null", ".inf", ".nan", "0o17", "2001-01-01"),
)
ODDITIES = st.lists(st.one_of(st.sampled_from(SIGNS), st.text(max_size=4)), max_size=24).map("".join)


@settings(max_examples=300)
@given(
    st.one_of(
        st.tuples(st.sampled_from(PLACES), CONDITIONS).map(lambda pair: pair[0].format(json.dumps(pair[1]))),
        WHOLE,
        ODDITIES,
        st.tuples(st.sampled_from(PLACES), ODDITIES).map(lambda pair: pair[0].format(pair[1])),
        st.text(),
    )
)
def test_any_plan_text_is_accepted_or_raises_declared_error(text: str) -> None:
    put_in_force(text)

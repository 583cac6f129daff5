"""Conditions: their meaning, the messages about invalid ones, and the ones that can never be true."""

import contextlib
import math
import operator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.conditions import BadExpression, fields_of, is_contradictory, parse, value_in
from fleet.conditions.condition_parser import MAX_CONDITION_LENGTH, MAX_PARENTHESES
from fleet.conditions.expression import (
    And,
    Compare,
    Expression,
    Literal,
    Name,
    Node,
    Not,
    Op,
    Or,
    ValueKind,
    join_nodes,
)
from schemas import messages, topics
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.text_parts import has_parts

NAMES = {"range_m": float, "voltage_v": float, "level": str, "verdict": str, "light.left": bool, "no_echo": bool}
READING = {"range_m": 0.25, "voltage_v": 7.4, "level": "low", "light.left": True, "no_echo": False}  # verdict: unknown


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("range_m < 0.3", True),
        ("0.3 > range_m", True),
        ("range_m<.25", False),
        ("range_m <= 2.5e-1 and range_m>=0.25", True),
        ("range_m > -1", True),
        ("range_m != 0", True),
        ("range_m < voltage_v", True),
        ("level == 'low'", True),
        ('level != "low"', False),
        ("light.left", True),
        ("not light.left", False),
        ("not not light.left", True),
        ("light.left == true and no_echo == false", True),
        ("light.left == no_echo", False),
        ("(range_m < 1) == (voltage_v < 1)", False),
        ("no_echo and no_echo or light.left", True),  # and binds before or
        ("no_echo and (no_echo or light.left)", False),
        ("not no_echo and light.left", True),  # not binds before and
        ("not range_m > 0.3", True),  # a comparison binds before not
        ("true", True),
        ("verdict == 'confirmed'", None),
        ("not verdict == 'confirmed'", None),
        ("verdict == 'confirmed' or light.left", True),
        ("verdict == 'confirmed' and light.left", None),
        ("verdict == 'confirmed' and no_echo", False),
        ("verdict == 'confirmed' or no_echo", None),
        ("(verdict == 'x') == light.left", None),
    ],
)
def test_condition_value_for_reading(text: str, held: bool | None) -> None:
    assert parse(text, NAMES).value(READING.get) is held


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("", 1, "missing here: … range_m, voltage_v, level"),
        ("range_m <", 10, "missing here: … range_m"),
        ("range_m < and no_echo", 11, "missing here, before and"),
        ("< 0.3", 1, "missing here, before <"),
        ("()", 2, "missing here, before )"),
        ("range < 0.3", 1, "range … value. … mean range_m?"),
        ("level == low", 10, "low … value. … quotes: 'low'"),
        ("levl == 'low'", 1, "levl … value. … mean level?"),
        ("light.left == True", 15, " mean true?"),
        ("range_m", 1, "range_m … number, … condition: … range_m < 0.3"),
        ("no_echo or level", 12, "level … word, … condition: … level == 'low'"),
        ("not range_m", 5, "range_m … number, … condition"),
        ("not (range_m)", 5, "range_m … number, … condition"),
        ("light.left < 1", 1, "light.left is yes or no: < … numbers, … == or !=, … alone"),
        ("range_m >= 'far'", 12, "'far' … word: >= … numbers, … == or !="),
        ("level == 3", 7, "level … word, 3 … number: … never"),
        ("light.left != 'on'", 12, "light.left … yes or no, 'on' … word: … never"),
        ("0.1 < range_m < 0.3", 15, "chain: write 0.1 < x and x < 0.3"),
        ("range_m = 0.3", 9, "= … write =="),
        ("range_m =< 0.3", 9, "=< … write <="),
        ("no_echo && light.left", 9, "& … write and"),
        ("no_echo | light.left", 9, "| … write or"),
        ("!no_echo", 1, "! … write not"),
        ("range_m < 30cm", 11, "30cm … number. … without a unit"),
        ("range_m < 0.3.1", 11, "0.3.1 … number"),
        ("range_m < 0,3", 12, "',' … names, numbers"),
        ("range_m < 1e999", 11, "1e999 … number"),
        ("range_m < \u0663", 11, "is not known"),
        ("level == 'low", 10, "with ' has no end"),
        ("(no_echo", 9, "the ( of column 1 is not closed"),
        ("no_echo)", 8, "this ) has no ( before it"),
        ("no_echo light.left", 9, "light.left … with and, or"),
        (
            "(" * (MAX_PARENTHESES + 1) + "no_echo" + ")" * (MAX_PARENTHESES + 1),
            MAX_PARENTHESES + 1,
            "parentheses … 32",
        ),
        (
            "no_echo" + " " * MAX_CONDITION_LENGTH,
            MAX_CONDITION_LENGTH + 1,
            "too long: 1007 … 1000",
        ),
    ],
)
def test_invalid_condition_error_has_column(text: str, column: int, words: str) -> None:
    with pytest.raises(BadExpression) as bad:
        parse(text, NAMES)
    assert bad.value.column == column
    assert has_parts(bad.value.words, words)
    assert f"column {column}: " in str(bad.value)
    assert "\n" not in str(bad.value)


@pytest.mark.parametrize(
    ("text", "normal"),
    [
        ("((range_m)<.3)", "range_m < 0.3"),
        ("not((light.left))", "not light.left"),
        ("not not not no_echo", "not no_echo"),
        ("not (no_echo or light.left)", "not (no_echo or light.left)"),
        ("no_echo and (no_echo and light.left)", "no_echo and no_echo and light.left"),
        ("no_echo and (no_echo or light.left)", "no_echo and (no_echo or light.left)"),
        ("(no_echo and light.left) or no_echo", "no_echo and light.left or no_echo"),
        ('level == "it\'s"', 'level == "it\'s"'),
        ('level == "low"', "level == 'low'"),
        ("range_m < 12", "range_m < 12"),
        ("range_m < +1e-7", "range_m < 1e-07"),
    ],
)
def test_condition_has_one_way_to_be_written(text: str, normal: str) -> None:
    assert str(parse(text, NAMES)) == normal


def test_names_are_those_it_uses_in_order() -> None:
    assert parse("voltage_v > 7 and (range_m < 1 or voltage_v > range_m)", NAMES).names == ("voltage_v", "range_m")


def test_unmeasured_number_is_unknown_and_wrong_type_raises() -> None:
    assert parse("range_m != 1", NAMES).value({"range_m": math.nan}.get) is None
    with pytest.raises(TypeError, match=r"range_m .* 'far'"):
        parse("range_m < 1", NAMES).value({"range_m": "far"}.get)
    with pytest.raises(TypeError, match=r"light\.left .* 1"):
        parse("light.left", NAMES).value({"light.left": 1}.get)


@pytest.mark.parametrize(
    ("text", "never"),
    [
        ("range_m < 0.1 and range_m > 0.2", True),
        ("range_m < 0.1 and 0.2 < range_m", True),
        ("range_m < 0.2 and range_m > 0.1", False),
        ("range_m <= 0.1 and range_m >= 0.1", False),
        ("range_m < 0.1 and range_m >= 0.1", True),
        ("range_m <= 0.1 and range_m >= 0.1 and range_m != 0.1", True),
        ("range_m == 1 and range_m == 2", True),
        ("range_m == 1 and range_m > 1", True),
        ("not (range_m >= 0.1 or range_m <= 0.2)", True),
        ("not (range_m < 0.1) and not range_m >= 0.1", True),
        ("not (range_m < 0.1) and range_m == 0.1", False),
        ("level == 'low' and level == 'ok'", True),
        ("level == 'low' and level != 'low'", True),
        ("level != 'low' and level != 'ok'", False),
        ("no_echo and not no_echo", True),
        ("no_echo and (not no_echo or light.left)", False),
        ("no_echo != true and no_echo != false", True),
        ("no_echo == light.left and no_echo != light.left", True),
        ("range_m < voltage_v and voltage_v < range_m", True),
        ("range_m < voltage_v and voltage_v != range_m", False),
        ("range_m < range_m", True),
        ("(range_m < 1) == (range_m >= 1)", True),
        ("(range_m < 1) != (range_m >= 1)", False),
        ("1 > 2", True),
        ("'a' == 'b'", True),
        ("'a' != 'b'", False),
        ("false", True),
        (" and ".join(["(range_m < 1 or range_m > 2)"] * 12 + ["false"]), False),  # more alternatives than the limit
    ],
)
def test_contradictory_conditions_are_found(text: str, never: bool) -> None:
    assert is_contradictory(parse(text, NAMES)) is never


def test_two_conditions_make_one() -> None:
    both = parse("no_echo or light.left", NAMES) & parse("range_m < 1", NAMES)
    assert str(both) == "(no_echo or light.left) and range_m < 1"
    assert is_contradictory(parse("range_m < 1", NAMES) & parse("range_m > 1", NAMES))


# ---------------------------------------------------------------------- against a reference

_numbers = st.one_of(st.integers(-5, 5), st.floats(-3, 3), st.sampled_from([0.25, 1e22, -1e-9, 2**64]))
_words = st.text(st.characters(codec="utf-8", exclude_characters="\n\"'"), max_size=4) | st.just("it's")
_atoms = st.one_of(
    st.sampled_from(["light.left", "no_echo"]).map(lambda name: Name(name, ValueKind.TRUTH)),
    st.booleans().map(Literal),
    st.builds(
        Compare,
        st.sampled_from(["range_m", "voltage_v"]).map(lambda name: Name(name, ValueKind.NUMBER))
        | _numbers.map(Literal),
        st.sampled_from(list(Op)),
        st.sampled_from(["range_m", "voltage_v"]).map(lambda name: Name(name, ValueKind.NUMBER))
        | _numbers.map(Literal),
    ),
    st.builds(
        Compare,
        st.sampled_from(["level", "verdict"]).map(lambda name: Name(name, ValueKind.WORD)),
        st.sampled_from([Op.EQ, Op.NE]),
        _words.map(Literal),
    ),
)


def _larger(inner: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    parts = st.lists(inner, min_size=2, max_size=3)
    return st.one_of(
        parts.map(lambda several: join_nodes(And, several)),
        parts.map(lambda several: join_nodes(Or, several)),
        inner.map(lambda one: one.inner if isinstance(one, Not) else Not(one)),
        st.builds(Compare, inner, st.sampled_from([Op.EQ, Op.NE]), inner),
    )


_trees = (
    st.recursive(_atoms, _larger, max_leaves=8)
    .map(Expression)
    .filter(lambda made: len(str(made)) <= MAX_CONDITION_LENGTH)
)
_values = st.fixed_dictionaries(
    {},
    optional={
        "range_m": _numbers,
        "voltage_v": _numbers,
        "level": _words,
        "verdict": _words,
        "light.left": st.booleans(),
        "no_echo": st.booleans(),
    },
)
_OPS: dict[str, Any] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


def _reference(node: Node, values: dict[str, Any]) -> Any:
    """Return the value by Kleene's tables, written as minimum, maximum and complement of 0, 1/2, 1."""
    if isinstance(node, Literal):
        return float(node.value) if isinstance(node.value, bool) else node.value
    if isinstance(node, Name):
        found = values.get(node.name, 0.5 if node.kind is ValueKind.TRUTH else None)
        return float(found) if isinstance(found, bool) else found
    if isinstance(node, Compare):
        truth = not isinstance(node.left, Name | Literal) or node.left.kind is ValueKind.TRUTH
        one, other = _reference(node.left, values), _reference(node.right, values)
        unknown = 0.5 in (one, other) if truth else None in (one, other)
        return 0.5 if unknown else float(_OPS[node.op](one, other))
    if isinstance(node, Not):
        return 1 - _reference(node.inner, values)
    return (min if isinstance(node, And) else max)(_reference(part, values) for part in node.parts)


@given(_trees)
def test_condition_text_round_trip(tree: Expression) -> None:
    read = parse(str(tree), NAMES)
    assert str(read) == str(tree)
    assert read == tree


@given(_trees, _values)
def test_condition_value_equals_reference_evaluation(tree: Expression, values: dict[str, Any]) -> None:
    held = tree.value(values.get)
    assert {True: 1, None: 0.5, False: 0}[held] == _reference(tree.root, values)


@given(_trees, _values)
def test_satisfied_condition_is_not_contradictory(tree: Expression, values: dict[str, Any]) -> None:
    if tree.value(values.get):
        assert not is_contradictory(tree)


@given(st.text(max_size=40) | st.text("range_m<>=!()'\" andortu0.3-", max_size=40))
def test_any_text_is_a_condition_or_a_bad_one(text: str) -> None:
    with contextlib.suppress(BadExpression):
        read = parse(text, NAMES)
        assert parse(str(read), NAMES) == read


# ---------------------------------------------------------------------- the fields of messages


def test_every_message_has_fields_with_values() -> None:
    for topic in topics.TOPICS.values():
        message = messages.message_class(topic.message)()
        for name, kind in fields_of(type(message)).items():
            value = value_in(message)(name)
            assert value is None or isinstance(value, {float: int | float}.get(kind, kind)), f"{topic.name} {name}"  # type: ignore[arg-type]


def test_condition_of_unmeasured_field_is_unknown() -> None:
    close = parse("range_m < 0.3", fields_of(pb.Range))
    assert close.value(value_in(pb.Range(range_m=0.2))) is True
    assert close.value(value_in(pb.Range(no_echo=True))) is None
    safety = pb.Safety(motors="off")
    safety.hold.by = "ann"
    names = fields_of(pb.Safety)
    assert parse("hold and hold.by == 'ann' and not estops", names).value(value_in(safety)) is True
    assert parse("lease.holder == 'ann'", names).value(value_in(safety)) is None
    assert parse("lease", names).value(value_in(safety)) is False
    log = messages.message_class("foxglove.Log")(level=3)
    assert parse("level == 'WARNING'", fields_of(type(log))).value(value_in(log)) is True


def test_fields_exclude_times_and_bytes_and_end_with_common_ones() -> None:
    assert list(fields_of(pb.RxFrame)) == ["verdict", "published", "car", "seq", "boot_id"]

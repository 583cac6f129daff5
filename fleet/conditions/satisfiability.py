"""Finds conditions that can never be true. Pure. It does not find all of them, but what it finds is never true.

A condition is split into alternatives. Each is a set of comparisons that together make the condition true. An
alternative is impossible if no value of a field fulfils all its comparisons of this field (`a < 1 and a > 2`), or if no
two values fulfil all its comparisons of two fields with each other (`a < b and a > b`).
"""

from collections.abc import Iterable
from typing import Final, TypeAlias

from msgspec import Struct, field

from fleet.conditions.expression import And, Compare, Expression, Literal, Name, Node, Not, Op, Or, ValueKind, names_in
from fleet.conditions.functions import FUNCTIONS, split_call
from schemas import topics

_MAX_ALTERNATIVES: Final = 512
"""Maximum number of alternatives of a condition. A condition with more alternatives counts as possible."""

_DOMAINS: Final = {
    f"{topic.name.rpartition('/')[2]}.{name}": (topic.words.get(name, ()), topic.ranges.get(name))
    for topic in topics.TOPICS.values()
    for name in {*topic.words, *topic.ranges}
}
"""Allowed words and range by name. A name is the last word of the topic and the field, such as `range.range_m`."""
_Alternative: TypeAlias = tuple[Compare, ...]
_RELATIONS: Final = {Op.LT: "<", Op.LE: "<=", Op.GT: ">", Op.GE: ">=", Op.EQ: "=", Op.NE: "<>"}
"""The relations of two values that fulfil an operator. One character is one relation: `<=` means smaller or equal."""
_OPPOSITE: Final = {Op.LT: Op.GE, Op.GE: Op.LT, Op.GT: Op.LE, Op.LE: Op.GT, Op.EQ: Op.NE, Op.NE: Op.EQ}
_MIRRORED: Final = {Op.LT: Op.GT, Op.GT: Op.LT, Op.LE: Op.GE, Op.GE: Op.LE, Op.EQ: Op.EQ, Op.NE: Op.NE}


def is_contradictory(expression: Expression) -> bool:
    """Return True if the condition can never be true, such as `range_m < 0.1 and range_m > 0.2`."""
    try:
        return not any(_is_possible(alternative) for alternative in _alternatives_of(expression.root, wanted=True))
    except _TooManyAlternativesError:
        return False


def explain_impossible(expression: Expression, of: str = "") -> str:
    """Return why the words and ranges of schemas/topics.py exclude the condition. Empty if it can be true.

    `of` is the last word of the topic, if the names are the fields of one message.
    """
    if is_contradictory(expression):
        return f"{expression} is never true"
    for name in dict.fromkeys(names_in(expression.root)):
        function, _ = split_call(name.name)
        words, limits = _DOMAINS.get(f"{of}.{name.name}" if of else name.name, ((), None))
        if function:
            limits = FUNCTIONS[function].range
        if words:
            allowed: Node = Or(tuple(Compare(name, Op.EQ, Literal(word)) for word in words))
            domain = f"one of {', '.join(words)}"
        elif limits is not None:
            least, most = limits
            allowed = And((Compare(name, Op.GE, Literal(least)), Compare(name, Op.LE, Literal(most))))
            domain = f"{least:g} .. {most:g}"
        else:
            continue
        if is_contradictory(expression & Expression(allowed)):
            return f"{expression} is never true: {name} is {domain}"
    return ""


class _TooManyAlternativesError(Exception):
    """The condition has too many alternatives."""


def _alternatives_of(node: Node, *, wanted: bool) -> list[_Alternative]:
    """Return the alternatives that make a condition true, or false if not `wanted`."""
    match node:
        case Literal(value):
            return [()] if value is wanted else []
        case Name():
            return [(Compare(node, Op.EQ, Literal(wanted)),)]
        case Not(inner):
            return _alternatives_of(inner, wanted=not wanted)
        case And(parts):
            each = [_alternatives_of(part, wanted=wanted) for part in parts]
            return _all_of(each) if wanted else _one_of(each)
        case Or(parts):
            each = [_alternatives_of(part, wanted=wanted) for part in parts]
            return _one_of(each) if wanted else _all_of(each)
        case Compare(left, op, right):
            if _is_simple(left) and _is_simple(right):
                return [(node if wanted else Compare(left, _OPPOSITE[op], right),)]
            same = (op is Op.EQ) is wanted
            return _one_of(
                [
                    _all_of([_alternatives_of(left, wanted=one), _alternatives_of(right, wanted=one is same)])
                    for one in (True, False)
                ]
            )


def _is_simple(side: Node) -> bool:
    return isinstance(side, Name | Literal)


def _all_of(several: Iterable[list[_Alternative]]) -> list[_Alternative]:
    found: list[_Alternative] = [()]
    for alternatives in several:
        if len(found) * len(alternatives) > _MAX_ALTERNATIVES:
            raise _TooManyAlternativesError
        found = [one + other for one in found for other in alternatives]
    return found


def _one_of(several: Iterable[list[_Alternative]]) -> list[_Alternative]:
    found = [alternative for alternatives in several for alternative in alternatives]
    if len(found) > _MAX_ALTERNATIVES:
        raise _TooManyAlternativesError
    return found


class _Constraint(Struct):
    """The values of one field that a set of comparisons allows."""

    least: float = float("-inf")
    most: float = float("inf")
    is_: set[object] = field(default_factory=set)
    is_not: set[object] = field(default_factory=set)

    def add(self, op: Op, value: object) -> None:
        if isinstance(value, bool) and op is Op.NE:
            op, value = Op.EQ, not value
        if op is Op.EQ:
            self.is_.add(value)
        elif op is Op.NE:
            self.is_not.add(value)
        else:
            assert isinstance(value, int | float)
            if op in (Op.GT, Op.GE):
                self.least = max(self.least, value)
            else:
                self.most = min(self.most, value)
            if op in (Op.GT, Op.LT):
                self.is_not.add(value)

    def is_possible(self) -> bool:
        if self.least == self.most:
            self.is_.add(self.least)
        if self.least > self.most or len(self.is_) > 1:
            return False
        return all(
            value not in self.is_not and (not isinstance(value, int | float) or self.least <= value <= self.most)
            for value in self.is_
        )


def _is_possible(alternative: _Alternative) -> bool:
    """Return False if the comparisons of an alternative exclude each other."""
    constraints: dict[str, _Constraint] = {}
    between: dict[tuple[str, str], set[str]] = {}
    for atom in alternative:
        match atom:
            case Compare(Literal(value=one), op, Literal(value=other)):
                relation = "=" if one == other else "<" if _sort_key(one) < _sort_key(other) else ">"
                if relation not in _RELATIONS[op]:
                    return False
            case Compare(Name(name), op, Literal(value)):
                constraints.setdefault(name, _Constraint()).add(op, value)
            case Compare(Literal(value), op, Name(name)):
                constraints.setdefault(name, _Constraint()).add(_MIRRORED[op], value)
            case Compare(Name(name=one), op, Name(name=other, kind=kind)):
                op = op if one <= other else _MIRRORED[op]
                possible_relations = "=" if one == other else "<=>" if kind is ValueKind.NUMBER else "<="
                between.setdefault((min(one, other), max(one, other)), set(possible_relations)).intersection_update(
                    _RELATIONS[op]
                )
            case _:
                pass
    return all(between.values()) and all(each.is_possible() for each in constraints.values())


def _sort_key(value: object) -> float:
    """Return a sort key. Words and booleans are only tested for equality, so any order will do for them."""
    return value if isinstance(value, int | float) else 0.0

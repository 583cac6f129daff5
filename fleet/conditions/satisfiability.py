"""Whether a condition can be true at all. Sound, not complete: what it calls contradictory never holds. Pure.

Each way in which a condition can be true is a set of comparisons; a way is open unless what they ask of one field, or
of two fields against each other, cannot be.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from fleet.conditions.expression import And, Compare, Expression, Literal, Name, Node, Not, Op, Or, ValueKind

_WAYS: Final = 512
"""With more ways than this, nothing is said."""

_Way: TypeAlias = tuple[Compare, ...]
_STANDS: Final = {Op.LT: "<", Op.LE: "<=", Op.GT: ">", Op.GE: ">=", Op.EQ: "=", Op.NE: "<>"}
"""How two values may stand to each other, one character for each."""
_OPPOSITE: Final = {Op.LT: Op.GE, Op.GE: Op.LT, Op.GT: Op.LE, Op.LE: Op.GT, Op.EQ: Op.NE, Op.NE: Op.EQ}
_TURNED: Final = {Op.LT: Op.GT, Op.GT: Op.LT, Op.LE: Op.GE, Op.GE: Op.LE, Op.EQ: Op.EQ, Op.NE: Op.NE}


def contradictory(expression: Expression) -> bool:
    """Whether it can never be true, as `range_m < 0.1 and range_m > 0.2`; some that cannot be are not found."""
    try:
        return not any(_open(way) for way in _ways(expression.root, wanted=True))
    except _TooManyError:
        return False


class _TooManyError(Exception):
    """More ways than are looked at."""


def _ways(node: Node, *, wanted: bool) -> list[_Way]:
    """The ways in which a condition is true, or (not `wanted`) false."""
    match node:
        case Literal(value):
            return [()] if value is wanted else []
        case Name():
            return [(Compare(node, Op.EQ, Literal(wanted)),)]
        case Not(inner):
            return _ways(inner, wanted=not wanted)
        case And(parts):
            each = [_ways(part, wanted=wanted) for part in parts]
            return _all_of(each) if wanted else _one_of(each)
        case Or(parts):
            each = [_ways(part, wanted=wanted) for part in parts]
            return _one_of(each) if wanted else _all_of(each)
        case Compare(left, op, right):
            if _simple(left) and _simple(right):
                return [(node if wanted else Compare(left, _OPPOSITE[op], right),)]
            same = (op is Op.EQ) is wanted
            return _one_of(
                [_all_of([_ways(left, wanted=one), _ways(right, wanted=one is same)]) for one in (True, False)]
            )


def _simple(side: Node) -> bool:
    return isinstance(side, Name | Literal)


def _all_of(several: Iterable[list[_Way]]) -> list[_Way]:
    found: list[_Way] = [()]
    for ways in several:
        if len(found) * len(ways) > _WAYS:
            raise _TooManyError
        found = [one + other for one in found for other in ways]
    return found


def _one_of(several: Iterable[list[_Way]]) -> list[_Way]:
    found = [way for ways in several for way in ways]
    if len(found) > _WAYS:
        raise _TooManyError
    return found


@dataclass(slots=True)
class _Constraint:
    """What is asked of one field."""

    least: float = float("-inf")
    most: float = float("inf")
    is_: set[object] = field(default_factory=set)
    is_not: set[object] = field(default_factory=set)

    def take(self, op: Op, value: object) -> None:
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

    def possible(self) -> bool:
        if self.least == self.most:
            self.is_.add(self.least)
        if self.least > self.most or len(self.is_) > 1:
            return False
        return all(
            value not in self.is_not and (not isinstance(value, int | float) or self.least <= value <= self.most)
            for value in self.is_
        )


def _open(way: _Way) -> bool:
    """Whether all of it can be so at once, as far as is seen."""
    asked: dict[str, _Constraint] = {}
    between: dict[tuple[str, str], set[str]] = {}
    for atom in way:
        match atom:
            case Compare(Literal(value=one), op, Literal(value=other)):
                stands = "=" if one == other else "<" if _number(one) < _number(other) else ">"
                if stands not in _STANDS[op]:
                    return False
            case Compare(Name(name), op, Literal(value)):
                asked.setdefault(name, _Constraint()).take(op, value)
            case Compare(Literal(value), op, Name(name)):
                asked.setdefault(name, _Constraint()).take(_TURNED[op], value)
            case Compare(Name(name=one), op, Name(name=other, kind=kind)):
                op = op if one <= other else _TURNED[op]
                able = "=" if one == other else "<=>" if kind is ValueKind.NUMBER else "<="
                between.setdefault((min(one, other), max(one, other)), set(able)).intersection_update(_STANDS[op])
            case _:
                pass
    return all(between.values()) and all(each.possible() for each in asked.values())


def _number(value: object) -> float:
    """For order; words and truths that differ have one, too, and only whether they are the same is asked of them."""
    return value if isinstance(value, int | float) else 0.0

"""A condition that was understood, as a tree: its value over readings, and its text again. Pure."""

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Final, TypeAlias

Value: TypeAlias = bool | int | float | str
Lookup: TypeAlias = Callable[[str], object | None]
"""The value under a name; None: not measured."""


class ValueKind(StrEnum):
    """What a value is."""

    NUMBER = "a number"
    WORD = "a word"
    TRUTH = "yes or no"


KINDS: Final[Mapping[type, ValueKind]] = {
    float: ValueKind.NUMBER,
    int: ValueKind.NUMBER,
    str: ValueKind.WORD,
    bool: ValueKind.TRUTH,
}


class Op(StrEnum):
    """A comparison."""

    LT = "<"
    LE = "<="
    GT = ">"
    GE = ">="
    EQ = "=="
    NE = "!="


_TESTS: Final[Mapping[Op, Callable[[Any, Any], bool]]] = MappingProxyType(
    {
        Op.LT: operator.lt,
        Op.LE: operator.le,
        Op.GT: operator.gt,
        Op.GE: operator.ge,
        Op.EQ: operator.eq,
        Op.NE: operator.ne,
    }
)


@dataclass(frozen=True, slots=True)
class Name:
    """A field."""

    name: str
    kind: ValueKind

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Literal:
    """A value as written."""

    value: Value

    @property
    def kind(self) -> ValueKind:
        """What it is."""
        return KINDS[type(self.value)]

    def __str__(self) -> str:
        return written(self.value)


@dataclass(frozen=True, slots=True)
class Compare:
    """Two values and how they must stand to each other."""

    left: "Node"
    op: Op
    right: "Node"

    def __str__(self) -> str:
        return " ".join((_within(self.left), self.op, _within(self.right)))


@dataclass(frozen=True, slots=True)
class Not:
    """The opposite."""

    inner: "Node"

    def __str__(self) -> str:
        return f"not {f'({self.inner})' if isinstance(self.inner, And | Or) else self.inner}"


@dataclass(frozen=True, slots=True)
class And:
    """`and`, of two or more."""

    parts: tuple["Node", ...]

    def __str__(self) -> str:
        return " and ".join(f"({part})" if isinstance(part, Or) else str(part) for part in self.parts)


@dataclass(frozen=True, slots=True)
class Or:
    """`or`, of two or more."""

    parts: tuple["Node", ...]

    def __str__(self) -> str:
        return " or ".join(map(str, self.parts))


Node: TypeAlias = Name | Literal | Compare | Not | And | Or


def written(value: object) -> str:
    """A value as it stands in a condition."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"' if "'" in value else f"'{value}'"
    return repr(value)


def _within(side: Node) -> str:
    return str(side) if isinstance(side, Name | Literal) else f"({side})"


@dataclass(frozen=True, slots=True)
class Expression:
    """A condition that was understood; as text it is normalised, and the same when it is read again."""

    root: Node

    def __str__(self) -> str:
        return str(self.root)

    def __and__(self, other: "Expression") -> "Expression":
        """Both."""
        return Expression(joined(And, (self.root, other.root)))

    def __invert__(self) -> "Expression":
        """Not."""
        return Expression(self.root.inner if isinstance(self.root, Not) else Not(self.root))

    @property
    def names(self) -> tuple[str, ...]:
        """The names it uses, each once, as they come."""
        return tuple(dict.fromkeys(_names(self.root)))

    def value(self, lookup: Lookup) -> bool | None:
        """Whether it holds; None: it cannot be said, because something was not measured (None, or not a number).

        Raises TypeError for a value that is not of its name's type: the caller's mistake.
        """
        return _truth(self.root, lookup)


_VALUES: Final = (bool, int, float, str)


def _names(node: Node) -> Iterator[str]:
    match node:
        case Name(name):
            yield name
        case Literal():
            pass
        case Compare(left, _, right):
            yield from _names(left)
            yield from _names(right)
        case Not(inner):
            yield from _names(inner)
        case And(parts) | Or(parts):
            for part in parts:
                yield from _names(part)


def _truth(node: Node, lookup: Lookup) -> bool | None:
    # A coordinator asks a thousand times in a decision: no `match`, which takes three times as long here.
    if isinstance(node, Compare):
        one, other = _value(node.left, lookup), _value(node.right, lookup)
        return None if one is None or other is None else _TESTS[node.op](one, other)
    if isinstance(node, And):
        return _first(node.parts, lookup, decisive=False)
    if isinstance(node, Or):
        return _first(node.parts, lookup, decisive=True)
    if isinstance(node, Not):
        held = _truth(node.inner, lookup)
        return None if held is None else not held
    found = _value(node, lookup)
    return None if found is None else bool(found)


def _first(parts: tuple[Node, ...], lookup: Lookup, *, decisive: bool) -> bool | None:
    unknown = False
    for part in parts:
        held = _truth(part, lookup)
        if held is decisive:
            return decisive
        unknown = unknown or held is None
    return None if unknown else not decisive


def _value(node: Node, lookup: Lookup) -> Value | None:
    if isinstance(node, Literal):
        return node.value
    if not isinstance(node, Name):
        return _truth(node, lookup)
    found = lookup(node.name)
    if found is None:
        return None
    if not isinstance(found, _VALUES) or KINDS.get(type(found)) is not node.kind:
        raise TypeError(f"{node.name} should be {node.kind}, and is {found!r}")
    return None if isinstance(found, float) and math.isnan(found) else found


def joined(join: type[And] | type[Or], parts: Sequence[Node]) -> Node:
    """One node of these; `a and (b and c)` is `a and b and c`."""
    flat: list[Node] = []
    for part in parts:
        flat.extend(part.parts if isinstance(part, join) else (part,))
    return flat[0] if len(flat) == 1 else join(tuple(flat))


def kind_of(node: Node) -> ValueKind:
    """What its value is."""
    return node.kind if isinstance(node, Name | Literal) else ValueKind.TRUTH

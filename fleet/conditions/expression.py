"""A parsed condition as a tree: evaluates it over readings and writes it as text. Pure."""

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, TypeAlias

from msgspec import Struct

Value: TypeAlias = bool | int | float | str
Lookup: TypeAlias = Callable[[str], object | None]
"""Returns the value of a name, or None if it was not measured."""


class ValueKind(StrEnum):
    """The kind of a value."""

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
    """A comparison operator."""

    LT = "<"
    LE = "<="
    GT = ">"
    GE = ">="
    EQ = "=="
    NE = "!="


_TESTS: Final[Mapping[Op, Callable[[Any, Any], bool]]] = {op: getattr(operator, op.name.lower()) for op in Op}


@dataclass(frozen=True, slots=True)
class Name:
    """A field."""

    name: str
    kind: ValueKind
    written: str = field(default="", compare=False)
    """The name as its author wrote it, if that is an alias."""

    def __str__(self) -> str:
        return self.written or self.name


class Literal(Struct, frozen=True):
    """A value that is written in the text."""

    value: Value

    @property
    def kind(self) -> ValueKind:
        """The kind of the value."""
        return KINDS[type(self.value)]

    def __str__(self) -> str:
        return format_literal(self.value)


class Compare(Struct, frozen=True):
    """A comparison of two values."""

    left: "Node"
    op: Op
    right: "Node"

    def __str__(self) -> str:
        return " ".join((_in_parentheses(self.left), self.op, _in_parentheses(self.right)))


class Not(Struct, frozen=True):
    """A condition that is negated by `not`."""

    inner: "Node"

    def __str__(self) -> str:
        return f"not {f'({self.inner})' if isinstance(self.inner, And | Or) else self.inner}"


class And(Struct, frozen=True):
    """Two or more conditions that are joined by `and`."""

    parts: tuple["Node", ...]

    def __str__(self) -> str:
        return " and ".join(f"({part})" if isinstance(part, Or) else str(part) for part in self.parts)


class Or(Struct, frozen=True):
    """Two or more conditions that are joined by `or`."""

    parts: tuple["Node", ...]

    def __str__(self) -> str:
        return " or ".join(map(str, self.parts))


Node: TypeAlias = Name | Literal | Compare | Not | And | Or


def format_literal(value: object) -> str:
    """Format a value as conditions write it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"' if "'" in value else f"'{value}'"
    return repr(value)


def _in_parentheses(side: Node) -> str:
    return str(side) if isinstance(side, Name | Literal) else f"({side})"


class Expression(Struct, frozen=True):
    """A parsed condition. Its text is normalized. Parsing that text gives the same condition."""

    root: Node

    def __str__(self) -> str:
        return str(self.root)

    def __and__(self, other: "Expression") -> "Expression":
        """Join both conditions by `and`."""
        return Expression(join_nodes(And, (self.root, other.root)))

    def __invert__(self) -> "Expression":
        """Negate the condition."""
        return Expression(self.root.inner if isinstance(self.root, Not) else Not(self.root))

    @property
    def names(self) -> tuple[str, ...]:
        """The names that the condition uses, each once, in the order of the text."""
        return tuple(dict.fromkeys(each.name for each in names_in(self.root)))

    def value(self, lookup: Lookup) -> bool | None:
        """Return whether the condition is true. None if that is not known: a value was not measured (None or NaN).

        Raises TypeError if a value is not of its name's type: that is a mistake of the caller.
        """
        return _evaluate(self.root, lookup)


_VALUES: Final = (bool, int, float, str)


def names_in(node: Node) -> Iterator[Name]:
    """Yield the names in a tree, in the order of its text."""
    match node:
        case Name():
            yield node
        case Literal():
            pass
        case Compare(left, _, right):
            yield from names_in(left)
            yield from names_in(right)
        case Not(inner):
            yield from names_in(inner)
        case And(parts) | Or(parts):
            for part in parts:
                yield from names_in(part)


def _evaluate(node: Node, lookup: Lookup) -> bool | None:
    # A coordinator evaluates a thousand conditions in a step. `match` would take three times as long here.
    if isinstance(node, Compare):
        one, other = _value_of(node.left, lookup), _value_of(node.right, lookup)
        return None if one is None or other is None else _TESTS[node.op](one, other)
    if isinstance(node, And):
        return _evaluate_parts(node.parts, lookup, decisive=False)
    if isinstance(node, Or):
        return _evaluate_parts(node.parts, lookup, decisive=True)
    if isinstance(node, Not):
        truth = _evaluate(node.inner, lookup)
        return None if truth is None else not truth
    value = _value_of(node, lookup)
    return None if value is None else bool(value)


def _evaluate_parts(parts: tuple[Node, ...], lookup: Lookup, *, decisive: bool) -> bool | None:
    unknown = False
    for part in parts:
        truth = _evaluate(part, lookup)
        if truth is decisive:
            return decisive
        unknown = unknown or truth is None
    return None if unknown else not decisive


def _value_of(node: Node, lookup: Lookup) -> Value | None:
    if isinstance(node, Literal):
        return node.value
    if not isinstance(node, Name):
        return _evaluate(node, lookup)
    value = lookup(node.name)
    if value is None:
        return None
    if not isinstance(value, _VALUES) or KINDS.get(type(value)) is not node.kind:
        raise TypeError(f"{node.name} should be {node.kind}, but is {value!r}")
    return None if isinstance(value, float) and math.isnan(value) else value


def join_nodes(join: type[And] | type[Or], parts: Sequence[Node]) -> Node:
    """Join nodes into one. `a and (b and c)` becomes `a and b and c`."""
    flat: list[Node] = []
    for part in parts:
        flat.extend(part.parts if isinstance(part, join) else (part,))
    return flat[0] if len(flat) == 1 else join(tuple(flat))


def kind_of(node: Node) -> ValueKind:
    """Return the kind of a node's value."""
    return node.kind if isinstance(node, Name | Literal) else ValueKind.TRUTH

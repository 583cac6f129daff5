"""Parses the text of a condition into its tree. Each error has a column and says what is allowed. Pure.

condition:  comparisons, yes/no fields, true and false, with `not` (binds first), `and`, `or` (binds last), and ()
comparison: < <= > >= between numbers, == and != between two numbers, two words or two yes/no values
words:      in quotes, 'low' or "low", and nothing is escaped in them
"""

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, Never

from msgspec import Struct

from fleet.conditions.expression import (
    KINDS,
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
    kind_of,
)
from schemas.picklable import Picklable
from schemas.suggestion import near_names

MAX_CONDITION_LENGTH: Final = 1000
"""Maximum characters of a condition, as typed and as normalized."""
MAX_PARENTHESES: Final = 32
"""Maximum depth of nested parentheses."""
_MAX_NAMES_LISTED: Final = 6
"""Maximum number of names that an error lists."""


class BadExpression(Picklable, ValueError):
    """A condition with an error. The text says where (`column`, from 1), what is wrong and what is allowed."""

    def __init__(self, text: str, column: int, words: str) -> None:
        super().__init__(f"condition {text[:80]!r}, column {column}: {words}")
        self.column = column
        self.words = words


def parse(
    text: str,
    names: Mapping[str, type],
    aliases: Mapping[str, str] = MappingProxyType({}),
    functions: Collection[str] = (),
) -> Expression:
    """Parse a condition over these names (of type float, int, str or bool). Raises BadExpression for an error.

    `aliases`: other spellings of names, each with the name that it stands for. `functions`: the functions that may be
    applied to a number.
    """
    if len(text) > MAX_CONDITION_LENGTH:
        raise BadExpression(
            text,
            MAX_CONDITION_LENGTH + 1,
            f"it is too long: {len(text)} characters, allowed are {MAX_CONDITION_LENGTH}",
        )
    tree = Expression(_Parser(text, names, aliases, functions).parse_all())
    if len(str(tree)) > MAX_CONDITION_LENGTH:
        raise BadExpression(
            text, 1, f"it is too long in its normal form: allowed are {MAX_CONDITION_LENGTH} characters"
        )
    return tree


_TOKEN: Final = re.compile(
    r"""\s*(?:(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)(?![\w.])
           |(?P<name>[A-Za-z_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?)
           |(?P<word>'[^'\n]*'|"[^"\n]*")
           |(?P<sign><=|>=|==|!=|<|>|\(|\)))""",
    re.VERBOSE | re.ASCII,
)
# Signs of other languages, and what to write instead.
_INSTEAD: Final = {"=": "==", "&": "and", "|": "or", "!": "not", "=<": "<=", "=>": ">=", "<>": "!="}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")


class _Token(Struct, frozen=True):
    kind: str
    """number, name, word, sign, or end."""
    text: str
    column: int


class _Parser:
    """A recursive-descent parser of one text."""

    # `ast.parse` would not help: errors need the columns of parentheses and of missing operands, names may have dots,
    # and words have no escapes.

    def __init__(
        self, text: str, names: Mapping[str, type], aliases: Mapping[str, str], functions: Collection[str]
    ) -> None:
        self._text = text
        self._names = names
        self._aliases = aliases
        self._functions = functions
        self._tokens = list(self._tokenize())
        self._at = 0
        self._depth = 0

    def parse_all(self) -> Node:
        tree, token = self._parse_or(), self._next
        if token.kind != "end":
            if token.text == ")":
                self._fail(token, "this ) has no ( before it")
            self._fail(token, f"{token.text} is not expected here: join conditions with and, or")
        self._check_condition(self._tokens[0], tree)
        return tree

    def _tokenize(self) -> Iterator[_Token]:
        at = 0
        while self._text[at:].strip():
            match = _TOKEN.match(self._text, at)
            if match is None:
                self._fail_at(at + len(self._text[at:]) - len(self._text[at:].lstrip()))
            assert match.lastgroup is not None
            yield _Token(match.lastgroup, match[match.lastgroup], match.start(match.lastgroup) + 1)
            at = match.end()
        yield _Token("end", "", len(self._text) + 1)

    def _fail_at(self, at: int) -> Never:
        """Raise the error for the text at this position, where no token begins."""
        token, rest = _Token("odd", "", at + 1), self._text[at:]
        if rest[0] in "'\"":
            self._fail(token, f"the word that begins with {rest[0]} has no end")
        number = re.match(r"[+-]?[0-9][0-9.]*", rest)
        if number is not None:
            self._fail(
                token,
                f"{rest.split()[0]} is not a number. Write it without a unit: each field has a fixed one.",
            )
        wrong = next((wrong for wrong in sorted(_INSTEAD, key=len, reverse=True) if rest.startswith(wrong)), None)
        if wrong is not None:
            self._fail(token, f"{wrong} is not known: write {_INSTEAD[wrong]}")
        self._fail(
            token, f"{rest[0]!r} is not known: there are names, numbers, 'words', < <= > >= == !=, and, or, not, ()"
        )

    @property
    def _next(self) -> _Token:
        return self._tokens[self._at]

    def _take(self, *texts: str) -> _Token | None:
        """Consume the next token if it is one of these texts and not a quoted word."""
        token = self._next
        if token.kind == "word" or token.text not in texts:
            return None
        self._at += 1
        return token

    def _parse_or(self) -> Node:
        return self._parse_joined("or", Or, self._parse_and)

    def _parse_and(self) -> Node:
        return self._parse_joined("and", And, self._parse_not)

    def _parse_joined(self, word: str, join: type[And] | type[Or], part: Callable[[], Node]) -> Node:
        at, parts = [self._next], [part()]
        while self._take(word):
            at.append(self._next)
            parts.append(part())
        if len(parts) > 1:
            for token, each in zip(at, parts, strict=True):
                self._check_condition(token, each)
        return join_nodes(join, parts)

    def _parse_not(self) -> Node:
        denied, negations = False, 0
        while self._take("not"):
            denied, negations = not denied, negations + 1
        token = self._next
        inner = self._parse_comparison()
        if negations:
            self._check_condition(token, inner)
        if not denied:
            return inner
        return inner.inner if isinstance(inner, Not) else Not(inner)

    def _parse_comparison(self) -> Node:
        first = self._next
        left = self._parse_operand()
        sign = self._take(*Op)
        if sign is None:
            return left
        second = self._next
        right = self._parse_operand()
        self._check_comparable(sign, (first, left), (second, right))
        again = self._take(*Op)
        if again is not None:
            self._fail(again, "comparisons do not chain: write 0.1 < x and x < 0.3")
        return Compare(left, Op(sign.text), right)

    def _parse_operand(self) -> Node:
        token = self._next
        self._at += 1
        if token.kind == "number":
            return Literal(self._parse_number(token))
        if token.kind == "word":
            return Literal(token.text[1:-1])
        if token.kind == "name":
            if token.text in ("true", "false"):
                return Literal(token.text == "true")
            if token.text in self._functions and self._take("("):
                return self._parse_call(token.text)
            name = self._aliases.get(token.text, token.text)
            return Name(name, self._kind_of_name(token, name), token.text if token.text != name else "")
        if token.text == "(":
            return self._parse_parentheses(token)
        before = f", before {token.text}" if token.text else f": {self._list_names()}"
        raise BadExpression(self._text, token.column, f"a field or a value is missing here{before}")

    def _parse_parentheses(self, opening: _Token) -> Node:
        self._depth += 1
        if self._depth > MAX_PARENTHESES:
            self._fail(opening, f"parentheses are too deep: allowed are {MAX_PARENTHESES} within each other")
        tree, token = self._parse_or(), self._next
        if not self._take(")"):
            self._fail(token, f"the ( of column {opening.column} is not closed")
        self._depth -= 1
        if not isinstance(tree, Name | Literal):
            self._check_condition(opening, tree)
        return tree

    def _parse_call(self, function: str) -> Name:
        """Parse the rest of `rate(range_m)`.

        The result is a Name such as `rate(range_m)`: who evaluates the condition looks up its value like a field's.
        """
        token = self._next
        field = None if token.text in self._functions else self._parse_operand()
        if not isinstance(field, Name) or field.kind is not ValueKind.NUMBER:
            self._fail(token, f"{function} takes a field that is a number")
        if not self._take(")"):
            self._fail(self._next, f"the ( of {function} is not closed")
        return Name(f"{function}({field.name})", ValueKind.NUMBER, f"{function}({field})" if field.written else "")

    def _parse_number(self, token: _Token) -> int | float:
        if re.fullmatch(r"[+-]?[0-9]+", token.text):
            return int(token.text)
        number = float(token.text)
        if math.isinf(number):
            self._fail(token, f"{token.text} is beyond what a number can be")
        return number

    def _kind_of_name(self, token: _Token, name: str) -> ValueKind:
        if name not in self._names:
            self._fail_unknown(token)
        return KINDS[self._names[name]]

    def _fail_unknown(self, token: _Token) -> Never:
        if token.text in ("and", "or", "not"):
            self._fail(token, f"a field or a value is missing here, before {token.text}")
        quoted = any(each.kind == "word" for each in self._tokens[max(0, self._at - 3) : self._at + 2])
        if self._expected_kind() is ValueKind.WORD and not quoted:
            self._fail(token, f"{token.text} is not a value. A word needs quotes: '{token.text}'")
        near = self._close_names(token.text)
        listed = self._list_names(self._fitting_names())
        hint = f"Did you mean {' or '.join(near)}?" if near else f"T{listed[1:]}"
        self._fail(token, f"{token.text} is not a value. {hint}")

    def _close_names(self, text: str) -> list[str]:
        """Return likely names of the kind that is compared here. Names that have the text between dots come first."""
        expected, fitting = self._expected_kind(), self._fitting_names()
        parts = [name for name in fitting if text in name.split(".")]
        words = [*fitting, *(() if expected not in (None, ValueKind.TRUTH) else _KEYWORDS)]
        aliases = [alias for alias, name in self._aliases.items() if name in fitting]
        near = [*parts, *near_names(text, words)] or near_names(text, aliases)
        return list(dict.fromkeys(near))[:2]

    def _fitting_names(self) -> list[str]:
        """Return the names of the kind that fits here, or all names."""
        expected = self._expected_kind()
        return [name for name, kind in self._names.items() if expected in (None, KINDS[kind])] or list(self._names)

    def _expected_kind(self) -> ValueKind | None:
        """Return the kind that the last read name must have, judged by the tokens around it. None if any kind fits."""
        before, after = self._at - 2, self._at
        for sign, other in ((after, after + 1), (before, before - 1)):
            if 0 <= sign < len(self._tokens) and self._tokens[sign].text in tuple(Op):
                token = self._tokens[other]
                if self._tokens[sign].text not in (Op.EQ, Op.NE) or token.kind == "number":
                    return ValueKind.NUMBER
                if token.kind == "word":
                    return ValueKind.WORD
                named = self._names.get(self._aliases.get(token.text, token.text))
                return ValueKind.TRUTH if token.text in ("true", "false") else None if named is None else KINDS[named]
        return ValueKind.TRUTH

    def _list_names(self, names: Sequence[str] | None = None) -> str:
        listed = list(self._names if names is None else names)
        if not listed:
            return "there are no names here"
        more = f" and {len(listed) - _MAX_NAMES_LISTED} more" if len(listed) > _MAX_NAMES_LISTED else ""
        return f"there are {', '.join(listed[:_MAX_NAMES_LISTED])}{more}"

    def _check_condition(self, token: _Token, node: Node) -> None:
        """Fail if a node is a number or a word, because neither is a condition."""
        kind = kind_of(node)
        if kind is not ValueKind.TRUTH:
            example = f"{node} < 0.3" if kind is ValueKind.NUMBER else f"{node} == 'low'"
            self._fail(token, f"{node} is {kind}, not a condition: compare it, for example {example}")

    def _check_comparable(self, sign: _Token, left: tuple[_Token, Node], right: tuple[_Token, Node]) -> None:
        one, other = kind_of(left[1]), kind_of(right[1])
        if sign.text not in ("==", "!="):
            for token, node in (left, right):
                kind = kind_of(node)
                if kind is not ValueKind.NUMBER:
                    bare = ", or let it stand alone" if kind is ValueKind.TRUTH else ""
                    self._fail(token, f"{node} is {kind}: {sign.text} compares numbers, so use == or !={bare}")
        if one is not other:
            self._fail(sign, f"{left[1]} is {one}, {right[1]} is {other}: they are never the same")

    def _fail(self, token: _Token, words: str) -> Never:
        raise BadExpression(self._text, token.column, words)

"""The text of a condition, read into its tree: what may stand where, and words for what may not. Pure.

condition:  comparisons, yes/no fields, true and false, joined by `not`, `and`, `or` (binding in this order) and ()
comparison: < <= > >= between numbers, == and != between two numbers, two words or two truths
words:      in quotes, 'low' or "low", and nothing is escaped in them
"""

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Never

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
    joined,
    kind_of,
)

LENGTH: Final = 1000
"""The most characters of a condition, as written and as given back."""
DEPTH: Final = 32
"""The most parentheses within each other."""
_LISTED: Final = 16


class BadExpression(ValueError):
    """A condition that cannot be understood; the text says where (`column`, from 1), what and what is allowed."""

    def __init__(self, text: str, column: int, words: str) -> None:
        super().__init__(f"condition {text[:80]!r}, column {column}: {words}")
        self.column = column
        self.words = words


def parse(text: str, names: Mapping[str, type]) -> Expression:
    """Understand a condition over these names (of type float, int, str or bool); raises BadExpression."""
    if len(text) > LENGTH:
        raise BadExpression(text, LENGTH + 1, f"it is too long: {len(text)} characters, allowed are {LENGTH}")
    found = Expression(_Parser(text, names).whole())
    if len(str(found)) > LENGTH:
        raise BadExpression(
            text, 1, f"it is too long when its numbers are written out: allowed are {LENGTH} characters"
        )
    return found


_TOKEN: Final = re.compile(
    r"""\s*(?:(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)(?![\w.])
           |(?P<name>[A-Za-z_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?)
           |(?P<word>'[^'\n]*'|"[^"\n]*")
           |(?P<sign><=|>=|==|!=|<|>|\(|\)))""",
    re.VERBOSE | re.ASCII,
)
_INSTEAD: Final = {"=": "==", "&": "and", "|": "or", "!": "not", "=<": "<=", "=>": ">=", "<>": "!="}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")


@dataclass(frozen=True, slots=True)
class _Token:
    what: str
    """number, name, word, sign, or end."""
    text: str
    column: int


class _Parser:
    """Takes one text apart from left to right."""

    def __init__(self, text: str, names: Mapping[str, type]) -> None:
        self._text = text
        self._names = names
        self._tokens = list(self._cut())
        self._at = 0
        self._depth = 0

    def whole(self) -> Node:
        found, token = self._any(), self._next
        if token.what != "end":
            if token.text == ")":
                self._fail(token, "this ) has no ( before it")
            self._fail(token, f"{token.text} is not expected here: join conditions with and, or")
        self._condition(self._tokens[0], found)
        return found

    def _cut(self) -> Iterator[_Token]:
        at = 0
        while self._text[at:].strip():
            match = _TOKEN.match(self._text, at)
            if match is None:
                self._odd(at + len(self._text[at:]) - len(self._text[at:].lstrip()))
            assert match.lastgroup is not None
            yield _Token(match.lastgroup, match[match.lastgroup], match.start(match.lastgroup) + 1)
            at = match.end()
        yield _Token("end", "", len(self._text) + 1)

    def _odd(self, at: int) -> Never:
        """Say what may stand where nothing that we know stands."""
        token, rest = _Token("odd", "", at + 1), self._text[at:]
        if rest[0] in "'\"":
            self._fail(token, f"the word that begins with {rest[0]} has no end")
        number = re.match(r"[+-]?[0-9][0-9.]*", rest)
        if number is not None:
            self._fail(token, f"{rest.split()[0]} is no number; units are not written: they are the field's")
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
        """The next token, if it is one of these and no quoted word."""
        token = self._next
        if token.what == "word" or token.text not in texts:
            return None
        self._at += 1
        return token

    def _any(self) -> Node:
        return self._several("or", Or, self._all)

    def _all(self) -> Node:
        return self._several("and", And, self._not)

    def _several(self, word: str, join: type[And] | type[Or], part: Callable[[], Node]) -> Node:
        at, parts = [self._next], [part()]
        while self._take(word):
            at.append(self._next)
            parts.append(part())
        if len(parts) > 1:
            for token, each in zip(at, parts, strict=True):
                self._condition(token, each)
        return joined(join, parts)

    def _not(self) -> Node:
        denied, negations = False, 0
        while self._take("not"):
            denied, negations = not denied, negations + 1
        token = self._next
        inner = self._comparison()
        if negations:
            self._condition(token, inner)
        if not denied:
            return inner
        return inner.inner if isinstance(inner, Not) else Not(inner)

    def _comparison(self) -> Node:
        first = self._next
        left = self._operand()
        sign = self._take(*Op)
        if sign is None:
            return left
        second = self._next
        right = self._operand()
        self._comparable(sign, (first, left), (second, right))
        again = self._take(*Op)
        if again is not None:
            self._fail(again, "comparisons do not chain: write 0.1 < x and x < 0.3")
        return Compare(left, Op(sign.text), right)

    def _operand(self) -> Node:
        token = self._next
        self._at += 1
        if token.what == "number":
            return Literal(self._number(token))
        if token.what == "word":
            return Literal(token.text[1:-1])
        if token.what == "name":
            if token.text in ("true", "false"):
                return Literal(token.text == "true")
            return Name(token.text, self._kind(token))
        if token.text == "(":
            return self._inside(token)
        before = f", before {token.text}" if token.text else f": {self._there_are()}"
        raise self._wrong(token, f"a field or a value is missing here{before}")

    def _inside(self, opening: _Token) -> Node:
        self._depth += 1
        if self._depth > DEPTH:
            self._fail(opening, f"parentheses are too deep: allowed are {DEPTH} within each other")
        found, token = self._any(), self._next
        if not self._take(")"):
            self._fail(token, f"the ( of column {opening.column} is not closed")
        self._depth -= 1
        if not isinstance(found, Name | Literal):
            self._condition(opening, found)
        return found

    def _number(self, token: _Token) -> int | float:
        if re.fullmatch(r"[+-]?[0-9]+", token.text):
            return int(token.text)
        number = float(token.text)
        if math.isinf(number):
            self._fail(token, f"{token.text} is beyond what a number can be")
        return number

    def _kind(self, token: _Token) -> ValueKind:
        if token.text in self._names:
            return KINDS[self._names[token.text]]
        if token.text in ("and", "or", "not"):
            self._fail(token, f"a field or a value is missing here, before {token.text}")
        near = self._near(token.text)
        meant = f"did you mean {' or '.join(near)}? " if near else ""
        compared = self._at > 1 and self._tokens[self._at - 2].text in tuple(Op)
        quoted = f"; a word is quoted, as '{token.text}'" if compared else ""
        raise self._wrong(token, f"there is no {token.text}: {meant}{self._there_are(self._able())}{quoted}")

    def _near(self, text: str) -> list[str]:
        """Names that may have been meant, of the kind that is compared here: first those that have it as a part."""
        wanted, able = self._compared_with(), self._able()
        parts = [name for name in able if text in name.split(".")]
        others = able if wanted not in (None, ValueKind.TRUTH) else [*able, *_KEYWORDS]
        return list(dict.fromkeys([*parts, *difflib.get_close_matches(text, others, n=2)]))[:2]

    def _able(self) -> list[str]:
        """The names of the kind that is wanted here, or all."""
        wanted = self._compared_with()
        return [name for name, kind in self._names.items() if wanted in (None, KINDS[kind])] or list(self._names)

    def _compared_with(self) -> ValueKind | None:
        """What the name before the next token must be, by what stands beside it; None: that does not tell."""
        before, after = self._at - 2, self._at
        for sign, other in ((after, after + 1), (before, before - 1)):
            if 0 <= sign < len(self._tokens) and self._tokens[sign].text in tuple(Op):
                token = self._tokens[other]
                if self._tokens[sign].text not in (Op.EQ, Op.NE) or token.what == "number":
                    return ValueKind.NUMBER
                if token.what == "word":
                    return ValueKind.WORD
                named = self._names.get(token.text)
                return ValueKind.TRUTH if token.text in ("true", "false") else None if named is None else KINDS[named]
        return ValueKind.TRUTH

    def _there_are(self, names: Sequence[str] | None = None) -> str:
        listed = list(self._names if names is None else names)
        more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
        return f"there are {', '.join(listed[:_LISTED])}{more}" if listed else "there are no names here"

    def _condition(self, token: _Token, node: Node) -> None:
        """A number or a word is no condition."""
        kind = kind_of(node)
        if kind is not ValueKind.TRUTH:
            example = f"{node} < 0.3" if kind is ValueKind.NUMBER else f"{node} == 'low'"
            self._fail(token, f"{node} is {kind}, not a condition: compare it, as {example}")

    def _comparable(self, sign: _Token, left: tuple[_Token, Node], right: tuple[_Token, Node]) -> None:
        one, other = kind_of(left[1]), kind_of(right[1])
        if sign.text not in ("==", "!="):
            for token, node in (left, right):
                kind = kind_of(node)
                if kind is not ValueKind.NUMBER:
                    bare = ", or stands alone" if kind is ValueKind.TRUTH else ""
                    self._fail(token, f"{node} is {kind}: {sign.text} compares numbers, this takes == or !={bare}")
        if one is not other:
            self._fail(sign, f"{left[1]} is {one}, {right[1]} is {other}: they are never the same")

    def _fail(self, token: _Token, words: str) -> Never:
        raise self._wrong(token, words)

    def _wrong(self, token: _Token, words: str) -> BadExpression:
        return BadExpression(self._text, token.column, words)

"""A closed word has one home, `schemas.words`: no module compares with, or fills a field with, a literal of it."""

import ast
from collections.abc import Iterator, Mapping
from enum import EnumType
from pathlib import Path
from typing import Final

import pytest

from schemas import commands, words
from tests.support.sources import GROUP, ROOT, nodes, source_files

pytestmark = pytest.mark.xdist_group(GROUP)

FIELDS: Final[Mapping[str, tuple[EnumType, ...]]] = {
    "asked": (words.Mode,),
    "basis": (words.Basis,),
    "inferred": (words.Mode,),
    "kind": (words.Rank, words.ProcessKind),
    "level": (words.BatteryLevel, words.Level),
    "link": (words.LinkState,),
    "mode": (words.Mode,),
    "motion": (words.Motion,),
    "motors": (words.Motors,),
    "motors_basis": (words.Basis,),
    "phase": (words.Phase,),
    "platform": (words.Platform,),
    "rank": (words.Rank,),
    "reason": (words.Reason,),
    "scope": (words.Scope,),
    "servo": (words.Servo,),
    "shows_stops": (words.Shows,),
    "source": (words.MotionSource,),
    "state": (words.LinkState, words.RunState, words.RecorderState, words.FanState),
    "status": (words.Phase,),
    "step": (words.SpeedStep,),
    "trust": (words.CarTrust,),
    "verb": (commands.Verb, words.RecorderVerb),
    "verdict": (words.Verdict, words.FrameVerdict, words.Cause, words.LinkVerdict),
    "what": (words.LinkState, words.Motors),
}
"""The names of fields and variables that hold a closed word, with its enums."""

USERS_PROGRAMS: Final = ROOT / "fleet" / "examples"
"""Programs that users copy: they write words as text, as they type them."""

ENUMS: Final = tuple(
    each for each in vars(words).values() if isinstance(each, EnumType) and each.__module__ == words.__name__
)
# Colors, parts, subcommands and options have names of their own that are spelled alike.
LISTED: Final = tuple(each for each in ENUMS if each not in (words.Light, words.Servo, words.FrameVerdict))
SIDES: Final = {"left", "right"}
"""Two motions, and where a sensor is."""


def name_of(node: ast.expr) -> str:
    """Return the last name of an expression: `phase` of `event.phase`, `row["phase"]` and `_phase`."""
    match node:
        case ast.Attribute(attr=name) | ast.Name(id=name) | ast.Subscript(slice=ast.Constant(value=str() as name)):
            return name.lstrip("_")
        case ast.Call(func=ast.Attribute(attr="get"), args=[ast.Constant(value=str() as name), *_]):
            return name
    return ""


def texts(node: ast.AST | None) -> Iterator[ast.Constant]:
    """Yield the texts that an expression may be: also those of its branches and of a list."""
    match node:
        case ast.Constant(value=str()):
            yield node
        case ast.IfExp(body=first, orelse=second):
            yield from (*texts(first), *texts(second))
        case ast.BoolOp(values=several) | ast.Tuple(elts=several) | ast.Set(elts=several) | ast.List(elts=several):
            for each in several:
                yield from texts(each)
        case ast.Call(func=ast.Name(id="frozenset"), args=[each]):
            yield from texts(each)


def held(node: ast.AST) -> Iterator[tuple[str, ast.Constant]]:
    """Yield each text that is compared with a field, or that a field gets, with the field's name."""
    match node:
        case ast.Compare(left=left, comparators=others):
            for one, other in zip([left, *others], [*others], strict=False):
                yield from ((name_of(one), each) for each in texts(other))
                yield from ((name_of(other), each) for each in texts(one))
        case ast.Match(subject=subject, cases=cases):
            values = (
                each.value for case in cases for each in ast.walk(case.pattern) if isinstance(each, ast.MatchValue)
            )
            yield from ((name_of(subject), each) for value in values for each in texts(value))
        case ast.keyword(arg=str() as name, value=value):
            yield from ((name, each) for each in texts(value))
        case ast.Assign(targets=targets, value=value):
            yield from ((name_of(target), each) for target in targets for each in texts(value))
        case ast.AnnAssign(target=target, value=value):
            yield from ((name_of(target), each) for each in texts(value))
        case ast.arguments():
            plain = [*node.posonlyargs, *node.args]
            pairs = [
                *zip(plain[::-1], node.defaults[::-1], strict=False),
                *zip(node.kwonlyargs, node.kw_defaults, strict=True),
            ]
            yield from ((argument.arg, each) for argument, default in pairs for each in texts(default))
        case ast.Dict(keys=keys, values=values):
            for key, value in zip(keys, values, strict=True):
                if isinstance(key, ast.Constant):
                    yield from ((str(key.value), each) for each in texts(value))
        case ast.Subscript(value=ast.Dict(keys=keys), slice=index):
            yield from ((name_of(index), each) for key in keys for each in texts(key))
        case ast.Call(func=ast.Attribute(value=ast.Dict(keys=keys), attr="get"), args=[index, *_]):
            yield from ((name_of(index), each) for key in keys for each in texts(key))


def lists(node: ast.AST) -> Iterator[ast.Constant]:
    """Yield the texts of a list, or of the keys of a table, that has words of one enum only."""
    match node:
        case ast.Tuple(elts=found) | ast.Set(elts=found) | ast.List(elts=found):
            pass
        case ast.Dict(keys=[*keys]):
            found = [each for each in keys if each is not None]
        case _:
            return
    values = [each.value for each in found if isinstance(each, ast.Constant) and isinstance(each.value, str)]
    is_list = len(values) > 1 and len(values) == len(found) and {*values} != SIDES
    if is_list and any({*values} <= {*map(str, enum)} for enum in LISTED):
        yield from (each for each in found if isinstance(each, ast.Constant))


def literals(path: Path) -> Iterator[str]:
    for node in nodes(path):
        for name, text in held(node):
            if any(text.value in tuple(enum) for enum in FIELDS.get(name, ())):
                yield f"{path.relative_to(ROOT)}:{text.lineno}: {name} {text.value!r}"
        for text in lists(node):
            yield f"{path.relative_to(ROOT)}:{text.lineno}: a list with {text.value!r}"


def test_no_module_has_a_closed_word_as_a_literal() -> None:
    files = [path for path in source_files("gateway", "fleet", "schemas") if USERS_PROGRAMS not in path.parents]
    found = [each for path in files if path.name != "words.py" for each in literals(path)]
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "a = event.phase == 'sent'",
        "a = row['motors'] not in ('off', 'on')",
        "a = fields.get('scope') == 'fleet'",
        "match event.reason:\n    case 'leased' | 'lent': pass",
        "result = Result(status='sent' if ok else 'rejected')",
        "self._state = 'ending'",
        "def f(*, kind: str = 'script'): pass",
        "code = {'rejected': 2, 'failed': 1}.get(answer.status, 0)",
        "shown = {'state': 'closed'}",
        "PHASES = frozenset({'failed', 'rejected', 'expired'})",
    ],
)
def test_literal_word_is_found(code: str) -> None:
    tree = ast.parse(code)
    found = [
        each for node in ast.walk(tree) for each in (*((t.value) for n, t in held(node) if n in FIELDS), *lists(node))
    ]
    assert found

"""Each code of a reason or event has a row in its table and a section for troubleshooting, with real quotations."""

import ast
import re
from collections.abc import Iterator
from itertools import chain
from typing import Final

import pytest

from schemas.reason_codes import EVENTS, REASONS
from schemas.words import BatteryLevel, Level, Reason
from tests.support.sources import GROUP, PRODUCT, ROOT, nodes, source_files

pytestmark = pytest.mark.xdist_group(GROUP)

PAGE: Final = ROOT / "docs/how-to/troubleshooting.md"


def product_nodes() -> Iterator[ast.AST]:
    return chain.from_iterable(nodes(path) for path in source_files(*PRODUCT))


def logged() -> set[tuple[str, str]]:
    """Return level and code of each call `log(Level.X, "code", ...)`, or `_log`."""
    found = set()
    for node in product_nodes():
        match node:
            case ast.Call(
                func=ast.Attribute(attr="log" | "_log"), args=[ast.Attribute(attr=level), ast.Constant(code), *_]
            ):
                found.add((str(Level[level]), str(code)))
    return found


def templates() -> list[re.Pattern[str]]:
    """Return a pattern for each text of 3 to 59 words in the source."""
    found = []
    for node in product_nodes():
        match node:
            case ast.JoinedStr(values=values):
                text = "".join(str(each.value) if isinstance(each, ast.Constant) else "{}" for each in values)
            case ast.Constant(value=str() as text):
                pass
            case _:
                continue
        if 3 <= len(text.split()) < 60:
            found.append(re.compile(".+?".join(re.escape(each) for each in re.split(r"\{\w*\}", text.rstrip()))))
    return found


def test_each_reason_is_in_the_table() -> None:
    assert set(REASONS) == {*map(str, Reason), "no_answer", "no_result"}


def test_each_event_is_in_the_table_with_its_level() -> None:
    found = logged()
    assert found <= {(each.level, code) for code, each in EVENTS.items()}
    elsewhere = {f"battery_{level}" for level in BatteryLevel} | {"internal_error"}
    assert set(EVENTS) == {code for _, code in found} | elsewhere


def test_each_code_has_a_section_that_says_what_to_do() -> None:
    sections = re.findall(r"^### (\w+)\n\n(.+?)\n\nWhat to do: .", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [code for code, _ in sections] == [*REASONS, *(code for code in EVENTS if code not in REASONS)]
    meanings = {**{code: each.meaning for code, each in EVENTS.items()}, **REASONS}
    assert not [code for code, text in sections if not text.startswith(meanings[code])]


def test_each_quoted_message_is_in_the_source() -> None:
    quoted = re.findall(r"^> (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(quoted) > 10
    known = templates()
    # A message may have several texts, and a quotation may end early. Half of a quotation in one text is enough.
    strange = [
        text
        for text in quoted
        if not any((found := each.search(text)) and len(found[0]) >= len(text) / 2 for each in known)
    ]
    assert not strange, "the page quotes what no code says"

"""The page's texts in `static/texts.js` name every value that a car can report."""

import re
from enum import StrEnum
from pathlib import Path

import pytest

from fleet.console import server
from schemas.words import Mode, Motion

TEXTS = Path(server.__file__).parent / "static" / "texts.js"


def keys_of(name: str) -> set[str]:
    """Return the keys of one exported table of the texts, each at the start of a line."""
    body = re.search(rf"^export const {name} = {{\n(.*?)^}};", TEXTS.read_text(), re.DOTALL | re.MULTILINE)
    assert body is not None, f"{TEXTS.name} exports no table {name}"
    return set(re.findall(r"^  (\w+):", body[1], re.MULTILINE))


@pytest.mark.parametrize(("name", "values"), [("modes", Mode), ("motions", Motion)])
def test_the_texts_name_every_value_and_unknown(name: str, values: type[StrEnum]) -> None:
    assert keys_of(name) == {value.value for value in values} | {"unknown"}

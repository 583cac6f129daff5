"""The texts of the pages name every value that a car can report."""

import re
from pathlib import Path

from fleet.console import server
from schemas.words import MODE_TEXTS, LinkState, Mode, Motion

TEXTS = Path(server.__file__).parent / "static" / "texts.js"


def keys_of(name: str) -> set[str]:
    """Return the keys of one exported table of the texts, each at the start of a line."""
    body = re.search(rf"^export const {name} = {{\n(.*?)^}};", TEXTS.read_text(), re.DOTALL | re.MULTILINE)
    assert body is not None, f"{TEXTS.name} exports no table {name}"
    return set(re.findall(r"^  (\w+):", body[1], re.MULTILINE))


def test_texts_name_every_motion_and_unknown() -> None:
    assert keys_of("motions") == {*Motion, "unknown"}


def test_each_mode_has_title_and_sentence() -> None:
    assert set(MODE_TEXTS) == set(Mode)
    assert all(name and words.endswith(".") for name, words in MODE_TEXTS.values())


def test_texts_name_every_state_of_a_link() -> None:
    assert keys_of("links") == {*LinkState, "unreadable", "unknown"}

"""The style sheet of the pages has one scale of spaces and sizes."""

import re
from pathlib import Path

from fleet.console import server

SHEET = (Path(server.__file__).parent / "static" / "style.css").read_text()
OWN_SIZES = {"2px", "0.125rem", "7rem", "9rem", "14rem", "15rem", "18rem", "20rem", "22rem", "6rem", "3.75rem"}
"""Edges and gaps finer than the scale, and the smallest widths of what is laid out."""


def test_lengths_are_those_of_the_scale() -> None:
    scale, _, rules = SHEET.partition("}")
    rules = re.sub(r"@media[^{]*|/\*.*?\*/|-999rem", "", rules, flags=re.DOTALL)
    assert set(re.findall(r"[\d.]+(?:rem|px)\b", rules)) - OWN_SIZES == set()
    assert set(re.findall(r"[\d.]+(?:rem|px)\b", rules)) >= OWN_SIZES, "no size is left here that no rule has"
    named = set(re.findall(r"(--[\w-]+):", scale))
    used = set(re.findall(r"var\((--[\w-]+)\)", rules)) - {"--car"}
    assert used <= named
    assert named - used == set()

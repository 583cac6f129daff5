"""Fits the columns of a table into the width of a terminal. Pure."""

from collections.abc import Mapping, Sequence
from typing import Final

MIN_COLUMN_WIDTH: Final = 4
"""Minimum width of a column that is shortened."""


def fit_columns(widths: Mapping[str, int], width: int, optional: Sequence[str], gap: int = 2) -> dict[str, int]:
    """Return the columns of a table that fit into `width`, with their widths.

    The optional columns are left out first, in their order. Then the widest column is shortened, again and again.
    """
    result = dict(widths)

    def excess() -> int:
        return sum(result.values()) + gap * (len(result) - 1) - width

    for name in optional:
        if excess() > 0:
            result.pop(name, None)
    while excess() > 0 and max(result.values()) > MIN_COLUMN_WIDTH:
        widest = max(result, key=lambda name: result[name])
        result[widest] -= 1
    return result

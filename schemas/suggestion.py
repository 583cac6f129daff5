"""Words for users that name the likely fix: the name that was meant, and how to install an extra. Pure."""

import difflib
from collections.abc import Iterable
from typing import Final

_MIN_PART_LENGTH: Final = 3
"""Minimum length of a word that is searched within names."""


def nearest(wrong: str, names: Iterable[str]) -> str | None:
    """Return the name that is like `wrong`, or else the first that contains it. None if there is none."""
    known, lower = list(names), wrong.lower()
    containing = [name for name in known if lower in name] if len(lower) >= _MIN_PART_LENGTH else []
    return next(iter([*difflib.get_close_matches(lower, known, n=1), *containing]), None)


def did_you_mean(wrong: str, names: Iterable[str]) -> str:
    """Return a question with the likely name. Empty if no name is near."""
    near = nearest(wrong, names)
    return f"Did you mean {near}?" if near else ""


def how_to_install(extra: str) -> str:
    """Return what to type to install an extra of this package."""
    return f"pip install 'zenoh-car-fleet[{extra}]' (from a clone: pip install '.[{extra}]')"

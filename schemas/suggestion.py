"""Suggests to users what to type instead: the name that was meant, or how to install an extra. Pure.

A name is near a word if few letters differ, or if the name or a part of it begins with the word. A name of letters and
digits only is also near a word that begins with the whole name, such as `tracking mode`. A name that is only somewhat
like the word is never suggested: whoever types `parking` does not mean `tracking`.
"""

import re
from collections.abc import Iterable
from typing import Final

_LETTERS_PER_FAULT: Final = 3
"""For every three letters of a word, one letter may be wrong, missing, extra or swapped. A word of two letters may have
one such fault, too, and a single letter none."""
_MIN_PART_LENGTH: Final = 3
"""Minimum length of a word that is compared with the beginning of each part of a name. A shorter word is compared only
with the beginning of the whole name."""
_NO_WORD: Final = re.compile(r"[^a-z0-9]+")


def misspelled(wrong: str, names: Iterable[str]) -> list[str]:
    """Return the names that differ from the word in only few letters, the nearest first."""
    word = wrong.lower()
    allowed = min(max(1, len(word) // _LETTERS_PER_FAULT), len(word) - 1)
    found = [(_faults(word, name.lower()), name) for name in names if abs(len(name) - len(word)) <= allowed]
    return [name for faults, name in sorted(found, key=lambda each: each[0]) if faults <= allowed]


def near_names(wrong: str, names: Iterable[str]) -> list[str]:
    """Return the names that are likely meant, the likeliest first."""
    known, word = list(names), wrong.lower()
    begun = [name for name in known if len(word) > 1 and name.lower().startswith(word)]
    parts = {name: _NO_WORD.split(name.lower()) for name in known if len(word) >= _MIN_PART_LENGTH}
    part = [name for name, words in parts.items() if any(each.startswith(word) for each in words)]
    longer = [name for name in known if name.lower() == _NO_WORD.split(word)[0]]
    return list(dict.fromkeys([*misspelled(wrong, known), *begun, *part, *longer]))


def _faults(word: str, name: str) -> int:
    """Return how many letters are wrong, missing, extra, or swapped with the next one."""
    rows = [list(range(len(name) + 1))]
    for at, letter in enumerate(word, 1):
        row = [at]
        for to, other in enumerate(name, 1):
            best = min(rows[-1][to] + 1, row[-1] + 1, rows[-1][to - 1] + (letter != other))
            if at > 1 and to > 1 and (letter, word[at - 2]) == (name[to - 2], other):
                best = min(best, rows[-2][to - 2] + 1)
            row.append(best)
        rows.append(row)
    return rows[-1][-1]


def nearest(wrong: str, names: Iterable[str]) -> str | None:
    """Return the name that is likely meant. None if there is none."""
    return next(iter(near_names(wrong, names)), None)


def did_you_mean(wrong: str, names: Iterable[str], count: int = 1) -> str:
    """Return a question with the likely names, at most `count`. Empty if no name is near."""
    near = near_names(wrong, names)[:count]
    return f"Did you mean {' or '.join(near)}?" if near else ""


def how_to_install(extra: str) -> str:
    """Return what to type to install an extra of this package."""
    return f"pip install 'zenoh-car-fleet[{extra}]' (from a clone: pip install '.[{extra}]')"

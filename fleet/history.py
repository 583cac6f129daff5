"""What gateways still know of the past: how it is asked for, and what is said when they know less than was asked."""

import itertools
from collections.abc import Iterable
from datetime import datetime
from typing import Final

from fleet.readings import Reading
from schemas import topics

ANSWER_S: Final = 10.0
"""How long the whole history of many cars may take."""
LONGEST_S: Final = 7 * 86_400.0


def selector(written: str, *, last: int | None = None, since_s: float | None = None) -> str:
    """The query for the last so many values of each key, or of the last so many seconds; raises ValueError."""
    if last is None and since_s is None:
        raise ValueError("a history needs last (how many), since_s (how far back), or both")
    if last is not None and last < 1:
        raise ValueError(f"last {last} is not allowed: a whole number from 1 on")
    if since_s is not None and not 0 < since_s <= LONGEST_S:
        raise ValueError(f"since_s {since_s:g} is not allowed: more than 0 and at most {LONGEST_S:g} s")
    asked = [] if since_s is None else [f"_time=[now(-{since_s:f}s)..]"]
    return f"{written}?{';'.join(asked + ([] if last is None else [f'last={last}']))}"


def shortfalls(
    readings: Iterable[Reading], now: datetime, *, last: int | None = None, since_s: float | None = None
) -> list[str]:
    """For each key (readings sorted by key) of which less came than was asked, why, if it is known; states at once."""
    said, states = [], 0
    for key, group in itertools.groupby(readings, key=lambda reading: reading.key):
        found, topic = list(group), topics.of_key(key)
        if topic is None or topic.kept <= 1:
            states += topic is not None
            continue
        keeps = f"its gateway keeps the last {topic.kept}"
        oldest_s = found[0].age_s(now)
        full = len(found) >= topic.kept
        if since_s is not None:
            if full and oldest_s < since_s and (last is None or last > topic.kept):
                said.append(f"{key}: goes back {oldest_s:.1f} s of {since_s:g} s, {keeps}")
        elif last is not None and len(found) < last:
            more = keeps if full else "its gateway has had no more"
            said.append(f"{key}: {len(found)} of {last}, {more}")
    if states and last != 1:
        said.append("of states gateways keep only the latest; a recording has all (fleet record)")
    return said


def without_history(under: Iterable[topics.Topic]) -> str:
    """Why nothing can be asked of the past of these topics; empty if something can, or if there are none."""
    listed = list(under)
    if not listed or any(topic.kept for topic in listed):
        return ""
    names = ", ".join(topic.name for topic in listed)
    return f"gateways keep no history of {names}, only of sensor/*; a recording has everything (fleet record)"

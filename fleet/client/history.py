"""What gateways still know of the past: how it is asked for, and what is said when they know less than was asked."""

import itertools
from collections.abc import Iterable
from datetime import datetime
from typing import Final

from fleet.client.reading import Reading
from schemas import topics

ANSWER_S: Final = 10.0
"""How long the whole history of many cars may take."""
TRIES: Final = 4
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


def united(earlier: Iterable[Reading], more: Iterable[Reading], last: int | None = None) -> list[Reading]:
    """The readings of two answers to one question: sorted by key, each key's oldest first, at most its `last`.

    Answers are dropped where a link has no room for them (a blocked gateway would be worse): who sees a gap asks again.
    """
    boots: dict[str, int] = {}
    found: dict[tuple[str, int, int], Reading] = {}
    for reading in (*earlier, *more):
        boot = boots.setdefault(reading.value.boot_id, len(boots))
        found[(reading.key, boot, reading.value.seq)] = reading
    ordered = [found[place] for place in sorted(found)]
    if last is None:
        return ordered
    groups = itertools.groupby(ordered, key=lambda reading: reading.key)
    return [reading for _, group in groups for reading in list(group)[-last:]]


def gaps(readings: Iterable[Reading]) -> dict[str, int]:
    """How many are missing between the readings of each key (sorted as `united` does), where some are."""
    missing: dict[str, int] = {}
    for one, other in itertools.pairwise(readings):
        if (one.key, one.value.boot_id) == (other.key, other.value.boot_id):
            lost = other.value.seq - one.value.seq - 1
            if lost > 0:
                missing[one.key] = missing.get(one.key, 0) + lost
    return missing


def shortfalls(
    readings: Iterable[Reading], now: datetime, *, last: int | None = None, since_s: float | None = None
) -> list[str]:
    """For each key (readings sorted by key) of which less came than was asked, why, if it is known; states at once."""
    said, states = [], 0
    every = list(readings)
    said += [f"{key}: {count} in between were lost on the way, ask again" for key, count in gaps(every).items()]
    for key, group in itertools.groupby(every, key=lambda reading: reading.key):
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

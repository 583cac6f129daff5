"""The history of readings that gateways store: queries, merged answers, and words about missing values."""

import itertools
from collections.abc import Iterable
from datetime import datetime
from typing import Final

from fleet.client.reading import Reading
from schemas import topics

HISTORY_TIMEOUT_S: Final = 10.0
"""Timeout for the history of many cars."""
MAX_HISTORY_QUERIES: Final = 4
"""Maximum number of queries for one history. A query is repeated if values were lost on the way."""
MAX_HISTORY_S: Final = 7 * 86_400.0
"""Maximum of `since_s`: a week."""


def selector(key_expression: str, *, last: int | None = None, since_s: float | None = None) -> str:
    """Return the selector for the last `last` values of each key, for the last `since_s` seconds, or for both.

    Raises ValueError for values out of range.
    """
    if last is None and since_s is None:
        raise ValueError("a history needs last (how many), since_s (how far back), or both")
    if last is not None and (isinstance(last, bool) or not hasattr(last, "__index__") or last < 1):
        raise ValueError(f"last {last} is not allowed: it must be a whole number, at least 1")
    if since_s is not None and not 0 < since_s <= MAX_HISTORY_S:
        raise ValueError(f"since_s {since_s:g} is not allowed: more than 0 and at most {MAX_HISTORY_S:g} s")
    parameters = [] if since_s is None else [f"_time=[now(-{since_s:f}s)..]"]
    return f"{key_expression}?{';'.join(parameters + ([] if last is None else [f'last={last}']))}"


def merge(earlier: Iterable[Reading], more: Iterable[Reading], last: int | None = None) -> list[Reading]:
    """Merge the readings of two answers. Return at most the last `last` of each key, sorted by key, boot and number."""
    # If a link's queue is full, a gateway drops answers and does not block. So a client that finds gaps queries again.
    # Number the boots (runs of a gateway) in the order of arrival, because their ids are random.
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
    """Return the number of missing readings for each key that has gaps.

    The readings must be sorted as `merge` sorts.
    """
    missing: dict[str, int] = {}
    for one, other in itertools.pairwise(readings):
        if (one.key, one.value.boot_id) == (other.key, other.value.boot_id):
            lost = other.value.seq - one.value.seq - 1
            if lost > 0:
                missing[one.key] = missing.get(one.key, 0) + lost
    return missing


def describe_shortfalls(
    readings: Iterable[Reading], now: datetime, *, last: int | None = None, since_s: float | None = None
) -> list[str]:
    """Describe why there are fewer readings than requested.

    At most two lines for each key with a history, and one line for all states together.
    readings: sorted as `merge` sorts.
    """
    every, has_states = list(readings), False
    lines = [f"{key}: {count} values are missing, lost on the way. Try again." for key, count in gaps(every).items()]
    for key, group in itertools.groupby(every, key=lambda reading: reading.key):
        found, topic = list(group), topics.of_key(key)
        if topic is None:
            continue
        if topic.history_size <= 1:
            has_states = True
            continue
        keeps = f"its gateway keeps only the last {topic.history_size} values"
        oldest_s = found[0].age_s(now)
        full = len(found) >= topic.history_size
        if since_s is not None:
            if full and oldest_s < since_s and (last is None or last > topic.history_size):
                lines.append(f"{key}: only the last {oldest_s:.1f} s of {since_s:g} s, because {keeps}")
        elif last is not None and len(found) < last:
            why = keeps if full else "its gateway has no more"
            lines.append(f"{key}: {len(found)} of {last}, because {why}")
    if has_states and last != 1:
        lines.append("Gateways keep only the latest value of a state. A recording has all values (`fleet record`).")
    return lines


def describe_missing_history(matched: Iterable[topics.Topic]) -> str:
    """Describe why these topics have no history.

    Return an empty string if at least one of them has a history, or if there are no topics.
    """
    listed = list(matched)
    if not listed or any(topic.history_size for topic in listed):
        return ""
    names = ", ".join(topic.name for topic in listed)
    return f"Gateways keep no history of {names}, only of sensor/*. A recording has everything (`fleet record`)."

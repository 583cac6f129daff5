"""Puts recorded messages into the order in which they were published. Pure.

The order in the file is the order of receiving. It may differ, because a recorder that was away gets the missed
messages later from their publishers. Stamps alone do not show the order, either: if somebody sets the clock of a
computer back by an hour, two hours have the same stamps. But each publisher numbers its messages. If the numbers go up
and the stamps go back, the clock was set back. Each key shows such a step at its next message. So a step lies between
two times of receiving, and the smallest set of steps that explains all keys is taken as the true one. Between two steps
the stamps show the order. It is not known on which side of a step a message lies if its key was silent for longer than
the clock was set back, or if the recorder was away.
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Final, Generic, TypeVar

from msgspec import Struct

from fleet.conditions.holding import CLOCK_STEP_S

_CLOCK_STEP_NS: Final = round(CLOCK_STEP_S * 1e9)
_SAME_CLOCK_NS: Final = 1_000_000_000
"""Maximum difference of two clocks that count as one."""
Item = TypeVar("Item")


class RecordedMessage(Struct, Generic[Item], frozen=True):
    """A recorded message. Times: ns since the epoch."""

    log_ns: int
    """When it was received."""
    at_ns: int
    """The stamp in the message."""
    stream: tuple[str, str]
    """The key of the message, and the boot id of the publisher that numbered it."""
    number: int
    item: Item


def as_published(messages: Iterable[RecordedMessage[Item]]) -> Iterator[tuple[int, RecordedMessage[Item]]]:
    """Yield the messages of one computer in the order in which they were published.

    Each message comes with a number of ns by which the recorder's clock was ahead of its stamp. This is the lead of the
    fastest message between two steps, or 0 if it is not larger than network delay and NTP explain.
    """
    streams: defaultdict[tuple[str, str], list[RecordedMessage[Item]]] = defaultdict(list)
    for each in messages:
        streams[each.stream].append(each)
    keys: defaultdict[str, list[tuple[int, RecordedMessage[Item]]]] = defaultdict(list)
    for (key, _), stream in streams.items():
        stream.sort(key=lambda each: each.number)
        keys[key] += zip(_received_at_latest(stream), stream, strict=True)
    bounds = [bound for key in keys.values() for bound in _steps_between(sorted(key, key=lambda each: each[0]))]
    steps: list[int] = []
    for first_ns, last_ns in sorted(bounds, key=lambda bound: bound[1]):
        if not steps or steps[-1] <= first_ns:
            steps.append(last_ns)
    every = [(bisect_right(steps, latest_ns), each) for key in keys.values() for latest_ns, each in key]
    ahead: dict[int, int] = {}
    for era, each in every:
        ahead[era] = min(ahead.get(era, each.log_ns - each.at_ns), each.log_ns - each.at_ns)
    ahead = {era: shift if abs(shift) > _SAME_CLOCK_NS else 0 for era, shift in ahead.items()}
    for era, each in sorted(every, key=lambda one: (one[0], one[1].at_ns)):
        yield ahead[era], each


def _received_at_latest(stream: list[RecordedMessage[Item]]) -> list[int]:
    """Return when each message, or one with a higher number, was first received. `stream` is sorted by number."""
    found, latest_ns = [], stream[-1].log_ns
    for each in reversed(stream):
        latest_ns = min(latest_ns, each.log_ns)
        found.append(latest_ns)
    return found[::-1]


def _steps_between(key: list[tuple[int, RecordedMessage[Item]]]) -> Iterable[tuple[int, int]]:
    """Yield the pairs of receive times between which the clock was set back. `key`: messages in publishing order."""
    for (before_ns, before), (latest_ns, each) in pairwise(key):
        if each.at_ns < before.at_ns - _CLOCK_STEP_NS:
            yield before_ns, latest_ns

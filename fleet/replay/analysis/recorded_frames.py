"""What a session recorded of cars' wires: frames both ways, what became of them, and what was known of the car then.

In the order of the gateway's stamps, car by car, and bounded: states overtake readings on the bus. Nothing is decoded.
"""

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from fleet.recording.reading.session import Recorded
from gateway.protocol.enums import Mode
from schemas import keys, messages
from schemas.topics import TOPICS

SENSORS: Final = tuple(name for name, topic in TOPICS.items() if topic.family == "sensor")
KEYS: Final = ("*/*/frame/*", "*/*/sensor/*", "*/*/state/mode", "*/*/state/health")
SLACK_NS: Final = 10_000_000_000
"""So long, on the recorder's clock, a message may be late: after an outage of the bus what was kept comes at once."""
_MODES: Final = frozenset(map(str, Mode))
_HEADER: Final = frozenset({"stamp", "car", "seq", "boot_id"})

Readings = Mapping[str, Mapping[str, Any]]
"""Fields by topic, as in the messages; what was not measured is left out."""


@dataclass(slots=True)
class Rx:
    """Bytes from a car, and what they were taken for."""

    at_ns: int
    data: bytes
    verdict: str
    published: tuple[str, ...] = ()
    readings: Readings = field(default_factory=dict)
    """Those of `published` that are there."""


@dataclass(frozen=True, slots=True)
class Tx:
    """Bytes to a car."""

    at_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Confirmed:
    """The mode that the car was known to be in from now on; None: not known."""

    at_ns: int
    mode: Mode | None


@dataclass(frozen=True, slots=True)
class Treated:
    """The platform that the car was treated as from now on."""

    at_ns: int
    platform: str


Item = Rx | Tx | Confirmed | Treated


@dataclass(slots=True)
class Unread:
    """What could not be used, by key."""

    broken: dict[str, int] = field(default_factory=dict)
    """Messages that do not parse as what they say they are."""
    unframed: int = 0
    """Readings without a raw frame: it was not recorded, or the gateway published no more of them at that moment."""


def of_session(recorded: Iterable[Recorded], unread: Unread) -> Iterator[tuple[str, Item]]:
    """(Car, item), in the order of their stamps."""
    waiting: dict[tuple[str, str, int], deque[Mapping[str, Any]]] = {}
    for key, value, at_ns in _in_order(recorded, unread):
        match key.topic:
            case "frame/tx":
                yield key.car, Tx(at_ns, value.data)
            case "frame/rx":
                published = tuple(value.published)
                readings = {}
                for topic in published:
                    if (found := waiting.get((key.car, topic, at_ns))) is not None:
                        readings[topic] = found.popleft()
                        if not found:
                            del waiting[key.car, topic, at_ns]
                yield key.car, Rx(at_ns, value.data, value.verdict, published, readings)
            case "state/mode":
                sure = value.verdict == "confirmed" and value.asked in _MODES
                yield key.car, Confirmed(at_ns, Mode(value.asked) if sure else None)
            case "state/health":
                yield key.car, Treated(at_ns, value.platform)
            case _:
                waiting.setdefault((key.car, key.topic, at_ns), deque()).append(fields_of(value))
                if len(waiting) > 1 << 16:  # of gateways whose frames are not here at all
                    unread.unframed += len(waiting.pop(next(iter(waiting))))
    unread.unframed += sum(map(len, waiting.values()))


def fields_of(message: Any) -> dict[str, Any]:
    """What a message says, without its header; lists as tuples, and what was not measured left out."""
    there = {descriptor.name for descriptor, _ in message.ListFields()}
    found = {}
    for each in message.DESCRIPTOR.fields:
        if each.name not in _HEADER and (not each.has_presence or each.name in there):
            value = getattr(message, each.name)
            found[each.name] = tuple(value) if each.is_repeated else value
    return found


def _in_order(recorded: Iterable[Recorded], unread: Unread) -> Iterator[tuple[keys.Key, Any, int]]:
    """Messages by their stamp; of equal stamps readings before their frame, and as they were recorded."""
    heap: list[tuple[int, bool, int, keys.Key, Any]] = []
    for number, one in enumerate(recorded):
        key = keys.parse(one.key)
        if key is None or (topic := TOPICS.get(key.topic)) is None or topic.message != one.message:
            continue
        try:
            value: Any = messages.parse(one.message, one.payload, topic.encoding)
        except messages.BadPayload:
            unread.broken[one.key] = unread.broken.get(one.key, 0) + 1
            continue
        at_ns = value.stamp.seconds * 1_000_000_000 + value.stamp.nanos
        heapq.heappush(heap, (at_ns, topic.family != "sensor", number, key, value))
        while heap and heap[0][0] < one.recorded_ns - SLACK_NS:
            at_ns, _, _, key, value = heapq.heappop(heap)
            yield key, value, at_ns
    while heap:
        at_ns, _, _, key, value = heapq.heappop(heap)
        yield key, value, at_ns

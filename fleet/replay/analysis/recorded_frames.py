"""Extracts the raw frames of a session in both directions, with their readings and the known mode and platform.

Decodes nothing. The items are in the order of the gateway's stamps, because states may overtake readings on the bus.
Only a message that came very late is out of order (`SORTED_NS`). Memory is bounded.
"""

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from msgspec import Struct, field

from fleet.recording.reading.session import Recorded
from schemas import keys, messages
from schemas.topics import TOPICS
from schemas.words import Mode, Verdict

FRAME_KEYS: Final = ("*/*/frame/*", "*/*/sensor/*", "*/*/state/mode", "*/*/state/health")
SORTED_NS: Final = 10_000_000_000
"""How long a message waits, by the recorder's clock, for others with earlier stamps. After an outage of the bus, cached
messages come that late, all together. The gateway's own clock may be wrong, so it does not count here."""
_MODE_NAMES: Final = frozenset(map(str, Mode))
_HEADER_FIELDS: Final = frozenset({"stamp", "car", "seq", "boot_id"})

Readings = Mapping[str, Mapping[str, Any]]
"""Fields by topic, without values that were not measured."""


class Rx(Struct):
    """Bytes from a car, with the verdict of the decoder on them and the readings that were recorded for them."""

    at_ns: int
    data: bytes
    verdict: str
    published: tuple[str, ...] = ()
    readings: Readings = field(default_factory=dict)
    """Recorded readings of the topics in `published`."""


class Tx(Struct, frozen=True):
    """Bytes to a car."""

    at_ns: int
    data: bytes


class KnownMode(Struct, frozen=True):
    """The mode of the car from this time on, or None if it is unknown."""

    at_ns: int
    mode: Mode | None


class KnownPlatform(Struct, frozen=True):
    """Platform of the car from this time on."""

    at_ns: int
    platform: str


Item = Rx | Tx | KnownMode | KnownPlatform


class SkippedMessages(Struct):
    """Counts of messages that could not be used."""

    broken: dict[str, int] = field(default_factory=dict)
    """Number of messages that do not match their type, by key."""
    unframed: int = 0
    """Readings without their raw frame: it was not recorded, or it exceeded the rate limit of the gateway."""


def of_session(recorded: Iterable[Recorded], skipped: SkippedMessages) -> Iterator[tuple[str, Item]]:
    """Yield (car, item) in the order of their stamps."""
    waiting: dict[tuple[str, str, int], deque[Mapping[str, Any]]] = {}
    for key, value, at_ns in _sort_by_stamp(recorded, skipped):
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
                sure = value.verdict == Verdict.CONFIRMED and value.asked in _MODE_NAMES
                yield key.car, KnownMode(at_ns, Mode(value.asked) if sure else None)
            case "state/health":
                yield key.car, KnownPlatform(at_ns, value.platform)
            case _:
                waiting.setdefault((key.car, key.topic, at_ns), deque()).append(fields_of(value))
                if len(waiting) > 1 << 16:  # from gateways without any recorded frame
                    skipped.unframed += len(waiting.pop(next(iter(waiting))))
    skipped.unframed += sum(map(len, waiting.values()))


def fields_of(message: Any) -> dict[str, Any]:
    """Return the fields of a message without its header and without values that were not measured.

    Lists become tuples.
    """
    present = {descriptor.name for descriptor, _ in message.ListFields()}
    found = {}
    for each in message.DESCRIPTOR.fields:
        if each.name not in _HEADER_FIELDS and (not each.has_presence or each.name in present):
            value = getattr(message, each.name)
            found[each.name] = tuple(value) if each.is_repeated else value
    return found


def _sort_by_stamp(recorded: Iterable[Recorded], skipped: SkippedMessages) -> Iterator[tuple[keys.Key, Any, int]]:
    """Yield messages by stamp. At equal stamps, readings come first, and all else keeps its recorded order."""
    heap: list[tuple[int, bool, int, int, keys.Key, Any]] = []
    for number, message in enumerate(recorded):
        key = keys.parse(message.key)
        if key is None or (topic := TOPICS.get(key.topic)) is None or topic.message != message.message:
            continue
        try:
            value: Any = messages.parse(message.message, message.payload, topic.encoding)
        except messages.BadPayload:
            skipped.broken[message.key] = skipped.broken.get(message.key, 0) + 1
            continue
        at_ns = messages.stamp_ns(value.stamp)
        heapq.heappush(heap, (at_ns, topic.family != "sensor", number, message.recorded_ns, key, value))
        while heap[0][3] < message.recorded_ns - SORTED_NS:
            at_ns, _, _, _, key, value = heapq.heappop(heap)
            yield key, value, at_ns
    while heap:
        at_ns, _, _, _, key, value = heapq.heappop(heap)
        yield key, value, at_ns

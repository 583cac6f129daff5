"""Test vector files: the raw frames of one car for some time, and the readings that a decoder must make of them.

Such a file is a text file with one JSON object per line. The first line names the source. Each other line is an item
with `at_us`, microseconds since the beginning. Items from before the beginning have a negative time:

    {"format": 1, "source": "...", "car": "red", "began": "2026-03-14T15:16:17.000Z"}
    {"at_us": -400000, "platform": "arduino"}      the platform of the car from now on
    {"at_us": -20000, "mode": "tracking"}          the confirmed mode from now on; null: none
    {"at_us": 1200, "tx": "$1,0,0,0,0,0,0,0,0#"}   bytes to the car, each a character of ISO 8859-1
    {"at_us": 51000, "rx": "$4WD,...#", "verdict": "sensors", "readings": {"sensor/line": {"left_outer": false, ...}}}
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from fleet.recording import time_spec
from fleet.replay.analysis.recorded_frames import Item, KnownMode, KnownPlatform, Rx, Tx
from gateway.drivers.yahboom.protocol.frame_splitter import ECHO_S
from schemas.words import Mode

ENDING: Final = ".jsonl"
FORMAT: Final = 1
BEFORE_NS: Final = 3_000_000_000
"""Time before a vector in which to look for the states at its beginning. Gateways publish them once a second."""
_ESTIMATED: Final = frozenset({"charge", "charge_error", "level"})
"""Fields that the gateway adds to the decoded ones."""


class BadVector(Exception):
    """The file is not a vector. The message names the file, the line and the fault."""


def select_range(items: Iterable[Item], start_ns: int, end_ns: int | None) -> Iterator[Item]:
    """Yield the known mode and platform at the start of a time range, then its frames.

    Also yield frames to the car from just before, because their echoes may be in the range. The items are in order and
    begin `BEFORE_NS` before the range.
    """
    known: dict[type, Item] = {}
    is_inside = False
    for item in items:
        if end_ns is not None and item.at_ns >= end_ns and isinstance(item, Rx | Tx):
            continue  # states are published later than the frames that they describe, so they are still wanted
        if item.at_ns < start_ns:
            if isinstance(item, Tx) and item.at_ns >= start_ns - ECHO_S * 1e9:
                yield item
            elif isinstance(item, KnownMode | KnownPlatform):
                known[type(item)] = item
            continue
        if not is_inside:
            is_inside = True
            yield from known.values()
        yield item
    if not is_inside:
        yield from known.values()


def lines(items: Iterable[Item], start_ns: int, car: str, source: str) -> Iterator[str]:
    """Yield the lines of a test vector."""
    head = {"format": FORMAT, "source": source, "car": car, "began": time_spec.iso(start_ns)}
    yield json.dumps(head)
    before: dict[type, Any] = {}
    for item in sorted(items, key=lambda item: item.at_ns):
        content = _as_json(item)
        if isinstance(item, KnownMode | KnownPlatform):
            if before.get(type(item)) == content:
                continue  # published once a second; only a change matters
            before[type(item)] = content
        yield json.dumps({"at_us": (item.at_ns - start_ns) // 1000, **content})


def _as_json(item: Item) -> dict[str, Any]:
    match item:
        case KnownPlatform():
            return {"platform": item.platform}
        case KnownMode():
            return {"mode": item.mode}
        case Tx():
            return {"tx": item.data.decode("latin-1")}
        case Rx():
            readings = {
                topic: {name: value for name, value in fields.items() if name not in _ESTIMATED}
                for topic, fields in item.readings.items()
            }
            content = {"rx": item.data.decode("latin-1"), "verdict": item.verdict, "readings": readings}
            return content if set(item.published) == set(readings) else {**content, "published": list(item.published)}


def read(path: Path) -> tuple[str, list[Item]]:
    """Return the car and the items of a vector. Raises BadVector and OSError."""
    objects = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            objects.append((number, json.loads(line)))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise BadVector(f"{path}, line {len(objects) + 1}: this is not JSON in UTF-8: {error}") from None
    head = objects[0][1] if objects else None
    if not isinstance(head, dict) or not isinstance(head.get("format"), int) or not isinstance(head.get("car"), str):
        raise BadVector(
            f"{path} is not a vector: its first line lacks format and car. `fleet sessions vector` makes one."
        )
    if head["format"] > FORMAT:
        raise BadVector(f"{path} has format {head['format']}. This version reads up to {FORMAT}: update it.")
    items = []
    for number, each in objects[1:]:
        try:
            items.append(_item(each))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise BadVector(f"{path}, line {number}: {type(error).__name__}: {error}") from None
    return head["car"], items


def _item(content: Mapping[str, Any]) -> Item:
    at_ns = int(content["at_us"]) * 1000
    if "platform" in content:
        return KnownPlatform(at_ns, str(content["platform"]))
    if "mode" in content:
        return KnownMode(at_ns, None if content["mode"] is None else Mode(content["mode"]))
    if "tx" in content:
        return Tx(at_ns, content["tx"].encode("latin-1"))
    readings = {
        topic: {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
        for topic, fields in content["readings"].items()
    }
    published = tuple(content.get("published", readings))
    return Rx(at_ns, content["rx"].encode("latin-1"), str(content["verdict"]), published, readings)

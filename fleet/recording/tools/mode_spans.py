"""Finds when cars were in a mode in which a reading does not exist, from their `state/mode`. Pure.

In most modes, a car sends few readings or none (docs/reference/modes.md#what-a-car-reports-in-a-mode). In obstacle
avoidance, it measures the distance, but does not send it. So a table of distances has no rows at all from this mode,
and nobody would notice that they are missing.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from gateway import drivers
from schemas.topics import FROM_OUTSIDE, TOPICS
from schemas.words import UNKNOWN, Mode, Verdict

MODE_TOPIC: Final = TOPICS["state/mode"]
assert MODE_TOPIC.stale_after_s is not None
_HOLDS_NS: Final = round(MODE_TOPIC.stale_after_s * 1e9)
"""A state lasts until the next one, but not longer than until it is stale. The last state of a car has no length."""


class ModeSpan(Struct, frozen=True):
    """A time during which a car was in one mode. Times: ns since the epoch, of the publisher's clock."""

    car: str
    mode: Mode
    begin_ns: int
    end_ns: int


def sensor_of(name: str) -> str:
    """Return the sensor that a topic, a message or a key names, such as `range`.

    Empty if it does not name one sensor.
    """
    for topic in TOPICS.values():
        messages = (topic.message, topic.message.rpartition(".")[2])
        if topic.family == "sensor" and (name in messages or f"/{name}".endswith(f"/{topic.name}")):
            return topic.name.partition("/")[2]
    return ""


def does_exist(sensor: str, mode: Mode) -> bool:
    """Return True if cars send readings of this sensor in this mode. Manual mode counts as True for every sensor."""
    return mode is Mode.MANUAL or f"sensor/{sensor}" in FROM_OUTSIDE or _is_measurable(sensor, mode)


def _is_measurable(sensor: str, mode: Mode) -> bool:
    return any(sensor in profile.measurable(mode) for profile in drivers.all_profiles())


def mode_spans(states: Iterable[Mapping[str, Any]]) -> Iterator[ModeSpan]:
    """Yield the spans of each car, from rows of `state/mode` sorted by publish_time.

    The mode is the commanded one or, if the car's readings contradict it, the one that they show. Unknown modes have no
    span.
    """
    current: dict[str, ModeSpan] = {}
    for state in states:
        car, at_ns = state["car"], state["publish_time"]
        before, mode = current.get(car), _mode(state)
        held = None if before is None else replace(before, end_ns=min(at_ns, before.end_ns + _HOLDS_NS))
        if held is not None and held.mode is mode and held.end_ns == at_ns:
            current[car] = held
            continue
        if held is not None:
            yield held
        if mode is None:
            current.pop(car, None)
        else:
            current[car] = ModeSpan(car, mode, at_ns, at_ns)
    yield from current.values()


def spans_without(sensor: str, states: Iterable[Mapping[str, Any]]) -> list[ModeSpan]:
    """Return the spans in which a reading of a sensor does not exist, sorted by car and time."""
    found = [span for span in mode_spans(states) if not does_exist(sensor, span.mode) and span.end_ns > span.begin_ns]
    return sorted(found, key=lambda span: (span.car, span.begin_ns))


def describe_spans(sensor: str, spans: Iterable[ModeSpan]) -> str:
    """Return on one line how long which car was in a mode without this reading. Empty if there is none."""
    lengths: dict[tuple[str, Mode], int] = {}
    for span in spans:
        place = (span.car, span.mode)
        lengths[place] = lengths.get(place, 0) + span.end_ns - span.begin_ns
    told = ", ".join(f"{car} {length / 1e9:.1f} s in {mode}" for (car, mode), length in lengths.items())
    return told and f"sensor/{sensor} does not exist in some modes, and has no rows from there: {told}"


def _mode(state: Mapping[str, Any]) -> Mode | None:
    word = state["inferred"] if state["verdict"] == Verdict.CONTRADICTED else state["asked"]
    return Mode(word) if word != UNKNOWN and word in tuple(Mode) else None

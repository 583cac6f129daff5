"""Finds the times to pin in the messages as they come: conditions of the fleet file, and stops. Pure.

Conditions are evaluated as in `fleet find`: the same evaluator gets the same readings with their own times. Pins are on
the recorder's clock, like its files. So a pin lies around the moment at which the reading came. A backfilled reading
came late and is in a later file. So its pin lies around the reading's own time, and lasts until the reading came.

A STOP of all cars is one command with one id, which each gateway reports. So it is recognized when a second car reports
it, or the only car if there are no others.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, Final

from google.protobuf.message import DecodeError
from msgspec.structs import replace

from fleet.fleetfile.fleet_file import PinRule
from fleet.policy.car_condition import CarCondition
from fleet.policy.snapshot import topic_of
from fleet.recording.pins import Pin, minute_of
from fleet.recording.stop_count import MAX_RECENT_IDS, stops_cars
from fleet.recording.tools.car_timeline import message_time_ns
from fleet.recording.tools.stop_findings import asked_by, failed_stop_code
from schemas import keys, messages
from schemas.commands import Verb
from schemas.topics import TOPICS
from schemas.words import PinCause

_EVENTS: Final = ("event/command", "event/log")


class ConditionPins:
    """The pins of conditions, from readings in the order of their times. Readings out of order do not count."""

    def __init__(self, rules: Sequence[PinRule]) -> None:
        self._rules = rules
        self._cars: dict[str, list[CarCondition]] = {}
        """The conditions of the rules, by car."""
        self.topics: Collection[str] = {topic_of(name) for rule in rules for name in rule.condition.names}
        """The topics that the conditions use."""

    def add(self, car: str, topic: str, message: Any, at_ns: int, came_ns: int) -> Iterable[Pin]:
        """Evaluate a reading, and yield pins.

        `at_ns` is its own time, `came_ns` the recorder's time at which it came.
        """
        if car not in self._cars:
            self._cars[car] = [CarCondition(rule.condition) for rule in self._rules]
        for rule, condition in zip(self._rules, self._cars[car], strict=True):
            if topic not in condition.topics or condition.add(topic, message, at_ns) is None:
                continue
            if (span := condition.span) is not None:
                begin_ns = came_ns - max(at_ns - span.begin_ns, 0) - round(rule.before_s * 1e9)
                end_ns = came_ns + round(rule.after_s * 1e9)
                yield Pin(begin_ns, end_ns, PinCause.CONDITION, str(rule.condition), (car,))


class PinWatch:
    """The pins of a recording, from its messages."""

    def __init__(self, rules: Sequence[PinRule] = ()) -> None:
        self._rules = rules
        self._conditions = ConditionPins(rules)
        self._keys: dict[str, tuple[str, str] | None] = {}
        """Car and topic of each key, or None if the key is not watched."""
        self._cars: set[str] = set()
        self._stopped: dict[str, set[str]] = {}
        """The cars that each stop has reached, by its id."""

    def is_watched(self, key: str) -> bool:
        """Return True if messages on this key can pin anything."""
        try:
            return self._keys[key] is not None
        except KeyError:
            parsed = keys.parse(key)
            is_of_car = parsed is not None and not parsed.car.startswith("@")
            if parsed is not None and is_of_car:
                self._cars.add(parsed.car)
            wanted = parsed is not None and is_of_car and parsed.topic in (*_EVENTS, *self._conditions.topics)
            self._keys[key] = (parsed.car, parsed.topic) if parsed is not None and wanted else None
            return wanted

    def add(self, key: str, encoding: str, payload: bytes, published_ns: int, came_ns: int) -> list[Pin]:
        """Evaluate a message that came just now, and return its pins."""
        return self._add(self._conditions, key, encoding, payload, published_ns, came_ns)

    def add_late(self, batch: Iterable[tuple[int, str, str, bytes]], came_ns: int) -> Iterator[Pin]:
        """Evaluate backfilled messages (time, key, encoding, payload), and yield their pins.

        Conditions get only these messages, in the order of their times.
        """
        late = ConditionPins(self._rules)
        for published_ns, key, encoding, payload in sorted(batch):
            for pin in self._add(late, key, encoding, payload, published_ns, published_ns):
                yield replace(pin, end_ns=max(pin.end_ns, came_ns))

    def _add(
        self, conditions: ConditionPins, key: str, encoding: str, payload: bytes, published_ns: int, came_ns: int
    ) -> list[Pin]:
        if not self.is_watched(key) or (place := self._keys[key]) is None:
            return []
        car, topic = place
        if messages.name_in(encoding) != TOPICS[topic].message:
            return []  # any program can publish there
        try:
            message: Any = messages.message_class(TOPICS[topic].message).FromString(payload)
        except DecodeError:
            return []
        if topic in _EVENTS:
            return [minute_of(came_ns, cause, words, cars) for cause, words, cars in self._stops(car, topic, message)]
        return list(conditions.add(car, topic, message, message_time_ns(message, published_ns), came_ns))

    def _stops(self, car: str, topic: str, message: Any) -> Iterable[tuple[PinCause, str, Collection[str]]]:
        if failed_stop_code(topic, message):
            words = message.message if topic == "event/log" else message.words or message.reason
            yield PinCause.NOT_SHOWN, words, (car,)
        if topic != "event/command" or not stops_cars(message):
            return
        words = asked_by(message)
        if message.verb == Verb.ESTOP:
            yield PinCause.ESTOP, words, (car,)
        elif message.id:
            reached = self._stopped.setdefault(message.id, set())
            reached.add(car)
            if len(self._stopped) > MAX_RECENT_IDS:
                del self._stopped[next(iter(self._stopped))]
            if len(reached) > 1 or reached >= self._cars:
                yield PinCause.STOP_ALL, words, sorted(reached)

"""The keys that are alive, each with type, units, rate and age: from what was published for a while. No Zenoh here.

A key is alive while its gateway or service is on the bus. A rate is counted by the publisher's own numbers between the
first and the newest message of the time that was looked at, so that it does not suffer from messages that were missed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from fleet.client.reading import Reading
from schemas import keys, topics

LOOK_S: Final = 2.5
"""How long publications are watched: states and most readings come once a second."""
SERVICES: Final = (keys.COORDINATOR, keys.RECORDER)


@dataclass(frozen=True, slots=True)
class KeyInfo:
    """One key."""

    key: str
    topic: topics.Topic | None
    """None: a key that is not of this fleet's table."""
    rate_hz: float | None = None
    """None: fewer than two came while it was looked at."""
    age_s: float | None = None
    """Of its newest value; None: none is known."""
    stale: bool = False

    @property
    def units(self) -> list[str]:
        """The units of its fields, each once."""
        if self.topic is None:
            return []
        return [unit for unit in dict.fromkeys(self.topic.units.values()) if unit != "1"]


class KeySurvey:
    """Takes readings in any order and says what is alive."""

    def __init__(self, look_s: float = LOOK_S) -> None:
        self._look_s = look_s
        self._first: dict[str, Reading] = {}
        self._newest: dict[str, Reading] = {}

    def take(self, reading: Reading, now: datetime) -> None:
        """A value that was there already, or has just come."""
        if reading.age_s(now) <= self._look_s:
            first = self._first.get(reading.key)
            if first is None or reading.time < first.time or _restarted(first, reading):
                self._first[reading.key] = reading
        newest = self._newest.get(reading.key)
        if newest is None or reading.time >= newest.time:
            self._newest[reading.key] = reading

    def found(self, silent: Iterable[str], now: datetime) -> list[KeyInfo]:
        """Every key, sorted; `silent`: those that are alive even if nothing came."""
        return [self._one(key, now) for key in sorted({*self._newest, *silent})]

    def _one(self, key: str, now: datetime) -> KeyInfo:
        newest, first, topic = self._newest.get(key), self._first.get(key), topics.of_key(key)
        if newest is None:
            return KeyInfo(key, topic)
        rate = None
        if first is not None and newest.value.DESCRIPTOR.fields_by_name.get("seq") is not None:
            count = newest.value.seq - first.value.seq
            apart_s = (newest.time - first.time).total_seconds()
            # A few that came at once, after a change, say nothing of how many come.
            rate = count / (apart_s if apart_s >= self._look_s / 4 else self._look_s) if count > 0 else None
        return KeyInfo(key, topic, rate, newest.age_s(now), newest.stale(now))


def _restarted(first: Reading, reading: Reading) -> bool:
    """Whether another publisher counts now."""
    return bool(getattr(first.value, "boot_id", "") != getattr(reading.value, "boot_id", ""))


def spoken_of(fleet: str, cars: Iterable[str]) -> list[str]:
    """The keys that a gateway's presence makes alive whether it has something to say on them or not."""
    silent = [topic.name for topic in topics.CAR_TOPICS if topic.family in ("frame", "event")]
    return [keys.topic_key(fleet, car, name) for car in cars for name in silent]

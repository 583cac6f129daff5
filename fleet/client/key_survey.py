"""A survey of the keys in use, each with type, units, rate and age. No Zenoh here.

A key is in use while its gateway or service is on the bus. Rates are computed from the publisher's sequence numbers,
so that missed messages do not distort them.
"""

from collections.abc import Iterable
from datetime import datetime
from typing import Final

from msgspec import Struct

from fleet.client.reading import Reading
from schemas import keys, topics

SURVEY_S: Final = 2.5
"""Default duration of a survey. States and most readings come once a second."""
SURVEYED_SERVICES: Final = (keys.COORDINATOR, keys.RECORDER)


class KeyInfo(Struct, frozen=True):
    """One key."""

    key: str
    topic: topics.Topic | None
    """None if the key is in no topic of the table."""
    rate_hz: float | None = None
    """None if fewer than two messages came during the survey."""
    age_s: float | None = None
    """Age of the newest value. None if there is no value."""
    stale: bool = False

    @property
    def units(self) -> list[str]:
        """The units of the fields, without duplicates."""
        if self.topic is None:
            return []
        return [unit for unit in dict.fromkeys(self.topic.units.values()) if unit != "1"]


class KeySurvey:
    """Collects readings in any order and lists the keys in use."""

    def __init__(self, duration_s: float = SURVEY_S) -> None:
        self._duration_s = duration_s
        self._first: dict[str, Reading] = {}
        self._newest: dict[str, Reading] = {}

    def add(self, reading: Reading, now: datetime) -> None:
        """Add a reading."""
        has_number = getattr(reading.value, "seq", 0) > 0  # the answer to a query may have none
        if has_number and reading.age_s(now) <= self._duration_s:
            first = self._first.get(reading.key)
            if first is None or reading.time < first.time or _is_other_publisher(first, reading):
                self._first[reading.key] = reading
        newest = self._newest.get(reading.key)
        if newest is None or reading.time >= newest.time:
            self._newest[reading.key] = reading

    def keys(self, silent: Iterable[str], now: datetime) -> list[KeyInfo]:
        """Return every key, sorted. `silent` are keys that are in use even without a reading."""
        return [self._info(key, now) for key in sorted({*self._newest, *silent})]

    def _info(self, key: str, now: datetime) -> KeyInfo:
        newest, first, topic = self._newest.get(key), self._first.get(key), topics.of_key(key)
        if newest is None:
            return KeyInfo(key, topic)
        rate = None
        if first is not None:
            count = newest.value.seq - first.value.seq
            apart_s = (newest.time - first.time).total_seconds()
            # A short burst after a change says nothing about the rate.
            rate = count / (apart_s if apart_s >= self._duration_s / 4 else self._duration_s) if count > 0 else None
        return KeyInfo(key, topic, rate, newest.age_s(now), newest.stale(now))


def _is_other_publisher(first: Reading, reading: Reading) -> bool:
    """Return True if the two readings are of different publishers."""
    return bool(getattr(first.value, "boot_id", "") != getattr(reading.value, "boot_id", ""))


def event_keys(fleet: str, cars: Iterable[str]) -> list[str]:
    """Return the keys of events and frames. They are in use whenever the gateway is on the bus."""
    silent = [topic.name for topic in topics.CAR_TOPICS if topic.family in ("frame", "event")]
    return [keys.topic_key(fleet, car, name) for car in cars for name in silent]

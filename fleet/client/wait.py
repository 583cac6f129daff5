"""Waiting until a condition holds of a reading, or has held for a time: which one ends it, what is said if none does.

Readings and the time come in as arguments; nothing is asked here.
"""

from dataclasses import dataclass
from datetime import datetime

from fleet.client.condition import KeyCondition
from fleet.client.reading import Reading
from schemas import topics


class NotInTime(TimeoutError):
    """The condition did not hold in time; `last`: the newest reading that was seen, if any."""

    def __init__(self, words: str, last: Reading | None) -> None:
        super().__init__(words)
        self.last = last


@dataclass(slots=True)
class _LastMatch:
    """What is known of one key."""

    at: datetime
    since: datetime | None = None
    """The first of the readings of which it has held without a gap."""


class ConditionWait:
    """One condition that is waited for. `for_s`: how long its readings must agree, by their own stamps."""

    def __init__(self, condition: KeyCondition, for_s: float = 0.0) -> None:
        self._condition = condition
        self._for_s = for_s
        self._seen: dict[str, _LastMatch] = {}
        self.last: Reading | None = None
        """The newest reading of those of which the condition can be said to hold or not."""
        self._undecided: Reading | None = None

    def ends(self, reading: Reading, now: datetime) -> bool:
        """Whether this reading ends the waiting; a stale one does not, nor one older than another of its key."""
        before = self._seen.get(reading.key)
        if before is not None and reading.time < before.at:
            return False
        holds = self._condition.holds(reading)
        if holds is None:
            self._undecided = reading if self._condition.read(reading) else self._undecided
        elif self.last is None or self.last.time <= reading.time:
            self.last = reading
        seen = self._seen[reading.key] = _LastMatch(reading.time)
        if not holds or reading.stale(now):
            return False
        unbroken = before is not None and before.since is not None and not _gap(reading, before.at)
        seen.since = before.since if before is not None and unbroken else reading.time
        assert seen.since is not None
        return (reading.time - seen.since).total_seconds() >= self._for_s

    def late(self, written: str, after_s: float, now: datetime) -> NotInTime:
        """What is said when the time is over."""
        lasting = f" for {self._for_s:g} s" if self._for_s else ""
        words = f"{self._condition} did not hold{lasting} within {after_s:g} s"
        last = self.last or self._undecided
        if last is None:
            return NotInTime(f"{words}: nothing came under {written}", None)
        said = ", ".join(self._condition.read(last))
        age = f"{last.age_s(now):.1f} s ago{' (stale)' if last.stale(now) else ''}"
        return NotInTime(f"{words}: {last.key} had {said}, {age}", last)


def _gap(reading: Reading, before: datetime) -> bool:
    """Whether more time than a reading is worth lies between two of its key."""
    topic = topics.of_key(reading.key)
    worth_s = topic.stale_after_s if topic is not None else None
    return worth_s is not None and (reading.time - before).total_seconds() > worth_s

"""Waits until a condition holds for a reading, or has held for some time. Pure: readings and time are arguments."""

import math
from datetime import UTC, datetime, timedelta
from typing import Final

from msgspec import Struct

from fleet.client.condition import KeyCondition
from fleet.client.reading import Reading
from fleet.conditions import compared_in
from fleet.conditions.holding import CLOCK_STEP_S, Holding
from schemas import topics
from schemas.picklable import Picklable

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


class NotInTime(Picklable, TimeoutError):
    """The condition did not hold in time. `last` is the newest reading, if there was one."""

    def __init__(self, words: str, last: Reading | None) -> None:
        super().__init__(words)
        self.last = last


class _LastReading(Struct):
    """The newest reading of one key."""

    at: datetime
    arrived_s: float | None
    """When the reading arrived after its publication, s, monotonic. None if a query returned it."""
    message: str
    """The message's type. Messages of another type have other fields."""
    holding: Holding | None
    """Measures for how long the condition has held. None if this type lacks the condition's fields."""


class ConditionWait:
    """A wait for one condition. `for_s` is the minimum time for which it must hold, by the readings' stamps."""

    def __init__(self, condition: KeyCondition, for_s: float = 0.0) -> None:
        """Begin to wait. Raises ValueError if `for_s` is no time: with NaN, the wait would never end."""
        if not 0.0 <= for_s < math.inf:
            raise ValueError(f"for_s {for_s} is not allowed: write a number of seconds from 0, such as 2.0")
        self._condition = condition
        self._for_s = for_s
        self._seen: dict[str, _LastReading] = {}
        self.last: Reading | None = None
        """The newest reading for which the condition is decidable."""
        self._undecided: Reading | None = None

    def ends(self, reading: Reading, now: datetime, arrived_s: float | None = None) -> bool:
        """Return True if this reading ends the wait. Stale answers to a query and readings out of order do not.

        arrived_s: when it arrived after its publication, s, monotonic; None if a query returned it. The time for which
        the condition must hold begins again after a step of the wall clock or a sleep of the computer.
        """
        before = self._seen.get(reading.key)
        if before is not None and _is_other_clock(reading, before, arrived_s):
            before = None
        if before is not None and reading.time < before.at:
            return False
        message = reading.value.DESCRIPTOR.full_name
        expression = self._condition.by_message.get(message)
        if before is not None and before.message == message:
            holding = before.holding
        else:
            key = reading.key
            holding = None if expression is None else Holding(expression, lambda _: key, _stale_after_ns)
        self._seen[reading.key] = _LastReading(reading.time, arrived_s, message, holding)
        holds = None
        if holding is not None:
            holds = holding.add(reading.key, compared_in(reading.value), _ns(reading.time)).value
        if holds is None:
            self._undecided = reading if self._condition.describe_values(reading) else self._undecided
        elif self.last is None or self.last.time <= reading.time or arrived_s is not None:
            self.last = reading
        # A reading that was published just now is fresh whatever its stamp, as in `CarState`: clocks differ, and the
        # stamps of a replay are old.
        if holding is not None and arrived_s is None and reading.stale(now):
            holding.end()
        span = holding.span if holding is not None else None
        return span is not None and span.length_s >= self._for_s

    def timeout_error(self, key_expression: str, after_s: float, now: datetime) -> NotInTime:
        """Return the error for a timeout."""
        lasting = f" for {self._for_s:g} s" if self._for_s else ""
        words = f"{self._condition} did not hold{lasting} within {after_s:g} s"
        last = self.last or self._undecided
        if last is None:
            return NotInTime(f"{words}: nothing came under {key_expression}", None)
        values = ", ".join(self._condition.describe_values(last))
        age = f"{last.age_s(now):.1f} s ago{' (stale)' if last.stale(now) else ''}"
        return NotInTime(f"{words}: {last.key} had {values}, {age}", last)


def _is_other_clock(reading: Reading, before: _LastReading, arrived_s: float | None) -> bool:
    """Return True if the clock of the stamps was set between two readings."""
    stamps_s = (reading.time - before.at).total_seconds()
    if arrived_s is None:
        return False
    if before.arrived_s is None:
        return stamps_s < -CLOCK_STEP_S
    return abs(stamps_s - (arrived_s - before.arrived_s)) > CLOCK_STEP_S


def _stale_after_ns(key: str) -> int | None:
    topic = topics.of_key(key)
    limit_s = topic.stale_after_s if topic is not None else None
    return None if limit_s is None else round(limit_s * 1e9)


def _ns(time: datetime) -> int:
    return (time - _EPOCH) // timedelta(microseconds=1) * 1000

"""Measures for how long a condition has held without a gap. Pure.

`fleet wait --for` feeds `Holding` with live readings, `fleet find` feeds it with recordings.

The meaning of "for two seconds" depends on what counts as a gap. Between two readings nothing is measured, but this
time counts as long as the older value is not stale. When a value becomes stale, the condition is evaluated again
without it. If the condition is not true by the other values alone, it ended with the last reading that showed it.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

from msgspec import Struct, field

from fleet.conditions.expression import Expression, Lookup

CLOCK_STEP_S: Final = 60.0
"""Stamps and arrivals that differ by at least this time show a step of a clock, and not a network delay."""


class HeldSpan(NamedTuple):
    """A time for which a condition held: from the first to the last reading that shows it, ns since the epoch."""

    begin_ns: int
    end_ns: int

    @property
    def length_s(self) -> float:
        """Return the time from the first reading to the last one, s."""
        return (self.end_ns - self.begin_ns) / 1e9


class HeldStep(NamedTuple):
    """The changes that one reading causes."""

    value: bool | None
    """The condition now, or None if it is not decided."""
    ended: HeldSpan | None
    """The span that has ended with this reading, or before it."""
    has_begun: bool
    """True if a span begins with this reading."""


class Holding(Struct):
    """One condition over the readings of one car or key. The readings must come in the order of their times.

    source_of: the source of a name, such as its topic. stale_after_ns: how long a value of a source counts, or None for
    ever.
    """

    expression: Expression
    source_of: Callable[[str], str]
    stale_after_ns: Callable[[str], int | None]
    span: HeldSpan | None = None
    """The span that still lasts, up to the newest reading that shows it."""
    _readings: dict[str, tuple[int, Lookup]] = field(default_factory=dict)
    """Time and values of the newest reading by source."""

    def add(self, source: str, values: Lookup, at_ns: int) -> HeldStep:
        """Add a reading."""
        ended = None
        for other, (seen_ns, _) in self._readings.items():
            after_ns = self.stale_after_ns(other)
            if after_ns is not None and seen_ns + after_ns < at_ns and self._value(seen_ns + after_ns + 1) is not True:
                ended = self.end() or ended
        self._readings[source] = at_ns, values
        value = self._value(at_ns)
        if value is not True:
            ended = self.end() or ended
            return HeldStep(value, ended, has_begun=False)
        begun, self.span = self.span, HeldSpan(at_ns if self.span is None else self.span.begin_ns, at_ns)
        return HeldStep(value, ended, has_begun=begun is None)

    def end(self) -> HeldSpan | None:
        """End the span, and return it. The next reading that shows the condition begins another one."""
        ended, self.span = self.span, None
        return ended

    def _value(self, at_ns: int) -> bool | None:
        def lookup(name: str) -> object | None:
            source = self.source_of(name)
            if source not in self._readings:
                return None
            seen_ns, values = self._readings[source]
            after_ns = self.stale_after_ns(source)
            return None if after_ns is not None and at_ns - seen_ns > after_ns else values(name)

        return self.expression.value(lookup)

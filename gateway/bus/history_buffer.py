"""Buffers the last values of one key, and selects them by the time range of a query. No bus.

Time ranges have Zenoh's form: `[now(-30s)..]`, `[now(-1m)..now(-30s)[`. Zenoh's other form, `[start;duration]`, is not
possible here, because `;` separates the parameters of a query.
"""

import math
import re
from collections import deque
from datetime import UTC, datetime, timedelta
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from schemas.topics import HISTORY

_UNITS_NS: Final = {
    "u": 1_000,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 1_000_000_000,
    "m": 60_000_000_000,
    "h": 3_600_000_000_000,
    "d": 86_400_000_000_000,
    "w": 604_800_000_000_000,
}
_DURATION: Final = re.compile(r"(-?\d+(?:\.\d+)?)(u|us|ms|s|m|h|d|w)?")
_NOW: Final = re.compile(r"now\((.*)\)")
_RANGE: Final = re.compile(r"([\[\]])(.*?)\.\.(.*)([\[\]])")
_FOREVER_NS: Final = 1 << 63
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_COUNT: Final = re.compile(r"0*([1-9][0-9]*)")


class BadRange(ValueError):
    """An invalid `_time` or `last`. Its text shows the correct form."""


class Value(Struct, frozen=True):
    """One published value. `at` is in s, monotonic. `stamp_ns` is its published stamp."""

    at: float
    stamp_ns: int
    payload: bytes


class Bound(Struct, frozen=True):
    """One end of a time range: ns since the epoch, or with `from_now`, ns from now."""

    ns: int
    from_now: bool = False

    def before(self, value: Value, now: float) -> int:
        """Return by how many ns the bound is before a value.

        A date is compared with the stamp, because readers see the stamp. An age is counted by the monotonic clock, so
        that it is right even if the wall clock was set meanwhile.
        """
        return (round((value.at - now) * 1e9) if self.from_now else value.stamp_ns) - self.ns


class HistoryBuffer:
    """The last values of one key, oldest first."""

    def __init__(self, size: int) -> None:
        self._values: deque[Value] = deque(maxlen=size)

    def add(self, value: Value) -> None:
        """Append a value. A full buffer drops the oldest one."""
        self._values.append(value)

    def age(self, slept_s: float) -> None:
        """Make the values older by a sleep of the computer, s, which the monotonic clock does not count."""
        self._values = deque((replace(each, at=each.at - slept_s) for each in self._values), self._values.maxlen)

    def select(self, *, time_range: str | None, last: str | None, now: float) -> list[Value]:
        """Return the latest value, those in a time range, or the `last` ones. `now` is monotonic. Raises BadRange."""
        if time_range is None and last is None:
            return [self._values[-1]] if self._values else []
        values = list(self._values)
        if time_range is not None:
            begin, end = parse_range(time_range)
            values = [value for value in values if begin.before(value, now) >= 0 > end.before(value, now)]
        if last is not None:
            match = _COUNT.fullmatch(last)
            if match is None:
                raise BadRange(f"last={last}: give a whole number from 1 on. The history has at most {HISTORY} values.")
            if len(match[1]) <= len(str(HISTORY)):
                values = values[-int(match[1]) :]
        return values


def parse_range(text: str) -> tuple[Bound, Bound]:
    """Return a Zenoh time range as a half-open range [begin, end). Raises BadRange."""
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise _bad(text)
    opening, first, second, closing = match.groups()
    begin = _bound(first, text) if first else Bound(0)
    end = _bound(second, text) if second else Bound(_FOREVER_NS)
    return replace(begin, ns=begin.ns + (opening == "]")), replace(end, ns=end.ns + (closing == "]"))


def _bound(text: str, whole: str) -> Bound:
    match = _NOW.fullmatch(text)
    if match is not None:
        return Bound(_duration_ns(match[1], whole) if match[1] else 0, from_now=True)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise _bad(whole) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return Bound((moment - _EPOCH) // timedelta(microseconds=1) * 1000)


def _duration_ns(text: str, whole: str) -> int:
    match = _DURATION.fullmatch(text)
    if match is None:
        raise _bad(whole)
    duration_ns = float(match[1]) * _UNITS_NS[match[2] or "s"]
    if not math.isfinite(duration_ns):
        raise _bad(whole)
    return round(duration_ns)


def _bad(text: str) -> BadRange:
    return BadRange(
        f"_time={text} cannot be read: write [now(-30s)..], [now(-1m)..now(-30s)] or [2026-11-21T04:00:00Z..] "
        "(units u, ms, s, m, h, d, w)"
    )

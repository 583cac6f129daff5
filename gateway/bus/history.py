"""Buffers the last values of one key, and selects them by the time range of a query. No bus.

Time ranges have Zenoh's form: `[now(-30s)..]`, `[now(-1m)..now(-30s)[`. Zenoh's other form, `[start;duration]`, never
arrives whole: `;` separates the parameters of a query.
"""

import math
import re
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

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


@dataclass(frozen=True, slots=True)
class Value:
    """One published value. `at`: s, monotonic."""

    at: float
    payload: bytes


class HistoryBuffer:
    """The last values of one key, oldest first."""

    def __init__(self, size: int) -> None:
        self._values: deque[Value] = deque(maxlen=size)

    def add(self, at: float, payload: bytes) -> None:
        """Append a value of a monotonic time, s. A full buffer drops the oldest one."""
        self._values.append(Value(at, payload))

    def age(self, slept_s: float) -> None:
        """Let the values be older by a sleep of the computer that the monotonic clock does not count, s."""
        self._values = deque((Value(each.at - slept_s, each.payload) for each in self._values), self._values.maxlen)

    def select(self, *, time_range: str | None, last: str | None, now: float, now_ns: int) -> list[Value]:
        """Return the latest value, or those in a time range, or the last ones. Raises BadRange.

        now: s, monotonic. now_ns: the wall clock then. A value is as old as the monotonic clock says, also if the wall
        clock was set meanwhile.
        """
        if time_range is None and last is None:
            return [self._values[-1]] if self._values else []
        values = list(self._values)
        if time_range is not None:
            begin, end = parse_range(time_range, now_ns)
            since_ns = now_ns - round(now * 1e9)
            values = [value for value in values if begin <= since_ns + round(value.at * 1e9) < end]
        if last is not None:
            match = _COUNT.fullmatch(last)
            if match is None:
                raise BadRange(f"last={last}: give a whole number from 1 on. The history has at most {HISTORY} values.")
            if len(match[1]) <= len(str(HISTORY)):
                values = values[-int(match[1]) :]
        return values


def parse_range(text: str, now_ns: int) -> tuple[int, int]:
    """Return a Zenoh time range as half-open range [begin, end), ns since the epoch. Raises BadRange."""
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise _bad(text)
    opening, first, second, closing = match.groups()
    begin = _instant(first, now_ns, text) if first else 0
    end = _instant(second, now_ns, text) if second else _FOREVER_NS
    return begin + (opening == "]"), end + (closing == "]")


def _instant(text: str, now_ns: int, whole: str) -> int:
    match = _NOW.fullmatch(text)
    if match is not None:
        return now_ns + (_duration_ns(match[1], whole) if match[1] else 0)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise _bad(whole) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000


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

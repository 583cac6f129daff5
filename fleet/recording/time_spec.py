"""Parses times as users type them, in a session or in the past: an offset, a time of day, or a date. Pure."""

import re
from datetime import UTC, datetime, timedelta
from typing import Final

from schemas.duration import duration_s
from schemas.local_time import clock, clock_begins, clock_length_ns, date, date_and_clock, with_offset

RULE: Final = "90s (after the start), -5m (before the end), 14:05 (local), yesterday 14:05, or 2026-03-14 15:16"
PAST_RULE: Final = "30s or 5m (ago), 14:05 (local), yesterday 14:05, or 2026-03-14 15:16"
_DAYS: Final = {"today": 0, "yesterday": 1}
_WEEKDAYS: Final = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_NS: Final = 1_000_000_000
_DAY_NS: Final = 86_400 * _NS
_MAX_DAYS: Final = 3
"""Maximum number of days that a message proposes."""

_DATE: Final = re.compile(r"\d{4}-\d{2}-\d{2}")
_NUMBER: Final = re.compile(r"-?\d+([.,]\d+)?")
_OFFSET: Final = re.compile(r"[+-]\d{2}:?\d{2}$")
"""The offset of a zone from UTC, at the end of a time."""


def at_ns(text: str, start_ns: int, end_ns: int, now_s: float) -> int:
    """Return a time in ns since the epoch: the beginning of `span_ns`."""
    return span_ns(text, start_ns, end_ns, now_s)[0]


def span_ns(text: str, start_ns: int, end_ns: int, now_s: float) -> tuple[int, int]:
    """Return begin and end, ns, of a time that a person types for a session from `start_ns` to `end_ns`.

    A time of day and a date without a zone are local. A time of day without a day is a time within the session. Raises
    ValueError. The message has the range of the session (and the syntax, if `text` is not a time). If the session has
    this time of day several times, the message has their days instead. `now_s` is the wall clock.
    """
    try:
        return _span_ns(text, start_ns, end_ns, now_s)
    except _Unreadable as error:
        raise ValueError(f"{error} Write {RULE}. The session is from {_range(start_ns, end_ns)}.") from None


class _Unreadable(ValueError):
    """A text that is not a time. The message says what may have been meant. The caller adds the syntax."""


def _span_ns(text: str, start_ns: int, end_ns: int, now_s: float) -> tuple[int, int]:
    if (offset_s := duration_s(text.removeprefix("-"))) is not None:
        offset_ns = round(offset_s * 1e9)
        begin_ns = end_ns - offset_ns if text.startswith("-") else start_ns + offset_ns
        return begin_ns, begin_ns + _NS
    day, _, rest = text.partition(" ")
    if (days := _days_before(day, now_s)) is not None:
        text = f"{date(now_s, days)} {rest}".strip()
    elif (begins := clock_begins(text, start_ns, end_ns)) is not None:
        return _only(text, begins, start_ns, end_ns)
    return _date_ns(text)


def _days_before(day: str, now_s: float) -> int | None:
    """Return how many days ago a named day was: 0 for today, 0 to 6 for a weekday. None for another text."""
    if day in _WEEKDAYS:
        return (datetime.fromisoformat(date(now_s)).weekday() - _WEEKDAYS.index(day)) % len(_WEEKDAYS)
    return _DAYS.get(day)


def _day_ns(text: str, now_s: float) -> tuple[int, int] | None:
    """Return the begin and the end of a local day, in ns since the epoch. None for another text."""
    days = _days_before(text, now_s)
    day = text if days is None else date(now_s, days)
    if not _DATE.fullmatch(day):
        return None
    try:
        begin = datetime.fromisoformat(day)
        return int(begin.timestamp()) * _NS, int((begin + timedelta(days=1)).timestamp()) * _NS
    except (ValueError, OverflowError, OSError):  # such as the year 1, which this computer cannot represent
        return None


def _date_ns(text: str) -> tuple[int, int]:
    """Return the begin and the end, in ns since the epoch, of a date with a time. Raises _Unreadable."""
    try:
        when = datetime.fromisoformat(text)
        whole = int(when.replace(microsecond=0).timestamp())
    except (ValueError, OverflowError, OSError):  # such as the year 1, which this computer cannot represent
        typed = re.fullmatch(r"(\d+):(\d+)", text)  # such as 90:00
        near = f" Minutes and seconds are written as {typed[1]}m{typed[2]}s." if typed else ""
        raise _Unreadable(f"{text!r} is not a time.{near}") from None
    begin_ns = whole * _NS + when.microsecond * 1000
    return begin_ns, begin_ns + clock_length_ns(_OFFSET.sub("", text))


def ago_s(text: str, now_s: float) -> float:
    """Return how many seconds ago a time was. The text, the errors and `now_s` are as for `past_ns`.

    But here a number without a unit is a number of seconds.
    """
    duration = duration_s(text.removeprefix("-"))
    return now_s - past_ns(text, now_s) / _NS if duration is None else duration


def past_ns(text: str, now_s: float) -> int:
    """Return a time in the past as a person types it: a duration ago (`5m` or `-5m`), a local time, or a date.

    The result is in ns since the epoch. A time of day without a day is its last occurrence. Raises ValueError for a
    text that is not a time, and for a time in the future. `now_s` is the wall clock.
    """
    if _NUMBER.fullmatch(text):  # 18.21 may be meant for 18:21
        raise ValueError(f"{text} has no unit: write {text}s for that many seconds ago, or a time such as 14:05.")
    if (duration := duration_s(text.removeprefix("-"))) is not None:
        return round((now_s - duration) * _NS)
    now_ns = round(now_s * _NS)
    begins = clock_begins(text, now_ns - _DAY_NS, now_ns - 1)
    if begins == []:  # summer time began
        raise ValueError(f"{text} was not in the last 24 hours.")
    try:
        begin_ns = begins[-1] if begins is not None else _span_ns(text, now_ns, now_ns, now_s)[0]
    except _Unreadable as error:
        raise ValueError(f"{error} Write {PAST_RULE}.") from None
    if begin_ns >= now_ns:
        raise ValueError(f"{text} is in the future: it is {date_and_clock(now_s)} now.")
    return begin_ns


def is_within(text: str, start_ns: int, end_ns: int, now_s: float) -> bool:
    """Return True if a session from `start_ns` to `end_ns` ran at a local time or on a day. Raises ValueError."""
    if duration_s(text.removeprefix("-")) is not None:
        raise ValueError(f"{text} is an offset within one session. Write a local time (14:05) or a date.")
    if (begins := clock_begins(text, start_ns, end_ns)) is not None:
        return bool(begins)
    try:
        begin_ns, behind_ns = _day_ns(text, now_s) or _span_ns(text, start_ns, end_ns, now_s)
    except _Unreadable as error:
        raise ValueError(f"{error} Write a local time of day (14:05, yesterday 14:05), or a date.") from None
    return begin_ns <= end_ns and behind_ns > start_ns


def _only(text: str, begins: list[int], start_ns: int, end_ns: int) -> tuple[int, int]:
    if len(begins) > 1:
        days = [f"{date(each // _NS)} {text}" for each in begins]
        if len(set(days)) < len(days):  # the end of summer time
            days = [with_offset(each) for each in begins]
        raise ValueError(f"{text} is in the session {len(begins)} times. Write the day: {', '.join(days[:_MAX_DAYS])}")
    if not begins:
        minutes, _, rest = text.partition(":")
        near = f" Minutes and seconds are written as {minutes}m{rest}s." if ":" not in rest else ""
        raise ValueError(f"{text} is not in the session: it is from {_range(start_ns, end_ns)}.{near}")
    return begins[0], begins[0] + clock_length_ns(text)


def _range(start_ns: int, end_ns: int) -> str:
    first, last = start_ns / _NS, end_ns / _NS
    return f"{date_and_clock(first)} to {clock(last) if date(first) == date(last) else date_and_clock(last)}"


def format_utc(when: datetime, timespec: str = "milliseconds") -> str:
    """Return a time in ISO 8601, UTC; timespec as for `datetime.isoformat`."""
    return when.astimezone(UTC).isoformat(timespec=timespec).replace("+00:00", "Z")


def iso(ns: int) -> str:
    """Return a time in ISO 8601, UTC, with milliseconds. A time that no date can express becomes a number of ns."""
    try:
        when = datetime.fromtimestamp(ns // 1_000_000_000, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{ns} ns"  # not a date, because the clock of another writer was wrong
    return f"{when:%Y-%m-%dT%H:%M:%S}.{ns // 1_000_000 % 1000:03d}Z"


def iso_ns(text: str) -> int:
    """Return a stored time (ISO 8601), ns since the epoch. Raises ValueError, OverflowError if it is not one."""
    when = datetime.fromisoformat(text)
    return int(when.replace(microsecond=0).timestamp()) * _NS + when.microsecond * 1000


def words(seconds: float) -> str:
    """Return a duration as users write it: 59.2s, 1m30s, 2h05m."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"

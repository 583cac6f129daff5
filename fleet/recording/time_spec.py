"""Parses times within a session as users type them: an offset from its start or end, or a date. Pure."""

import re
from datetime import UTC, datetime
from typing import Final

from schemas.duration import duration_s
from schemas.local_time import clock_begins, clock_length_ns, date, date_and_clock

RULE: Final = (
    "an offset from the start (90s, 1m30s, 1h, 500ms), from the end with - (-60s), a local time of day (14:05, "
    "yesterday 14:05), or a date (2026-03-14 15:16, 2026-03-14T15:16:17Z)"
)
_DAYS: Final = {"today": 0, "yesterday": 1}
_NS: Final = 1_000_000_000
_MAX_DAYS: Final = 3
"""Maximum days that a message proposes."""


def at_ns(text: str, start_ns: int, end_ns: int, now_s: float) -> int:
    """Return a time in ns since the epoch: the begin of `span_ns`."""
    return span_ns(text, start_ns, end_ns, now_s)[0]


def span_ns(text: str, start_ns: int, end_ns: int, now_s: float) -> tuple[int, int]:
    """Return begin and end of a time as a person types it for a session from `start_ns` to `end_ns`, ns.

    A time of day and a date without a zone are local. A time of day without a day is that of the session. Raises
    ValueError with the syntax, or with the days if the time of day is on none or on several. now_s: the wall clock.
    """
    if (offset_s := duration_s(text.removeprefix("-"))) is not None:
        offset_ns = round(offset_s * 1e9)
        begin_ns = end_ns - offset_ns if text.startswith("-") else start_ns + offset_ns
        return begin_ns, begin_ns + _NS
    day, _, rest = text.partition(" ")
    if day in _DAYS:
        text = f"{date(now_s, _DAYS[day])} {rest}".strip()
    elif (begins := clock_begins(text, start_ns, end_ns)) is not None:
        return _only(text, begins, start_ns, end_ns)
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        clock = re.fullmatch(r"(\d+):(\d+)", text)  # such as 90:00
        near = f"Minutes and seconds are written as {clock[1]}m{clock[2]}s. " if clock else ""
        raise ValueError(f"{text!r} is not a time. {near}Write {RULE}.") from None
    whole = int(when.replace(microsecond=0).timestamp())
    begin_ns = whole * _NS + when.microsecond * 1000
    return begin_ns, begin_ns + clock_length_ns(text.partition("+")[0])


def is_within(text: str, start_ns: int, end_ns: int, now_s: float) -> bool:
    """Return True if a session from `start_ns` to `end_ns` ran at a local time of day or date. Raises ValueError."""
    if duration_s(text.removeprefix("-")) is not None:
        raise ValueError(f"{text} is an offset within one session. Write a local time (14:05) or a date.")
    if (begins := clock_begins(text, start_ns, end_ns)) is not None:
        return bool(begins)
    begin_ns, behind_ns = span_ns(text, start_ns, end_ns, now_s)
    return begin_ns <= end_ns and behind_ns > start_ns


def _only(text: str, begins: list[int], start_ns: int, end_ns: int) -> tuple[int, int]:
    if len(begins) > 1:
        days = ", ".join(f"{date(each // _NS)} {text}" for each in begins[:_MAX_DAYS])
        raise ValueError(f"{text} is on {len(begins)} days of the session. Write the day: {days}")
    if not begins:
        span = f"{date_and_clock(start_ns / 1e9)} to {date_and_clock(end_ns / 1e9)}"
        minutes, _, rest = text.partition(":")
        near = f". Minutes and seconds are written as {minutes}m{rest}s" if ":" not in rest else ""
        raise ValueError(f"{text} is not in the session: it is from {span}{near}")
    return begins[0], begins[0] + clock_length_ns(text)


def format_utc(when: datetime, timespec: str = "milliseconds") -> str:
    """Return a time in ISO 8601, UTC; timespec as for `datetime.isoformat`."""
    return when.astimezone(UTC).isoformat(timespec=timespec).replace("+00:00", "Z")


def iso(ns: int) -> str:
    """Return a time in ISO 8601, UTC, with milliseconds."""
    try:
        when = datetime.fromtimestamp(ns // 1_000_000_000, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{ns} ns"  # not a date: the clock of another writer was wrong
    return f"{when:%Y-%m-%dT%H:%M:%S}.{ns // 1_000_000 % 1000:03d}Z"


def words(seconds: float) -> str:
    """Return a duration as users write it: 59.2s, 1m30s, 2h05m."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"

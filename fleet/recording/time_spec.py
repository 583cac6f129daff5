"""Parses times within a session as users type them: an offset from its start or end, or a date. Pure."""

import re
from datetime import UTC, datetime
from typing import Final

from schemas.duration import duration_s

RULE: Final = "an offset from the start (90s, 1m30s, 1h, 500ms), from the end with - (-60s), or 2026-03-14T15:16:17Z"


def at_ns(text: str, start_ns: int, end_ns: int) -> int:
    """Return the time in ns since the epoch. A date without a zone is UTC. Raises ValueError with the syntax."""
    if (offset_s := duration_s(text.removeprefix("-"))) is not None:
        offset_ns = round(offset_s * 1e9)
        return end_ns - offset_ns if text.startswith("-") else start_ns + offset_ns
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        clock = re.fullmatch(r"(\d+):(\d+)", text)
        near = f"Minutes and seconds are written as {clock[1]}m{clock[2]}s. " if clock else ""
        raise ValueError(f"{text!r} is not a time. {near}Write {RULE}.") from None
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    whole = int(when.replace(microsecond=0).timestamp())
    return whole * 1_000_000_000 + when.microsecond * 1000


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

"""Times as people read them: local, with the zone, everywhere in one form."""

import re
from datetime import datetime, timedelta
from typing import Final

_CLOCK: Final = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}))?")
_NS: Final = 1_000_000_000


def clock(at_s: float) -> str:
    """Return a time of day, such as `14:05:12 CET`. `at_s` is in s since the epoch."""
    return _local(at_s).strftime("%H:%M:%S %Z") if _is_date(at_s) else f"{at_s:.0f} s"


def date_and_clock(at_s: float) -> str:
    """Return a date and a time of day, such as `2026-11-25 14:05:12 CET`."""
    return _local(at_s).strftime("%Y-%m-%d %H:%M:%S %Z") if _is_date(at_s) else f"{at_s:.0f} s"


def date(at_s: float, days_before: int = 0) -> str:
    """Return the local date of a time, or of `days_before` days earlier, such as `2026-11-25`."""
    return (_local(at_s) - timedelta(days=days_before)).strftime("%Y-%m-%d")


def exact(at_ns: int) -> str:
    """Return a date and a time with milliseconds, `2026-11-25 14:05:12.345 CET`. `at_ns` is since the epoch."""
    if not _is_date(at_ns / _NS):
        return f"{at_ns} ns"
    seconds, rest = divmod(at_ns, _NS)
    when = _local(seconds)
    return f"{when:%Y-%m-%d %H:%M:%S}.{rest // 1_000_000:03d} {when:%Z}"


def of_iso(text: str) -> str:
    """Return a stored time (ISO 8601, UTC) in the form of `date_and_clock`. Return any other text unchanged."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return text
    return date_and_clock(when.timestamp()) if when.tzinfo is not None else text


def with_offset(at_ns: int) -> str:
    """Return a time in ISO 8601 with milliseconds and the local zone's offset, as commands accept it."""
    if not _is_date(at_ns / _NS):
        return f"{at_ns} ns"
    seconds, rest = divmod(at_ns, _NS)
    return _local(seconds).replace(microsecond=rest // 1000).isoformat(timespec="milliseconds")


def clock_begins(text: str, start_ns: int, end_ns: int) -> list[int] | None:
    """Return when a local time of day begins on each day from `start_ns` to `end_ns`, in ns since the epoch.

    A time of day is a minute (`14:05`) or a second (`14:05:12`). Leave out those that are over at `start_ns` or begin
    after `end_ns`. Return None if the text is not a time of day.
    """
    found = _CLOCK.fullmatch(text)
    if found is None or int(found[1]) > 23 or int(found[2]) > 59 or int(found[3] or 0) > 59:
        return None
    length_ns = clock_length_ns(text)
    first = _local(start_ns / _NS).replace(
        hour=int(found[1]), minute=int(found[2]), second=int(found[3] or 0), microsecond=0, tzinfo=None
    )
    days = [first + timedelta(days=day) for day in range((end_ns - start_ns) // (86_400 * _NS) + 2)]
    # On the day on which summer time ends, one hour comes twice (fold). On the day on which it begins, one is missing.
    both = [round(day.replace(fold=fold).timestamp()) for day in days for fold in (0, 1)]
    begins = [each * _NS for each in dict.fromkeys(both) if _local(each).time() == first.time()]
    return [each for each in begins if each + length_ns > start_ns and each <= end_ns]


def clock_length_ns(text: str) -> int:
    """Return the length of a typed time of day in ns: a minute if it has no seconds (`14:05`), else a second."""
    return (60 if text.count(":") == 1 else 1) * _NS


def _local(at_s: float) -> datetime:
    return datetime.fromtimestamp(at_s).astimezone()


def _is_date(at_s: float) -> bool:
    return 0 <= at_s < 2e11  # a time outside comes from a writer whose clock was wrong

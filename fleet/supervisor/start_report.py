"""Describes a start: its end, the cars that are ready or missing, and old stops that are still in force. Pure."""

from collections.abc import Mapping, Sequence
from datetime import UTC
from typing import Any, Final

from msgspec import Struct

from schemas.keys import name_of
from schemas.local_time import date_and_clock

MAX_CARS_LISTED: Final = 8
"""Maximum number of cars that one line lists."""

READY_TIMEOUT_S: Final = 30.0
"""A start ends when no further car has become ready for this time, even if some are missing."""

LINK_OPEN_TIMEOUT_S: Final = 10.0
"""The timeout in place of READY_TIMEOUT_S if all that is missing is cars whose links cannot be opened."""


class StartProgress(Struct):
    """The progress of a start: the smallest number of missing cars and services so far, and when it was reached."""

    fewest: int | None = None
    since: float = 0.0

    def has_ended(self, missing: int, now: float, *, unreachable: bool) -> bool:
        """Return True if no car or service is missing, or if none has become ready for a while.

        `unreachable` is True if all that is missing is cars whose links cannot be opened.
        """
        if self.fewest is None or missing < self.fewest:
            self.fewest, self.since = missing, now
        return not missing or now - self.since >= (LINK_OPEN_TIMEOUT_S if unreachable else READY_TIMEOUT_S)


def describe_start(cars: Sequence[str], missing: Mapping[str, str], session: str, console: str = "") -> str:
    """Describe the end of a start in one line: all cars are ready, or who is missing and why."""
    ready = [car for car in cars if car not in missing]
    if missing:
        first = [f"{name.lstrip('@')} ({why.rstrip('.')})" for name, why in list(missing.items())[:MAX_CARS_LISTED]]
        more = f" and {len(missing) - MAX_CARS_LISTED} more" if len(missing) > MAX_CARS_LISTED else ""
        words = f"{len(ready)} of {len(cars)} cars ready. Missing: {', '.join(first)}{more}."
    elif len(cars) == 1:
        words = f"{cars[0]} is ready."
    else:
        names = f": {', '.join(cars)}" if len(cars) <= MAX_CARS_LISTED else ""
        words = f"All {len(cars)} cars are ready{names}."
    words = f"{words} Recording to {session}." if session else words
    return f"{words} Console: {console}" if console else words


def describe_old_stops(car: str, safety: Any, began_s: float) -> str:
    """Describe a hold and e-stops older than `began_s` (s since the epoch). Return an empty string if there are none.

    `safety` is a fleet.v1.Safety.
    """
    estops = [each for each in safety.estops if each.stamp.ToDatetime(UTC).timestamp() < began_s]
    held = safety.HasField("hold") and safety.hold.since.ToDatetime(UTC).timestamp() < began_s
    resume = f"fleet resume {car}"
    words = []
    if estops:
        first = estops[0]
        why = f" ({first.why})" if first.why else ""
        more = f" and {len(estops) - 1} more" if len(estops) > 1 else ""
        words.append(
            f"e-stopped by {name_of(first.by)}{why} since {_date(first.stamp)}{more}: {car} only accepts stops"
        )
    if held:
        words.append(f"on hold by {name_of(safety.hold.by)} since {_date(safety.hold.since)}: no plan moves {car}")
    if not words:
        return ""
    ends = " and then ".join([f"`{resume} --estops`"] * bool(estops) + [f"`{resume}`"] * held)
    return f"{'; '.join(words)}. To end that: {ends}"


def _date(stamp: Any) -> str:
    return date_and_clock(stamp.seconds)

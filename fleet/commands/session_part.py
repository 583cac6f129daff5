"""The part of a recording that `--from`, `--to` and `--car` select."""

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from fleet.recording import time_spec
from schemas.local_time import with_offset

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session


def part_of(session: "Session", start: str | None, end: str | None, cars: Iterable[str]) -> Any:
    """Return the selected part of a session. Raises UsageError for a car or time that is not in the session."""
    from fleet.recording.selection import Selection
    from fleet.recording.tools.summary import of_session

    about = of_session(session)
    if missing := sorted(set(cars) - set(about.cars)):
        raise click.UsageError(
            f"--car: {', '.join(missing)} is not in {session.path}; its cars: {', '.join(about.cars) or 'none'}"
        )
    bounds: list[int | None] = []
    now_s = time.time()
    for name, text in (("--from", start), ("--to", end)):
        try:
            bounds.append(None if text is None else time_spec.at_ns(text, about.start_ns, about.end_ns, now_s))
        except ValueError as error:
            raise click.UsageError(f"{name}: {error}") from None
    selection = Selection(None, *bounds)
    there = f"{session.path} runs from {with_offset(about.start_ns)} to {with_offset(about.end_ns)}"
    if bounds[0] is not None and bounds[1] is not None and bounds[0] >= bounds[1]:
        raise click.UsageError(f"--from {start} is not before --to {end}: {there}")
    if not selection.overlaps(about.start_ns, about.end_ns):
        raise click.UsageError(f"The time range is outside the session: {there} ({time_spec.words(about.length_s)}).")
    return selection

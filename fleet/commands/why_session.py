"""`fleet why CAR --session S --at TIME`: what happened to a car around a time of a recording."""

import json
import time
from pathlib import Path
from typing import Any, Final

import click

from fleet.commands.output import echo_safely
from fleet.recording import time_spec
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import Selection
from fleet.recording.tools.car_timeline import (
    DECISION_TOPIC,
    STATE_BEFORE_NS,
    TIMELINE_AFTER_NS,
    TIMELINE_BEFORE_NS,
    TIMELINE_TOPICS,
    CarTimeline,
)
from fleet.recording.tools.moment import known_message
from fleet.recording.tools.recorder_clock import RecorderClock
from fleet.recording.tools.summary import of_session
from schemas import keys
from schemas.local_time import date_and_clock
from schemas.suggestion import did_you_mean

MAX_TIMELINE_LINES: Final = 60
"""Maximum number of printed lines of a timeline. --json prints all."""


def explain_session(car: str, path: Path, at: str, *, as_json: bool) -> None:
    """Print why this car did not show a stop at that time, and what happened before and after."""
    try:
        session = Session(path)
    except NoSession as error:
        raise click.ClickException(str(error)) from None
    summary = of_session(session)
    try:
        begin_ns, end_ns = time_spec.span_ns(at, summary.start_ns, summary.end_ns, time.time())
    except ValueError as error:
        raise click.UsageError(f"--at: {error}") from None
    span = f"{date_and_clock(summary.start_ns / 1e9)} to {date_and_clock(summary.end_ns / 1e9)}"
    if end_ns <= summary.start_ns or begin_ns > summary.end_ns:
        raise click.UsageError(f"--at: {at} is not in {session.name}: it is from {span}.")
    cars = sorted({key.car for each in summary.keys if (key := keys.parse(each)) and not key.car.startswith("@")})
    if car not in cars:
        near = did_you_mean(car, cars) or f"Cars: {', '.join(cars)}."
        raise click.ClickException(f'No car "{car}" in {session.name}. {near}')
    timeline = CarTimeline(car, begin_ns - TIMELINE_BEFORE_NS, end_ns + TIMELINE_AFTER_NS)
    selection = Selection(
        (*(f"*/{car}/{topic}" for topic in TIMELINE_TOPICS), f"*/{DECISION_TOPIC}"),
        timeline.begin_ns - STATE_BEFORE_NS,
        timeline.end_ns,
    )
    recorder_clock, found = RecorderClock(), list[tuple[int, str, Any]]()
    for each in map(known_message, session.rows(selection)):
        if each is not None:
            key = each.key
            topic = f"{key.car}/{key.topic}" if key.car.startswith("@") else key.topic
            found.append((recorder_clock.time_ns(each), topic, each.message))
    # A backfilled message stands behind later ones. It would seem to follow them, and to end the states that they show.
    for at_ns, topic, message in sorted(found, key=lambda each: each[0]):
        timeline.add(topic, message, at_ns)
    if as_json:
        click.echo(json.dumps(timeline.as_dict()))
        return
    stops = timeline.nearest
    for stop in stops:
        echo_safely(stop.describe())
    if not stops:
        echo_safely(f"{car}: no stop failed around {date_and_clock(begin_ns / 1e9)}.")
    for entry in timeline.entries[:MAX_TIMELINE_LINES]:
        echo_safely(f"  {entry}")
    if len(timeline.entries) > MAX_TIMELINE_LINES:
        click.echo(f"  and {len(timeline.entries) - MAX_TIMELINE_LINES} more: --json lists all")

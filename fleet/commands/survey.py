"""`fleet keys, wait`: what is there to be asked, and asking until it is so. Nothing here makes a car do anything."""

import json
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import click

from fleet.client.client import Fleet
from fleet.client.condition import KeyCondition
from fleet.client.key_survey import LOOK_S, SERVICES, KeyInfo, KeySurvey, spoken_of
from fleet.client.reading import Watch
from fleet.client.wait import NotInTime
from fleet.commands.options import bus_options, json_option
from fleet.commands.output import json_text, line, show_table
from fleet.commands.params import DurationType, warn_if_missing, what_there_is, written_out
from schemas.bus import Sample, intersects

_DAY_S: Final = 86_400.0
_COLUMNS: Final = ("key", "type", "unit", "rate", "age")


@click.command(
    "keys",
    epilog="\b\nexamples:\n  fleet keys\n  fleet keys red\n  fleet keys '*/state/*' --json\n  fleet keys --for 10s",
)
@click.argument("keyexpr", required=False)
@click.option(
    "--for",
    "look_s",
    type=DurationType(600.0),
    default=f"{LOOK_S:g}s",
    show_default=True,
    help="How long rates are measured.",
)
@json_option
@bus_options
def list_keys(keyexpr: str | None, *, look_s: float, as_json: bool, connect: str | None, fleet: str) -> None:
    """Every key now alive: type of message, units, rate and age of the newest; of KEYEXPR only, if one is given.

    A rate of - is less than two in the time that was measured; an age of - is a key on which nothing came.
    """
    everything = [f"{fleet}/**", *(f"{fleet}/{service}/**" for service in SERVICES)]
    written = [written_out(each, fleet) for each in ([keyexpr] if keyexpr else everything)]
    with Fleet(connect, fleet, kind="person") as client:
        found = _alive(client, written, look_s)
        if not found:
            what = f"under {written[0]}" if keyexpr else f"of fleet {fleet}"
            raise click.ClickException(f"no key {what} is alive; {what_there_is(client, written[0])}")
    if as_json:
        for each in found:
            click.echo(json.dumps(_row(each)))
    else:
        show_table(_COLUMNS, [_cells(each) for each in found])


def _alive(client: Fleet, written: Sequence[str], look_s: float) -> list[KeyInfo]:
    """What was published before and within `look_s`."""

    def subscribe(take: Callable[[Sample], None]) -> Callable[[], object]:
        subscribers = [client.bus.subscribe(each, take) for each in written]

        def end() -> None:
            for subscriber in subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type

        return end

    survey, until = KeySurvey(look_s), time.monotonic() + look_s
    with Watch().begin(subscribe) as stream:
        for each in written:
            for reading in client.get(each):
                survey.take(reading, datetime.now(UTC))
        while (left := until - time.monotonic()) > 0:
            coming = stream.within(left)
            if coming is not None:
                survey.take(coming, datetime.now(UTC))
    silent = [key for key in spoken_of(client.name, client.cars()) if any(intersects(each, key) for each in written)]
    return survey.found(silent, datetime.now(UTC))


def _row(alive: KeyInfo) -> dict[str, Any]:
    topic = alive.topic
    return {
        "key": alive.key,
        "type": topic.message if topic else None,
        "about": topic.about if topic else None,
        "units": dict(topic.units) if topic else {},
        "rate_hz": None if alive.rate_hz is None else round(alive.rate_hz, 2),
        "age_s": None if alive.age_s is None else round(alive.age_s, 3),
        "stale": alive.stale,
    }


def _cells(alive: KeyInfo) -> dict[str, str]:
    stale = " (stale)" if alive.stale else ""
    return {
        "key": alive.key,
        "type": alive.topic.message if alive.topic else "-",
        "unit": ", ".join(alive.units) or "-",
        "rate": "-" if alive.rate_hz is None else f"{alive.rate_hz:.1f} Hz",
        "age": "-" if alive.age_s is None else f"{alive.age_s:.1f} s{stale}",
    }


@click.command(
    epilog="\b\nexamples:\n  fleet wait red/sensor/range 'range_m < 0.3' --timeout 10s\n"
    "  fleet wait '*/sensor/light' 'left or right' --for 2s\n"
    "  fleet wait red/state/link \"state == 'online'\" --timeout 1m && fleet drive red forward\n\n\b\n"
    "Exit codes: 0 it holds, 1 time-out or no fleet, 2 wrong use, 130 Ctrl-C."
)
@click.argument("keyexpr")
@click.argument("condition", metavar="CONDITION")
@click.option("--timeout", "timeout_s", type=DurationType(_DAY_S), help="Give up after this time (default: never).")
@click.option("--for", "for_s", type=DurationType(_DAY_S), help="It must have held of every reading for so long.")
@json_option
@bus_options
def wait(
    keyexpr: str,
    condition: str,
    *,
    timeout_s: float | None,
    for_s: float | None,
    as_json: bool,
    connect: str | None,
    fleet: str,
) -> None:
    """Wait until CONDITION holds of a fresh reading of KEYEXPR, and print that; the current one counts.

    With a wildcard any key will do. CONDITION is as in `fleet watch --when`.
    """
    written = written_out(keyexpr, fleet)
    KeyCondition.of(condition, written)
    if for_s is not None and timeout_s is not None and for_s >= timeout_s:
        raise click.UsageError(f"--for {for_s:g} s cannot be over within --timeout {timeout_s:g} s: give more time")
    with Fleet(connect, fleet, kind="person") as client:
        warn_if_missing(written, client.cars())
        try:
            reading = client.wait(keyexpr, condition, timeout_s=timeout_s, for_s=for_s or 0.0)
        except NotInTime as late:
            raise click.ClickException(str(late)) from None
    click.echo(json_text(reading) if as_json else line(reading))

"""`fleet list, get, watch`: what cars say, now and before. Nothing here makes a car do anything."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import click

from fleet.client import history
from fleet.client.client import Fleet
from fleet.client.condition import KeyCondition, topics_under
from fleet.client.reading import Reading
from fleet.commands.options import bus_options, json_option, with_client
from fleet.commands.output import json_text, line, show_table
from fleet.commands.params import DurationType, warn_if_missing, what_there_is, written_out
from fleet.recording.tools import csv_table
from schemas import keys, topics

_COLUMNS: Final = ("car", "platform", "link", "mode", "verdict", "motion", "driver", "hold", "battery")
_UNHEARD_S: Final = 3.0
"""Silence of a car whose motors are unknown that makes it unheard, whatever its link is called (gateway: stale)."""
_TOLD: Final = 5


@click.command("list", epilog="\b\nexample:\n  fleet list --json")
@json_option
@with_client
def list_cars(client: Fleet, *, as_json: bool) -> None:
    """The cars on the bus: platform, link, mode and how sure that is, motion, who drives or stopped it, battery."""
    cars = client.cars()
    said: dict[str, dict[str, Reading]] = {car: {} for car in cars}
    for reading in client.get("*/*/*"):  # one query: a gateway that hangs is waited for once
        key = keys.parse(reading.key)
        if key is not None:
            said.setdefault(key.car, {})[key.topic] = reading
    if not said:
        raise click.ClickException(f"no car of fleet {client.name} is on the bus at {client.bus.endpoint}")
    rows = [row_of(car, values) for car, values in sorted(said.items())]
    for token in client.bus.tokens(f"{client.name}/{keys.REPLAY}/*"):
        session = token.rpartition("/")[2]
        click.echo(f"fleet: {client.name} is a replay of {session}: ages are those of the recording", err=True)
        rows = [{**row, "replay": session} for row in rows]
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    show_table(_COLUMNS, [{name: shown(name, row) for name in _COLUMNS} for row in rows])
    for row in rows:
        for words in row["platform_contradictions"]:
            click.echo(f"fleet: {row['car']} may be no {row['platform']} car: {words}", err=True)


def row_of(car: str, readings: Mapping[str, Reading]) -> dict[str, Any]:
    """Return what `fleet list` shows of a car, by its latest readings: the fields of its JSON object."""
    values = {topic: reading.value for topic, reading in readings.items()}
    measured = readings.get("sensor/battery")
    link, mode, motion = (values.get(f"state/{name}") for name in ("link", "mode", "motion"))
    safety, battery = values.get("state/safety"), values.get("sensor/battery")
    health = values.get("state/health")
    last_rx_s = link.last_rx_s if link and link.HasField("last_rx_s") else None
    return {
        "car": car,
        "link": link.state if link else "no answer",
        "reason": link.reason if link else "",
        "unheard": link is not None and _unheard(link.state, last_rx_s, safety.motors if safety else ""),
        "last_rx_s": None if last_rx_s is None else round(last_rx_s, 3),
        "platform": health.platform if health else None,
        "platform_contradictions": list(health.platform_contradictions) if health else [],
        "mode": mode.asked if mode else None,
        "verdict": mode.verdict if mode else None,
        "motion": motion.motion if motion else None,
        "driver": safety.lease.holder if safety and safety.HasField("lease") else None,
        "driver_kind": safety.lease.kind if safety and safety.HasField("lease") else None,
        "hold": safety.hold.by if safety and safety.HasField("hold") else None,
        "estops": [estop.id for estop in safety.estops] if safety else [],
        "motors": safety.motors if safety else None,
        "battery_v": battery.voltage_v if battery else None,
        "battery_level": battery.level if battery else None,
        "battery_age_s": round(measured.age_s(), 3) if measured else None,
        "stale": sorted(topic for topic, reading in readings.items() if reading.stale()),
    }


def _unheard(link: str, last_rx_s: float | None, motors: str) -> bool:
    """Return True if the link is open and the car should be heard, but is not."""
    if link == "lost":
        return False
    return link == "stale" or last_rx_s is None or (motors == "unknown" and last_rx_s > _UNHEARD_S)


def shown(name: str, row: Mapping[str, Any]) -> str:
    """Return a cell of the table."""
    if name == "battery":
        if row["battery_v"] is None:
            return "-"
        age = f", {row['battery_age_s']:.0f} s old" if "sensor/battery" in row["stale"] else ""
        return f"{row['battery_v']:.2f} V {row['battery_level']}{age}"
    if name == "hold" and row["estops"]:
        return f"e-stop {' '.join(row['estops'])}"
    if name == "driver" and row["driver"]:
        return f"{row['driver']} ({row['driver_kind']})"
    if name == "platform" and row["platform_contradictions"]:
        return f"{row['platform']} (contradicted)"
    if name == "link" and row["unheard"]:
        silence = "never heard" if row["last_rx_s"] is None else f"not heard for {row['last_rx_s']:.0f} s"
        return f"{row['link']} ({silence})"
    old = " (stale)" if name in ("link", "mode", "motion") and f"state/{name}" in row["stale"] else ""
    return f"{row[name]}{old}" if row[name] else "-"


@click.command(
    epilog="\b\nexamples:\n  fleet get red\n  fleet get red/sensor/range\n  fleet get '*/sensor/battery' --json\n"
    "  fleet get red/sensor/range --last 100\n  fleet get '*/sensor/range' --since 30s --csv > range.csv"
)
@click.argument("keyexpr")
@click.option("--last", type=click.IntRange(1), metavar="N", help="The last N values of each key, oldest first.")
@click.option(
    "--since", type=DurationType(history.LONGEST_S), help="The values of the last so many seconds, as 30s or 5m."
)
@click.option("--csv", "as_csv", is_flag=True, help="One CSV table; KEYEXPR must mean one type of message.")
@json_option
@bus_options
def get(
    keyexpr: str,
    *,
    last: int | None,
    since: float | None,
    as_csv: bool,
    as_json: bool,
    connect: str | None,
    fleet: str,
) -> None:
    """The latest value of every reading that matches KEYEXPR, or its last values from the gateways' memory.

    `red` is every sensor of red, * is any one part.
    """
    written = written_out(keyexpr, fleet)
    under = topics_under(written)
    if as_csv and as_json:
        raise click.UsageError("--csv and --json: give one of them")
    if as_csv and len(under) != 1:
        meant = ", ".join(topic.name for topic in under) or "nothing that is ever published"
        raise click.UsageError(f"a table has one type of message, {written} means {meant}: name one")
    past = last is not None or since is not None
    why_not = history.without_history(under) if past else ""
    if why_not:
        raise click.UsageError(why_not)
    with Fleet(connect, fleet, kind="person") as client:
        readings = client.history(keyexpr, last=last, since_s=since) if past else client.get(keyexpr)
        if not readings:
            within = f" of the last {since:g} s" if since is not None else ""
            raise click.ClickException(f"nothing under {written}{within}; {what_there_is(client, written)}")
    _show(readings, csv_of=under[0] if as_csv else None, as_json=as_json, past=past)
    if past:
        _tell(history.shortfalls(readings, datetime.now(UTC), last=last, since_s=since))


def _show(readings: Sequence[Reading], *, csv_of: topics.Topic | None, as_json: bool, past: bool) -> None:
    if csv_of is not None:
        click.echo(csv_table.table(readings, csv_of).encode(), nl=False)
        return
    width = max(len(reading.key) for reading in readings)
    for reading in readings:
        click.echo(json_text(reading) if as_json else line(reading, width, past=past))


def _tell(words: Sequence[str]) -> None:
    """Say why there is less than was asked, for a few keys."""
    more = [f"and {len(words) - _TOLD} more likewise"] if len(words) > _TOLD + 1 else words[_TOLD : _TOLD + 1]
    for each in (*words[:_TOLD], *more):
        click.echo(f"fleet: {each}", err=True)


@click.command(
    epilog="\b\nexamples:\n  fleet watch red\n  fleet watch '*/state/*' --json\n  fleet watch red/event/command\n"
    "  fleet watch '*/sensor/range' --when 'range_m < 0.3'\n  fleet watch red/sensor/light --when left --count 1"
)
@click.argument("keyexpr")
@click.option("--when", metavar="CONDITION", help="Only readings of which it holds, as 'range_m < 0.3'.")
@click.option("--count", type=click.IntRange(1), metavar="N", help="End after N readings.")
@json_option
@bus_options
def watch(keyexpr: str, *, when: str | None, count: int | None, as_json: bool, connect: str | None, fleet: str) -> None:
    """Readings that match KEYEXPR as they are published, until Ctrl-C.

    CONDITION is about the fields of one message: < <= > >= == != with numbers, 'words', true and false, a yes/no field
    by itself, and, or, not, parentheses. What was not measured makes it hold never.
    """
    written = written_out(keyexpr, fleet)
    if when is not None:
        KeyCondition.of(when, written)
    with Fleet(connect, fleet, kind="person") as client:
        warn_if_missing(written, client.cars())
        told = shown = 0
        with client.watch(keyexpr, when=when) as readings:
            for reading in readings:
                click.echo(json_text(reading) if as_json else line(reading))
                if readings.dropped > told:
                    told = readings.dropped
                    click.echo(f"fleet: {told} readings dropped so far: what reads this is too slow", err=True)
                shown += 1
                if shown == count:
                    return

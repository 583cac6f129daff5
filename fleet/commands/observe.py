"""`fleet list, get, watch, keys, wait`: reads the cars' messages. Nothing here moves a car."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import click

from fleet.client import history_query
from fleet.client.car_evidence import clocks_off, newest_states
from fleet.client.car_state import CarState
from fleet.client.claims import describe_bars, describe_end_of_doubt
from fleet.client.client import Fleet
from fleet.client.condition import KeyCondition, check_key, topics_under
from fleet.client.gateway_clock import describe_clock
from fleet.client.key_survey import SURVEY_S, SURVEYED_SERVICES, KeyInfo, KeySurvey, event_keys
from fleet.client.reading import Reading, Watch
from fleet.client.supervision import ask_colors
from fleet.client.wait import NotInTime
from fleet.commands.car_names import (
    any_cars_argument,
    complete_car,
    complete_cars,
    describe_missing,
    expand_key,
    no_cars,
    resolve_cars,
    warn_if_missing,
)
from fleet.commands.command_group import say
from fleet.commands.options import bus_options, json_option, with_client
from fleet.commands.output import json_text, reading_line, show_table
from fleet.commands.params import Duration, Number, Since
from fleet.commands.ready import READY_WAIT_S, wait_ready
from fleet.commands.which_fleet import open_client, open_observer
from fleet.recording.tools import csv_table
from schemas import keys, topics
from schemas.bus import Sample, intersects
from schemas.colors import car_color, hex_color
from schemas.rights import binding_pause
from schemas.suggestion import did_you_mean
from schemas.words import Shows

CAR_COLUMNS: Final = (
    "car",
    "platform",
    "link",
    "ready",
    "mode",
    "verdict",
    "motion",
    "motors",
    "shows stops",
    "driver",
    "hold",
    "battery",
)
OPTIONAL_CAR_COLUMNS: Final = ("platform", "shows stops", "verdict", "driver", "motion", "motors", "ready")
"""Columns that a narrow terminal leaves out, in this order."""
_SHOWS: Final = {Shows.YES: "yes", Shows.NO: "no", Shows.UNKNOWN: "not known"}
_KEY_COLUMNS: Final = ("key", "type", "unit", "rate", "age")
_DAY_S: Final = 86_400.0
_MAX_SHORTFALL_LINES: Final = 5


@click.command("list", epilog="\b\nexamples:\n  fleet list --json\n  fleet list @a")
@any_cars_argument
@json_option
@with_client
def list_cars(client: Fleet, cars: Sequence[str], *, as_json: bool) -> None:
    """List cars: link, readiness, mode, motors and how that is known, who is in control, battery.

    SHOWS STOPS says whether the car's reports show that a stop arrived. All cars drive and stop alike, with or without
    such reports. On a narrow terminal, some columns are left out, such as platform, shows stops and verdict. --json
    prints all of them.
    """
    show_cars(client, resolve_cars(client, cars), as_json=as_json)


def show_cars(client: Fleet, only: Sequence[str] = (), *, as_json: bool = False) -> None:
    """Print the table of cars. If `only` has names, the table has only these cars."""
    cars = client.cars()
    latest: dict[str, dict[str, Reading]] = {car: {} for car in cars}
    for reading in client.get("*/*/*"):  # one query, so that a gateway that hangs delays the list only once
        key = keys.parse(reading.key)
        if key is not None:
            latest.setdefault(key.car, {})[key.topic] = reading
    if not latest:
        raise no_cars(client)
    if missing := [car for car in only if car not in latest]:
        there = f"Connected: {', '.join(sorted(latest))}."
        raise click.ClickException(f"{', '.join(missing)}: not connected. {did_you_mean(missing[0], latest) or there}")
    colors = ask_colors(client.bus, client.name)
    colors = {car: colors.get(car) or car_color(car, index) for index, car in enumerate(sorted(latest))}
    if only:
        latest = {car: latest[car] for car in only}
    newest_s = newest_states(each for car in latest.keys() & cars for each in latest[car].values())
    clocks = clocks_off(client, newest_s)
    rows = [
        {**row_of(car, values, present=car in cars, clock_off_s=clocks.get(car)), "color": hex_color(colors[car])}
        for car, values in sorted(latest.items())
    ]
    for token in client.bus.tokens(keys.replay_token(client.name)):
        session = token.rpartition("/")[2]
        click.echo(f"fleet: {client.name} is a replay of {session}: ages are those of the recording", err=True)
        rows = [{**row, "replay": session} for row in rows]
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    table = [{name: cell_text(name, row) for name in CAR_COLUMNS} for row in rows]
    show_table(CAR_COLUMNS, table, optional=OPTIONAL_CAR_COLUMNS, colors=[row["color"] for row in rows])
    for row in rows:
        if words := describe_clock(row["car"], row["clock_off_s"]):
            click.echo(f"fleet: {words}", err=True)
        for words in row["platform_contradictions"]:
            click.echo(f"fleet: {row['car']} may not be a {row['platform']} car: {words}", err=True)
        if row["doubted"]:
            say(f"fleet: {row['shows_stops_words']}. {describe_end_of_doubt(row['car'])}", err=True)


def row_of(
    car: str, readings: Mapping[str, Reading], *, present: bool = True, clock_off_s: float | None = None
) -> dict[str, Any]:
    """Return the row of a car in `fleet list`, for the table and for JSON.

    readings: the car's latest readings, by topic. present: True if its gateway is on the bus. clock_off_s: how far the
    clock of the gateway's computer is ahead of ours. None if it is not off.
    """
    now = datetime.now(UTC).timestamp() + (clock_off_s or 0.0)
    state = CarState.of_answers(car, readings.items(), now, present=present)
    claimed, why_not_ready = state.claims(now), state.why_not_ready(now)
    link, safety, health = (state.last_word(f"state/{name}") for name in ("link", "safety", "health"))
    battery = state.newest("sensor/battery")
    return {
        "car": car,
        "link": claimed.link.what if link.state or not present else "no answer",
        "reason": link.reason,
        "ready": why_not_ready is None,
        "why_not_ready": why_not_ready or "",
        "waits_for": None if state.current("state/safety") is None else safety.waits_for,
        "unheard": state.is_unheard,
        "unreadable": state.is_unreadable,
        "last_rx_s": round(link.last_rx_s, 3) if link.HasField("last_rx_s") else None,
        "platform": health.platform or None,
        "platform_contradictions": list(health.platform_contradictions),
        "mode": None if state.newest("state/mode") is None else claimed.mode.what,
        "verdict": claimed.mode.basis or None,
        "motion": state.motion.motion or None,
        "driver": safety.lease.holder or None,
        "driver_kind": safety.lease.kind or None,
        "hold": safety.hold.by or None,
        "paused": binding_pause(safety.pauses).by if safety.pauses else None,
        "lent": safety.loan.to or None,
        "estops": [estop.id for estop in safety.estops],
        "motors": None if state.newest("state/safety") is None else claimed.motors.what,
        "motors_basis": claimed.motors.basis or None,
        "claims": {name: claim.as_dict() for name, claim in claimed.by_name.items()},
        "shows_stops": health.shows_stops or None,
        "shows_stops_words": health.shows_stops_words,
        "doubted": health.doubted,
        "out_of_range": list(health.out_of_range),
        "battery_v": None if battery is None else battery.voltage_v,
        "battery_level": None if battery is None else battery.level,
        "battery_age_s": None
        if battery is None
        else round(readings["sensor/battery"].age_s(datetime.fromtimestamp(now, UTC)), 3),
        "clock_off_s": None if clock_off_s is None else round(clock_off_s, 1),
        "stale": state.stale_topics(now),
    }


def cell_text(name: str, row: Mapping[str, Any]) -> str:
    """Return a cell of the table."""
    if name == "battery":
        if row["battery_v"] is None:
            return "-"
        age = f", {row['battery_age_s']:.0f} s old" if "sensor/battery" in row["stale"] else ""
        return f"{row['battery_v']:.2f} V {row['battery_level']}{age}"
    if name == "hold":
        hold = keys.name_of(row["hold"] or "")
        return describe_bars(row["estops"], hold, row["paused"] or "", row["lent"] or "") or "-"
    if name == "driver" and row["driver"]:
        return f"{keys.name_of(row['driver'])} ({row['driver_kind']})"
    if name == "platform" and row["platform_contradictions"]:
        return f"{row['platform']} (contradicted)"
    if name == "link" and row["unheard"]:
        if row["unreadable"]:
            return f"{row['link']} (bytes, no reading)"
        silence = "no reading yet" if row["last_rx_s"] is None else f"silent for {row['last_rx_s']:.0f} s"
        return f"{row['link']} ({silence})"
    if name == "ready":
        return "ready" if row["ready"] else row["why_not_ready"] or "-"
    if name == "motors":
        return _claim_text(row, name)
    if name == "shows stops":
        return "in doubt" if row["doubted"] else _SHOWS.get(row["shows_stops"], "-")
    old = " (stale)" if name in ("link", "mode", "motion") and f"state/{name}" in row["stale"] else ""
    return f"{row[name]}{old}" if row[name] else "-"


def _claim_text(row: Mapping[str, Any], name: str) -> str:
    """Return a claim as the text of a cell: the claim, its basis, and `stale` if it is old."""
    if row[name] is None:
        return "-"
    basis = [row["claims"][name]["basis"], "stale" if "state/safety" in row["stale"] else None]
    return f"{row[name]} ({', '.join(filter(None, basis))})" if any(basis) else str(row[name])


@click.command(
    epilog="\b\nexamples:\n  fleet get red\n  fleet get red/sensor/range\n  fleet get '*/sensor/battery' --json\n"
    "  fleet get red/sensor/range --last 100\n  fleet get '*/sensor/range' --since 30s --csv > range.csv"
)
@click.argument("keyexpr", metavar="KEY", shell_complete=complete_car)
@click.option("-n", "--last", type=Number(int, 1), help="Print the last N values of each key, oldest first.")
@click.option(
    "--since",
    type=Since(history_query.MAX_HISTORY_S),
    help="Print the values since TIME: 30s or 5m ago, a local time (14:05, yesterday 14:05), or a date.",
)
@click.option("--csv", "as_csv", is_flag=True, help="Print one CSV table. KEY must match only one type of message.")
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
    """Print the latest value of every matching reading, or its history (--last, --since).

    `red` means every sensor of red. `*` stands for any single part of a key.
    """
    key_expression = check_key(expand_key(keyexpr, fleet))
    matched = topics_under(key_expression)
    if as_csv and as_json:
        raise click.UsageError("--csv and --json exclude each other: give one of them")
    if as_csv and len(matched) != 1:
        meant = ", ".join(topic.name for topic in matched) or "no message"
        raise click.UsageError(f"--csv needs one message type, but {key_expression} matches {meant}.")
    past = last is not None or since is not None
    why_not = history_query.describe_missing_history(matched) if past else ""
    if why_not:
        raise click.UsageError(why_not)
    with open_observer(connect, fleet, keyexpr) as client:
        readings = client.history(keyexpr, last=last, since_s=since) if past else client.get(keyexpr)
        if not readings:
            within = f" of the last {since:g} s" if since is not None else ""
            raise click.ClickException(
                describe_missing(client, key_expression, f"nothing under {key_expression}{within}")
            )
    _show(readings, csv_of=matched[0] if as_csv else None, as_json=as_json, past=past)
    if past:
        _print_shortfalls(history_query.describe_shortfalls(readings, datetime.now(UTC), last=last, since_s=since))


def _show(readings: Sequence[Reading], *, csv_of: topics.Topic | None, as_json: bool, past: bool) -> None:
    if csv_of is not None:
        click.echo(csv_table.table(readings, csv_of).encode(), nl=False)
        return
    width = max(len(reading.key) for reading in readings)
    for reading in readings:
        click.echo(json_text(reading) if as_json else reading_line(reading, width, past=past))


def _print_shortfalls(lines: Sequence[str]) -> None:
    """Print why there are fewer readings than requested, for at most a few keys."""
    limit = _MAX_SHORTFALL_LINES
    if len(lines) > limit + 1:
        lines = [*lines[:limit], f"and {len(lines) - limit} more likewise"]
    for words in lines:
        say(f"fleet: {words}", err=True)


@click.command(
    epilog="\b\nexamples:\n  fleet watch red\n  fleet watch '*/state/*' --json\n  fleet watch red/event/command\n"
    "  fleet watch '*/sensor/range' --when 'range_m < 0.3'\n  fleet watch red/sensor/light --when left --count 1"
)
@click.argument("keyexpr", metavar="KEY", shell_complete=complete_car)
@click.option(
    "--when", metavar="CONDITION", help="Print only readings for which this is true, such as 'range_m < 0.3'."
)
@click.option("--count", type=Number(int, 1), help="End after N readings.")
@json_option
@bus_options
def watch(keyexpr: str, *, when: str | None, count: int | None, as_json: bool, connect: str | None, fleet: str) -> None:
    """Print new values as they come, until Ctrl-C.

    CONDITION compares fields of one message (range_m < 0.3), with and, or, not and parentheses. A yes/no field needs no
    comparison. A comparison with a value that was not measured is unknown. Only readings for which CONDITION is true
    are shown.
    """
    key_expression = check_key(expand_key(keyexpr, fleet))
    if when is not None:
        KeyCondition.of(when, key_expression)  # raises for a wrong condition
    with open_observer(connect, fleet, keyexpr) as client:
        warn_if_missing(key_expression, client.cars())
        reported = shown = 0
        with client.watch(keyexpr, when=when) as readings:
            for reading in readings:
                click.echo(json_text(reading) if as_json else reading_line(reading))
                if readings.dropped > reported:
                    reported = readings.dropped
                    click.echo(
                        f"fleet: {reported} readings dropped so far: the reader of this output is too slow", err=True
                    )
                shown += 1
                if shown == count:
                    return


@click.command(
    "keys",
    epilog="\b\nexamples:\n  fleet keys\n  fleet keys red\n  fleet keys '*/state/*' --json\n  fleet keys --for 10s",
)
@click.argument("keyexpr", required=False, metavar="[KEY]")
@click.option(
    "--for",
    "look_s",
    type=Duration(600.0),
    default=f"{SURVEY_S:g}s",
    show_default=True,
    help="How long to measure rates.",
)
@json_option
@bus_options
def list_keys(keyexpr: str | None, *, look_s: float, as_json: bool, connect: str | None, fleet: str) -> None:
    """List what the cars, the plan and the recorder publish now: message type, units, rate, age of the newest value.

    A rate is "-" if fewer than two messages came during the measurement. An age is "-" if no message came.
    """
    everything = [f"{fleet}/**", *(f"{fleet}/{service}/**" for service in SURVEYED_SERVICES)]
    expressions = [check_key(expand_key(each, fleet)) for each in ([keyexpr] if keyexpr else everything)]
    with open_observer(connect, fleet, keyexpr or "") as client:
        found = _survey(client, expressions, look_s)
        if not found:
            what = f"under {expressions[0]}" if keyexpr else f"of {keys.describe_fleet(fleet)}"
            raise click.ClickException(describe_missing(client, expressions[0], f"no key {what} is published now"))
    if as_json:
        for each in found:
            click.echo(json.dumps(_key_row(each)))
    else:
        show_table(_KEY_COLUMNS, [_key_cells(each) for each in found])


def _survey(client: Fleet, expressions: Sequence[str], look_s: float) -> list[KeyInfo]:
    """Look at the bus for `look_s`, and return the keys in use."""

    def subscribe(take: Callable[[Sample], None]) -> Callable[[], object]:
        subscribers = [client.bus.subscribe(each, take) for each in expressions]

        def end() -> None:
            for subscriber in subscribers:
                subscriber.undeclare()

        return end

    survey, until = KeySurvey(look_s), time.monotonic() + look_s
    with Watch().begin(subscribe) as stream:
        for each in expressions:
            for reading in client.get(each):
                survey.add(reading, datetime.now(UTC))
        while (left := until - time.monotonic()) > 0:
            coming = stream.within(left)
            if coming is not None:
                survey.add(coming, datetime.now(UTC))
    events = event_keys(client.name, client.cars())
    silent = [key for key in events if any(intersects(each, key) for each in expressions)]
    return survey.keys(silent, datetime.now(UTC))


def _key_row(info: KeyInfo) -> dict[str, Any]:
    topic = info.topic
    return {
        "key": info.key,
        "type": topic.message if topic else None,
        "about": topic.about if topic else None,
        "units": dict(topic.units) if topic else {},
        "rate_hz": None if info.rate_hz is None else round(info.rate_hz, 2),
        "age_s": None if info.age_s is None else round(info.age_s, 3),
        "stale": info.stale,
    }


def _key_cells(info: KeyInfo) -> dict[str, str]:
    stale = " (stale)" if info.stale else ""
    return {
        "key": info.key,
        "type": info.topic.message if info.topic else "-",
        "unit": ", ".join(info.units) or "-",
        "rate": "-" if info.rate_hz is None else f"{info.rate_hz:.1f} Hz",
        "age": "-" if info.age_s is None else f"{info.age_s:.1f} s{stale}",
    }


@click.command(
    epilog="\b\nexamples:\n  fleet wait red/sensor/range 'range_m < 0.3' --timeout 10s\n"
    "  fleet wait '*/sensor/light' 'left or right' --for 2s\n"
    "  fleet wait red/state/link \"state == 'online'\" --timeout 1m && fleet drive red forward\n"
    "  fleet wait --ready && fleet drive all forward\n\n\b\n"
    "Exit codes: 0 the condition is true or the cars are ready, 1 timeout or no fleet, 2 wrong use, 130 Ctrl-C."
)
@click.argument("words", nargs=-1, metavar="KEY CONDITION | --ready [CAR...]", shell_complete=complete_cars)
@click.option(
    "--ready", is_flag=True, help="Wait until these cars are ready. Without names: all cars, the recorder and the plan."
)
@click.option(
    "--timeout",
    "timeout_s",
    type=Duration(_DAY_S),
    help=f"Give up after this time (default: never; with --ready: {READY_WAIT_S:g}s).",
)
@click.option(
    "--for",
    "for_s",
    type=Duration(_DAY_S),
    help="Minimum time for which the condition must be true. With --ready, the same as --timeout.",
)
@json_option
@bus_options
def wait(
    words: tuple[str, ...],
    *,
    ready: bool,
    timeout_s: float | None,
    for_s: float | None,
    as_json: bool,
    connect: str | None,
    fleet: str,
) -> None:
    """Wait until CONDITION is true for a reading of KEY, and print it. The latest one will do, unless it is stale.

    If KEY has a wildcard, one matching key is enough. CONDITION is written as for `fleet watch --when`. With --ready,
    wait for cars instead. A car is ready when its gateway answers and a command to it does not have to wait.
    """
    if ready:
        cars = [car for word in words for car in word.split(",") if car != "all"]
        for name in (fleet, *cars):
            keys.check_name(name.removeprefix("@"))
        if any(car.startswith("@") for car in cars):
            with open_client(connect, fleet) as client:
                cars = resolve_cars(client, cars)
        wait_ready(connect, fleet, cars, timeout_s or for_s or READY_WAIT_S, as_json=as_json)
        return
    if len(words) != 2:
        raise click.UsageError("give a KEY and one CONDITION in quotes, as: red/sensor/range 'range_m < 0.3'")
    keyexpr, condition = words
    key_expression = expand_key(keyexpr, fleet)
    KeyCondition.of(condition, key_expression)  # raises for a wrong condition
    if for_s is not None and timeout_s is not None and for_s >= timeout_s:
        raise click.UsageError(f"--for {for_s:g} s must be shorter than --timeout {timeout_s:g} s")
    with open_observer(connect, fleet, keyexpr) as client:
        warn_if_missing(key_expression, client.cars())
        try:
            reading = client.wait(keyexpr, condition, timeout_s=timeout_s, for_s=for_s or 0.0)
        except NotInTime as late:
            raise click.ClickException(str(late)) from None
    click.echo(json_text(reading) if as_json else reading_line(reading))

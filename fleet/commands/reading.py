"""`fleet list, get, watch`: what cars say. Nothing here makes a car do anything."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import click

from fleet.client import Fleet
from fleet.commands.common import json_option, with_client
from fleet.readings import Reading
from schemas import keys, topics
from schemas.bus import canon


def _checked(_: click.Context, __: click.Parameter, keyexpr: str) -> str:
    """A key expression that can be asked; wrong use is found before anyone is."""
    try:
        canon(keys.expand(keyexpr))
    except keys.BadKey as error:
        raise click.UsageError(str(error)) from None
    return keyexpr


_HEADER: Final = frozenset({"stamp", "timestamp", "car", "seq", "boot_id"})
_COLUMNS: Final = ("car", "link", "mode", "verdict", "motion", "hold", "battery")


@click.command("list", epilog="\b\nexample:\n  fleet list --json")
@json_option
@with_client
def list_cars(client: Fleet, *, as_json: bool) -> None:
    """The cars on the bus: link, mode and how sure that is, motion, who holds the car, battery."""
    cars = client.cars()
    said: dict[str, dict[str, Reading]] = {car: {} for car in cars}
    for reading in client.get("*/*/*"):  # one query: a gateway that hangs is waited for once
        key = keys.parse(reading.key)
        if key is not None:
            said.setdefault(key.car, {})[key.topic] = reading
    if not said:
        raise click.ClickException(f"no car of fleet {client.name} is on the bus at {client.bus.endpoint}")
    rows = [_row(car, values) for car, values in sorted(said.items())]
    if as_json:
        for row in rows:
            click.echo(json.dumps(row))
        return
    table = [{name: name.upper() for name in _COLUMNS}] + [
        {name: _shown(name, row) for name in _COLUMNS} for row in rows
    ]
    widths = {name: max(len(row[name]) for row in table) for name in _COLUMNS}
    for cells in table:
        click.echo("  ".join(cells[name].ljust(widths[name]) for name in _COLUMNS).rstrip())


def _row(car: str, readings: Mapping[str, Reading]) -> dict[str, Any]:
    values = {topic: reading.value for topic, reading in readings.items()}
    measured = readings.get("sensor/battery")
    link, mode, motion = (values.get(f"state/{name}") for name in ("link", "mode", "motion"))
    safety, battery = values.get("state/safety"), values.get("sensor/battery")
    return {
        "car": car,
        "link": link.state if link else "no answer",
        "reason": link.reason if link else "",
        "mode": mode.asked if mode else None,
        "verdict": mode.verdict if mode else None,
        "motion": motion.motion if motion else None,
        "hold": safety.hold.by if safety and safety.HasField("hold") else None,
        "estops": [estop.id for estop in safety.estops] if safety else [],
        "motors": safety.motors if safety else None,
        "battery_v": battery.voltage_v if battery else None,
        "battery_level": battery.level if battery else None,
        "battery_age_s": round(measured.age_s(), 3) if measured else None,
        "stale": sorted(topic for topic, reading in readings.items() if reading.stale()),
    }


def _shown(name: str, row: Mapping[str, Any]) -> str:
    if name == "battery":
        if row["battery_v"] is None:
            return "-"
        age = f", {row['battery_age_s']:.0f} s old" if "sensor/battery" in row["stale"] else ""
        return f"{row['battery_v']:.2f} V {row['battery_level']}{age}"
    if name == "hold" and row["estops"]:
        return f"e-stop {' '.join(row['estops'])}"
    old = " (stale)" if name in ("link", "mode", "motion") and f"state/{name}" in row["stale"] else ""
    return f"{row[name]}{old}" if row[name] else "-"


@click.command(
    epilog="\b\nexamples:\n  fleet get red\n  fleet get red/sensor/range\n  fleet get '*/sensor/battery' --json"
)
@click.argument("keyexpr", callback=_checked)
@json_option
@with_client
def get(client: Fleet, keyexpr: str, *, as_json: bool) -> None:
    """The latest value of every reading that matches KEYEXPR; `red` is every sensor of red, * is any one part."""
    readings = client.get(keyexpr)
    if not readings:
        written = client.expression(keyexpr)
        raise click.ClickException(f"nothing under {written}; {_what_there_is(client, written)}")
    width = max(len(reading.key) for reading in readings)
    for reading in readings:
        click.echo(_json(reading) if as_json else _line(reading, width))


def _what_there_is(client: Fleet, expression: str) -> str:
    """The readings of the car that was meant, or else the cars."""
    cars = client.cars()
    key = keys.parse(expression)
    if key is not None and key.car in cars:
        begin = len(f"{client.name}/{key.car}/")
        found = [reading.key[begin:] for reading in client.get(f"{client.name}/{key.car}/*/*")]
        return f"{key.car} has {', '.join(found)}" if found else f"{key.car} says nothing"
    return f"the cars on the bus are: {', '.join(cars)}" if cars else "there is no car on the bus"


@click.command(
    epilog="\b\nexamples:\n  fleet watch red\n  fleet watch '*/state/*' --json\n  fleet watch red/event/command"
)
@click.argument("keyexpr", callback=_checked)
@json_option
@with_client
def watch(client: Fleet, keyexpr: str, *, as_json: bool) -> None:
    """Readings that match KEYEXPR as they are published, until Ctrl-C."""
    _warn_if_missing(client.expression(keyexpr), client.cars())
    told = 0
    with client.watch(keyexpr) as readings:
        for reading in readings:
            click.echo(_json(reading) if as_json else _line(reading))
            if readings.dropped > told:
                told = readings.dropped
                click.echo(f"fleet: {told} readings dropped so far: what reads this is too slow", err=True)


def _warn_if_missing(expression: str, cars: Sequence[str]) -> None:
    """A watch of a car that is not there waits for it; a misspelt name should not go unnoticed."""
    key = keys.parse(expression)
    if key is not None and not set(key.car) & set("*$@") and key.car not in cars:
        there = f"there are: {', '.join(cars)}" if cars else "there is none"
        click.echo(f"fleet: no car {key.car} on the bus yet ({there}); waiting", err=True)


def _json(reading: Reading) -> str:
    time = reading.time.isoformat(timespec="microseconds").replace("+00:00", "Z")
    age_s, stale = round(reading.age_s(), 3), reading.stale()
    return json.dumps({"key": reading.key, "time": time, "age_s": age_s, "stale": stale, "value": reading.as_dict()})


def _line(reading: Reading, width: int = 0) -> str:
    topic = topics.of_key(reading.key)
    units = topic.units if topic is not None else {}
    fields = [
        f"{name}={_value(value)}{_unit(units.get(name, ''))}"
        for name, value in reading.as_dict().items()
        if name not in _HEADER and value not in ("", [], {})
    ]
    age = f"{reading.age_s():.1f} s ago{' (stale)' if reading.stale() else ''}"
    return f"{reading.key:<{width}}  {'  '.join(fields)}  {age}"


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _unit(unit: str) -> str:
    return f" {unit}" if unit not in ("", "1") else ""

"""How readings are shown: one line, one JSON object, a table."""

import json
from collections.abc import Mapping, Sequence
from typing import Final

import click

from fleet.client.reading import Reading
from fleet.recording.tools.csv_table import iso
from schemas import topics

_HEADER: Final = frozenset({"stamp", "timestamp", "car", "seq", "boot_id"})


def json_text(reading: Reading) -> str:
    """One object: key, time, age, whether it is stale, and the message."""
    age_s, stale = round(reading.age_s(), 3), reading.stale()
    whole = {"key": reading.key, "time": iso(reading.time), "age_s": age_s, "stale": stale, "value": reading.as_dict()}
    return json.dumps(whole)


def line(reading: Reading, width: int = 0, *, past: bool = False) -> str:
    """Key (padded to `width`), fields with their units, age; of the `past` nobody expects that it is fresh."""
    topic = topics.of_key(reading.key)
    units = topic.units if topic is not None else {}
    fields = [
        f"{name}={_value(value)}{_unit(units.get(name, ''))}"
        for name, value in reading.as_dict().items()
        if name not in _HEADER and value not in ("", [], {})
    ]
    age = f"{reading.age_s():.1f} s ago{' (stale)' if not past and reading.stale() else ''}"
    return f"{reading.key:<{width}}  {'  '.join(fields)}  {age}"


def show_table(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> None:
    """Columns as wide as they need to be; the header is bold on a terminal."""
    widths = {name: max(len(row[name]) for row in ({name: name}, *rows)) for name in columns}
    header = "  ".join(name.upper().ljust(widths[name]) for name in columns).rstrip()
    click.echo(click.style(header, bold=True))
    for row in rows:
        click.echo("  ".join(row[name].ljust(widths[name]) for name in columns).rstrip())


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _unit(unit: str) -> str:
    return f" {unit}" if unit not in ("", "1") else ""

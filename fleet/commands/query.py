"""`fleet query`: SQL over the tables of all sessions."""

import csv
import io
import json
import sys
from pathlib import Path
from typing import Any, Final

import click

from fleet.commands.options import json_option
from fleet.commands.output import aligned, echo_safely, progress_bar
from fleet.recording.session_lookup import sessions_in, sessions_place

MAX_CELL: Final = 60
"""Maximum characters of a cell on a terminal. --csv and --json have all of it."""


@click.command(
    epilog="""\b
examples:
  fleet query --tables
  fleet query "SELECT session, car, min(range_m) FROM sensor_range GROUP BY ALL"
  fleet query "SELECT car, mode, count(*) FROM sensor_line_context GROUP BY ALL" --csv > modes.csv"""
)
@click.argument("sql", required=False, metavar="[SQL]")
@click.argument("directory", required=False, type=click.Path(path_type=Path), metavar="[DIR]")
@click.option("--tables", "tables", is_flag=True, help="List the tables and their columns.")
@click.option("--csv", "as_csv", is_flag=True, help="Write CSV.")
@json_option
def query(sql: str | None, directory: Path | None, *, tables: bool, as_csv: bool, as_json: bool) -> None:
    """Answer an SQL question about every session in DIR (default: sessions). SQL: that of DuckDB, or - for stdin.

    Each topic is a table, such as sensor_range or event_command, with the columns of `fleet sessions export` and the
    session. Tables named ..._context add mode, motion, driver and plan of that moment. Times are UTC.
    """
    from fleet.recording.catalog import BadQuery, Catalog
    from fleet.recording.tools.table_formats import FormatMissing

    if (sql is None) is not tables or (as_csv and as_json):
        raise click.UsageError("give one question, or --tables; and --csv or --json, not both")
    place = directory or sessions_place()
    if not place.is_dir():
        raise click.ClickException(f"There is no directory {place}. `fleet up` records everything.")
    text = sys.stdin.read() if sql == "-" else sql or ""
    with progress_bar("tables", sum(1 for _ in sessions_in(place))) as advance:
        try:
            catalog = Catalog(place, on_session=lambda _: advance(1))
        except FormatMissing as error:
            raise click.ClickException(str(error)) from None
    for name, words in catalog.damage.items():
        echo_safely(f"{name}: only what is intact was read: {words}", err=True)
    if tables:
        rows = [(name, ", ".join(columns)) for name, columns in catalog.tables().items()]
        _write(("table", "columns"), rows, as_csv=as_csv, as_json=as_json)
        return
    try:
        answer = catalog.query(text)
    except BadQuery as error:
        raise click.UsageError(str(error)) from None
    _write(tuple(answer.column_names), _rows(answer), as_csv=as_csv, as_json=as_json)


def _rows(answer: Any) -> list[tuple[Any, ...]]:
    columns = [column.to_pylist() for column in answer.columns]
    return list(zip(*columns, strict=True))


def _write(header: tuple[str, ...], rows: list[tuple[Any, ...]], *, as_csv: bool, as_json: bool) -> None:
    if as_json:
        for row in rows:
            click.echo(json.dumps(dict(zip(header, row, strict=True)), default=_plain))
    elif as_csv:
        out = io.StringIO()
        writer = csv.writer(out)
        writer.writerow(header)
        writer.writerows([["" if cell is None else _plain(cell) for cell in row] for row in rows])
        click.echo(out.getvalue(), nl=False)
    elif rows:
        shown = [tuple(_short(cell) for cell in row) for row in rows]
        for line in aligned([header, *shown]):
            echo_safely(line)
    else:
        click.echo("No rows.", err=True)


def _short(cell: Any) -> str:
    text = "-" if cell is None else f"{cell:.6g}" if isinstance(cell, float) else str(_plain(cell))
    return text if len(text) <= MAX_CELL else f"{text[: MAX_CELL - 1]}…"


def _plain(value: Any) -> Any:
    """Return a value as text where JSON has no word for it. Times are UTC."""
    if hasattr(value, "isoformat"):
        return value.isoformat().replace("+00:00", "Z")
    if isinstance(value, bytes):
        return value.hex()
    return value if isinstance(value, str | int | float | bool) else str(value)

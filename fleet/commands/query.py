"""`fleet query`: answers SQL questions about all sessions."""

import json
import math
import sys
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import click

from fleet.commands.options import json_option
from fleet.commands.output import MAX_CELL, ROWS_AT_ONCE, aligned, echo_csv, echo_safely, progress_bar
from fleet.commands.params import existing_sessions_place
from fleet.recording.session_lookup import sessions_in
from schemas.printable import printable


@click.command(
    epilog="""\b
examples:
  fleet query --tables
  fleet query "SELECT session, car, min(range_m) FROM sensor_range GROUP BY ALL"
  fleet query "SELECT car, mode, count(*) FROM sensor_line_context GROUP BY ALL" --csv > modes.csv

Exit codes: 0 done, 1 there is no DIR, none of its sessions could be read, or no disk has room for the tables,
2 wrong use."""
)
@click.argument("sql", required=False, metavar="[SQL]")
@click.argument("directory", required=False, type=click.Path(path_type=Path), metavar="[DIR]")
@click.option("--tables", "tables", is_flag=True, help="List the tables and their columns.")
@click.option("--csv", "as_csv", is_flag=True, help="Write CSV.")
@json_option
def query(sql: str | None, directory: Path | None, *, tables: bool, as_csv: bool, as_json: bool) -> None:
    """Answer an SQL question about all sessions in DIR (default: sessions, else as in the fleet file here).

    With - for SQL, the command reads it from stdin. SQL is the dialect of DuckDB. Each topic is a table, such as
    sensor_range or event_command, with the columns of `fleet sessions export` and the column session. Tables named
    ..._context add the mode, motion, driver and plan at that time. Times are UTC. The sender of a command is a process
    (tom@host-4711): person_of(sender) is the person. Sessions that are not whole are listed, and only their intact part
    is used.
    """
    from fleet.recording.catalog import BadQuery, Catalog, QueryFailed
    from fleet.recording.tools.table_formats import FormatMissing

    # With --tables there is no question, so a single argument is DIR.
    if tables and directory is None and sql is not None and (Path(sql).is_dir() or len(sql.split()) == 1):
        directory, sql = Path(sql), None
    has_both_or_neither = (sql is not None) == tables
    if has_both_or_neither or (as_csv and as_json):
        raise click.UsageError("give either a question or --tables, and at most one of --csv and --json")
    place = existing_sessions_place(directory)
    text = sys.stdin.read() if sql == "-" else sql or ""
    try:
        count = sum(1 for _ in sessions_in(place))
    except OSError as error:
        raise click.ClickException(f"{place} cannot be listed: {error.strerror}.") from None
    with progress_bar("tables", count) as advance:
        try:
            catalog = Catalog(place, on_session=lambda _: advance(1))
        except (FormatMissing, QueryFailed) as error:
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
    except QueryFailed as error:
        raise click.ClickException(str(error)) from None
    _write(tuple(answer.column_names), _rows(answer), as_csv=as_csv, as_json=as_json)
    for name, left_out in catalog.left_out().items():
        for line in left_out.words():
            echo_safely(f"{name}: not in the tables: {line}", err=True)
    for name, lines in catalog.nulled().items():
        for line in lines:
            echo_safely(f"{name}: null in the tables: {line}", err=True)
    if catalog.damage and not catalog.sessions:
        raise click.exceptions.Exit(1)


def _rows(answer: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the rows, converted batch by batch: a million rows are small in Arrow, but large as Python objects."""
    for batch in answer.to_batches(max_chunksize=ROWS_AT_ONCE):
        yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)


def _write(header: tuple[str, ...], rows: Iterable[tuple[Any, ...]], *, as_csv: bool, as_json: bool) -> None:
    if as_json:
        for row in rows:
            click.echo(json.dumps({name: _plain(cell) for name, cell in zip(header, row, strict=True)}))
    elif as_csv:
        echo_csv(header, ([_cell(cell) for cell in row] for row in rows))
    else:
        remaining = iter(rows)
        if (first := next(remaining, None)) is None:
            click.echo("No rows.", err=True)
            return
        limit = MAX_CELL if sys.stdout.isatty() else sys.maxsize
        titles = tuple(printable(name, limit) for name in header)
        texts = (tuple(_text(cell, limit) for cell in row) for row in chain((first,), remaining))
        for line in aligned(chain((titles,), texts)):
            echo_safely(line)


def _text(cell: Any, limit: int) -> str:
    text = "-" if cell is None else f"{cell:.6g}" if isinstance(cell, float) else str(_cell(cell))
    return printable(text, limit)


def _cell(value: Any) -> Any:
    """Return a value for one cell. Lists and structs become JSON."""
    plain = _plain(value)
    return json.dumps(plain) if isinstance(plain, dict | list) else plain


def _plain(value: Any) -> Any:
    """Return a value as a JSON value, or as text if JSON has none. Times are UTC.

    NaN and infinite numbers become None.
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return None
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    if hasattr(value, "isoformat"):
        return value.isoformat().replace("+00:00", "Z")
    if isinstance(value, bytes):
        return value.hex()
    return value if isinstance(value, str | int | float | bool) else str(value)

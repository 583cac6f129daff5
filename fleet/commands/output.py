"""Writes readings as lines or as JSON objects, and prints tables, CSV and progress bars."""

import csv
import io
import json
import os
import shutil
import sys
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import chain, islice, repeat
from typing import Any, Final, TypeVar

import click

from fleet.client.reading import Reading
from fleet.column_widths import fit_columns
from fleet.recording.tools.csv_table import iso
from schemas import topics
from schemas.colors import parse_color
from schemas.printable import printable_lines
from schemas.process import stdio

PROGRESS_BAR_DELAY_S: Final = 1.0
_PROGRESS_STEP: Final = 1024
ROWS_AT_ONCE: Final = 1024
"""Number of rows in a block. `aligned` and `echo_csv` take blocks, because a million rows would fill the memory."""
MAX_CELL: Final = 60
"""Maximum characters of a cell with text from a recording. Anybody may have written that text, and it may be long."""
_HEADER_FIELDS: Final = frozenset({"stamp", "timestamp", "car", "seq", "boot_id"})

T = TypeVar("T")


def json_text(reading: Reading) -> str:
    """Return a JSON object: key, time, age, staleness, and the message."""
    age_s, stale = round(reading.age_s(), 3), reading.stale()
    whole = {"key": reading.key, "time": iso(reading.time), "age_s": age_s, "stale": stale, "value": reading.as_dict()}
    return json.dumps(whole)


def reading_line(reading: Reading, width: int = 0, *, past: bool = False) -> str:
    """Return a line: key (padded to `width`), fields with units, age. With `past`, leave out the staleness."""
    topic = topics.of_key(reading.key)
    units = topic.units if topic is not None else {}
    fields = [
        f"{name}={_value(value)}{_unit(units.get(name, ''))}"
        for name, value in reading.as_dict().items()
        if name not in _HEADER_FIELDS and value not in ("", [], {})
    ]
    age = f"{reading.age_s():.1f} s ago{' (stale)' if not past and reading.stale() else ''}"
    return f"{reading.key:<{width}}  {'  '.join(fields)}  {age}"


def show_table(
    columns: Sequence[str],
    rows: Sequence[Mapping[str, str]],
    *,
    optional: Sequence[str] = (),
    colors: Sequence[str] = (),
) -> None:
    """Print a table with aligned columns and a bold header. On a terminal, it is not wider than the terminal.

    colors: the color of each row, as #rrggbb. On a terminal, each row begins with a dot of its color.
    """
    has_dots = bool(colors) and stdio.shows_colors(sys.stdout)
    dots = [f"{_dot(color)} " for color in colors] if has_dots else [""] * len(rows)
    margin = "  " if has_dots else ""
    widths = {name: max(len(row[name]) for row in ({name: name}, *rows)) for name in columns}
    if sys.stdout.isatty() or "COLUMNS" in os.environ:  # a pipe gets every column
        widths = fit_columns(widths, shutil.get_terminal_size().columns - len(margin), optional)
    header = "  ".join(name.upper().ljust(width) for name, width in widths.items()).rstrip()
    click.echo(f"{margin}{click.style(header, bold=True)}")
    for row, dot in zip(rows, dots, strict=True):
        cells = "  ".join(_shortened(row[name], width) for name, width in widths.items())
        click.echo(f"{dot}{cells.rstrip()}")


def aligned(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield one line for each row, with aligned columns.

    The rows are read in blocks of ROWS_AT_ONCE. A later block may make a column wider, but never narrower.
    """
    remaining = iter(rows)
    widths: Iterable[int] = repeat(0)
    while block := list(islice(remaining, ROWS_AT_ONCE)):
        columns = zip(*block, strict=True)
        widths = [max(width, *map(_width, column)) for width, column in zip(widths, columns, strict=False)]
        for row in block:
            cells = zip(row, widths, strict=True)
            yield "  ".join(cell + " " * (width - _width(cell)) for cell, width in cells).rstrip()


def _width(text: str) -> int:
    """Return the number of terminal columns that a text fills. A Chinese character or an emoji fills two."""
    if text.isascii():
        return len(text)
    wide = sum(unicodedata.east_asian_width(each) in "WF" for each in text)
    return len(text) + wide - sum(unicodedata.combining(each) > 0 for each in text)


def echo_safely(text: str, *, err: bool = False) -> None:
    """Print text of which strangers may have written a part. Control characters are printed as escapes."""
    click.echo(printable_lines(text), err=err)


def echo_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a CSV table (RFC 4180), a block of rows at a time. A value of None becomes an empty cell.

    On a terminal, control characters are printed as escapes. Files and pipes get the cells unchanged.
    """
    on_terminal = sys.stdout.isatty()
    remaining = chain((header,), rows)
    while block := [["" if cell is None else cell for cell in row] for row in islice(remaining, ROWS_AT_ONCE)]:
        lines = io.StringIO(newline="")
        csv.writer(lines, lineterminator="\n" if on_terminal else "\r\n").writerows(block)
        text = lines.getvalue()
        click.echo(printable_lines(text) if on_terminal else text, nl=False)


def _dot(color: str) -> str:
    """Return a colored dot. It has one of 6 x 6 x 6 colors, because not every terminal has 24-bit colors."""
    red, green, blue = (round(part / 51) for part in parse_color(color))
    return click.style("●", fg=16 + 36 * red + 6 * green + blue)


def _shortened(text: str, width: int) -> str:
    return text.ljust(width) if len(text) <= width else f"{text[: width - 1]}…"


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on a terminal after a second, if the total is known.

    Yield a function. Call it with the number of items done since the last call.
    """
    bar: Any = None
    began = time.monotonic()
    done = 0
    with ExitStack() as stack:

        def advance(count: int) -> None:
            nonlocal bar, done
            done += count
            if bar is not None:
                bar.update(count)
            elif total and sys.stderr.isatty() and time.monotonic() - began > PROGRESS_BAR_DELAY_S:
                bar = stack.enter_context(click.progressbar(length=total, label=label, file=sys.stderr))
                bar.update(done)

        yield advance


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _unit(unit: str) -> str:
    """Return a unit with the blank before it. Empty for a field without a unit, or with unit 1 (a share)."""
    return f" {unit}" if unit not in ("", "1") else ""


def with_progress(label: str, total: int | None) -> Callable[[Iterable[T]], Iterator[T]]:
    """Return a function that passes on items and shows a progress bar for them."""

    def pass_on(items: Iterable[T]) -> Iterator[T]:
        with progress_bar(label, total) as advance:
            for count, item in enumerate(items, 1):
                yield item
                if count % _PROGRESS_STEP == 0:
                    advance(_PROGRESS_STEP)

    return pass_on

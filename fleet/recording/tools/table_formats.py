"""Writes tables as CSV with the standard library, or as Parquet and into memory with pyarrow.

Times are marked as UTC: `2026-03-14T15:16:17.123456789Z` in CSV, `timestamp[ns, UTC]` in memory. Parquet has
microseconds by default, because DuckDB cannot subtract times in nanoseconds (docs/explanation/measurements.md#mcap).
pyarrow is imported only when it is needed.
"""

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, ClassVar, Final, Literal, Protocol

from fleet.recording.tools.tables import Column, ColumnKind, Values
from schemas.picklable import Picklable
from schemas.suggestion import how_to_install

MAX_ARROW_NS: Final = 2**63 - 1
"""Last time that 64 bits of nanoseconds can hold: in the year 2262. The first one is as long before 1970."""
MAX_CACHED_SECONDS: Final = 4096
"""Maximum number of seconds that are cached as text."""


TimeUnit = Literal["us", "ns"]
"""Unit of the times of a table."""


class FormatMissing(Picklable, ImportError):
    """A package of the extra `analysis` is not installed. The message says how to install it."""

    def __init__(self, package: str) -> None:
        super().__init__(f"{package} is not installed. Type: {how_to_install('analysis')}")


class Sink(Protocol):
    """One table to fill. Every method may raise OSError."""

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""

    @property
    def undated(self) -> int:
        """Number of times that the format cannot hold. They are null."""

    def close(self) -> None:
        """End the table."""

    def discard(self) -> None:
        """Remove the table, complete or not."""


class FileSink(Sink, Protocol):
    """One table to write to a file."""

    ending: ClassVar[str]

    def __init__(self, path: Path, columns: Sequence[Column]) -> None: ...


class CsvSink:
    """CSV table (RFC 4180) with a header. Missing values are empty, lists and maps JSON, bytes hexadecimal."""

    ending: ClassVar[str] = ".csv"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._path = path
        self._file = _part(path).open("w", encoding="utf-8", newline="")
        self.undated = 0
        self._writer = csv.writer(self._file)
        self._writer.writerow([column.name for column in columns])
        self._columns = columns

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""
        cells = csv_cells(self._columns, values, self._count_undated)
        self._writer.writerows(cells)

    def close(self) -> None:
        """End the file, and give it its name."""
        self._file.close()
        _part(self._path).replace(self._path)

    def discard(self) -> None:
        """Remove the file."""
        _remove(self._file, self._path)

    def _count_undated(self, count: int) -> None:
        self.undated += count


def _part(path: Path) -> Path:
    """Return the name that a file has until it is complete."""
    return path.with_name(f"{path.name}.part")


def _remove(file: IO[Any], path: Path) -> None:
    with suppress(OSError):  # the disk has failed, which is why the file is removed
        file.close()
    for each in (_part(path), path):
        each.unlink(missing_ok=True)


def csv_cells(
    columns: Sequence[Column], values: Sequence[Values], undated: Callable[[int], None] = lambda _: None
) -> Iterator[tuple[Any, ...]]:
    """Return the rows of a CSV table from the values of its columns. `undated` gets the number of bad times."""
    for column, given in zip(columns, values, strict=True):
        if column.kind is ColumnKind.TIME and (bad := sum(_text_of_time(each) is None for each in _suspects(given))):
            undated(bad)
    texts = [_TO_TEXT.get(column.kind) for column in columns]
    return zip(
        *(column if text is None else text(column) for text, column in zip(texts, values, strict=True)), strict=True
    )


class _SecondTexts(dict[int, str]):
    """Cache of seconds since the epoch as text."""

    def __missing__(self, second: int) -> str:
        if len(self) >= MAX_CACHED_SECONDS:
            self.clear()
        words = self[second] = datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        return words


def _times(column: Values) -> Values:
    seconds = _SecondTexts()
    try:
        return [None if ns is None else f"{seconds[ns // 1_000_000_000]}.{ns % 1_000_000_000:09d}Z" for ns in column]
    except (OverflowError, ValueError, OSError):  # some are not dates, because the clock of another writer was wrong
        return [None if ns is None else _text_of_time(ns) for ns in column]


def _text_of_time(ns: int) -> str | None:
    try:
        words = datetime.fromtimestamp(ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return None
    return f"{words}.{ns % 1_000_000_000:09d}Z"


def _suspects(column: Values) -> Values:
    """Return the times that may have no text."""
    return [ns for ns in column if ns is not None and not 0 <= ns <= MAX_ARROW_NS]


def _each(text: Callable[[Any], str]) -> Callable[[Values], Values]:
    return lambda column: [None if value is None else text(value) for value in column]


_TO_TEXT: Final[dict[ColumnKind, Callable[[Values], Values]]] = {
    ColumnKind.BOOL: lambda column: [None if value is None else "true" if value else "false" for value in column],
    ColumnKind.BYTES: _each(bytes.hex),
    ColumnKind.TIME: _times,
    ColumnKind.LIST: _each(json.dumps),
    ColumnKind.MAP: _each(json.dumps),
}
"""Converter to text by kind of column. The csv module formats the other kinds itself."""


def import_pyarrow() -> Any:
    """Return pyarrow. Raises FormatMissing if it is not installed."""
    try:
        import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
    except ImportError:
        raise FormatMissing("pyarrow") from None
    return pa


class ArrowSink:
    """Arrow table in memory. The metadata of a field contains its `unit`. Raises FormatMissing without pyarrow."""

    def __init__(self, columns: Sequence[Column], time_unit: TimeUnit = "ns") -> None:
        pa = import_pyarrow()
        kinds = {
            ColumnKind.FLOAT: pa.float64(),
            ColumnKind.INT: pa.int64(),
            ColumnKind.UINT: pa.uint64(),
            ColumnKind.BOOL: pa.bool_(),
            ColumnKind.BYTES: pa.binary(),
            ColumnKind.TIME: pa.timestamp("ns", "UTC"),
        }
        made = {ColumnKind.LIST: pa.list_, ColumnKind.MAP: lambda item: pa.map_(pa.string(), item)}
        time = pa.timestamp(time_unit, "UTC")
        self._in_us = time_unit == "us"
        self._types = [
            made[column.kind](kinds.get(column.item, pa.string()))
            if column.kind in made
            else time
            if column.kind is ColumnKind.TIME
            else kinds.get(column.kind, pa.string())
            for column in columns
        ]
        self._maps = [column.kind is ColumnKind.MAP for column in columns]
        self._times = [column.kind is ColumnKind.TIME for column in columns]
        self._time_lists = [column.kind is ColumnKind.LIST and column.item is ColumnKind.TIME for column in columns]
        self._pa = pa
        self._batches: list[Any] = []
        self.undated = 0
        self.schema = pa.schema(
            pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)
            for column, kind in zip(columns, self._types, strict=True)
        )

    def add(self, values: Sequence[Values]) -> None:
        """Add rows: the values of each column."""
        self._batches.append(self.batch(values))

    def batch(self, values: Sequence[Values]) -> Any:
        """Return rows as an Arrow record batch."""
        shapes = zip(self._types, self._maps, self._times, self._time_lists, values, strict=True)
        arrays = [
            self._pa.array(
                _items(column)
                if is_map
                else self._time(column)
                if is_time
                else [None if value is None else self._held(value) for value in column]
                if is_time_list
                else column,
                kind,
            )
            for kind, is_map, is_time, is_time_list, column in shapes
        ]
        return self._pa.RecordBatch.from_arrays(arrays, schema=self.schema)

    def _time(self, times: Values) -> Values:
        held = self._held(times)
        return _microseconds(held) if self._in_us else held

    def _held(self, times: Values) -> Values:
        """Return times with None for those beyond 64 bits."""
        if all(ns is None or -MAX_ARROW_NS <= ns <= MAX_ARROW_NS for ns in times):
            return times
        held = [None if ns is None or not -MAX_ARROW_NS <= ns <= MAX_ARROW_NS else ns for ns in times]
        self.undated += held.count(None) - times.count(None)
        return held

    def table(self) -> Any:
        """Return the rows as a pyarrow.Table."""
        return self._pa.Table.from_batches(self._batches, self.schema)

    def close(self) -> None:
        """Do nothing: the rows stay in memory."""

    def discard(self) -> None:
        """Forget the rows."""
        self._batches.clear()


def _items(column: Values) -> Values:
    return [None if value is None else list(value.items()) for value in column]


def _microseconds(column: Values) -> Values:
    return [None if ns is None else ns // 1000 for ns in column]


class ParquetSink:
    """Parquet table, compressed with zstd. Its times are in microseconds, rounded down."""

    ending: ClassVar[str] = ".parquet"
    time_unit: ClassVar[TimeUnit] = "us"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._arrow = ArrowSink(columns, self.time_unit)
        from pyarrow import parquet

        self._path = path
        self._file = _part(path).open("wb")
        self._writer = parquet.ParquetWriter(self._file, self._arrow.schema, compression="zstd")

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""
        self._writer.write_batch(self._arrow.batch(values))

    def close(self) -> None:
        """End the file, and give it its name."""
        try:
            self._writer.close()
        finally:
            self._file.close()
        _part(self._path).replace(self._path)

    def discard(self) -> None:
        """Remove the file."""
        # An open writer would still write its footer when it is garbage-collected.
        with suppress(OSError):
            self._writer.close()
        _remove(self._file, self._path)

    @property
    def undated(self) -> int:
        """Number of times that the format cannot hold. They are null."""
        return self._arrow.undated


class ParquetNsSink(ParquetSink):
    """Parquet table with times in nanoseconds."""

    time_unit: ClassVar[TimeUnit] = "ns"


FORMATS: Final[dict[str, type[FileSink]]] = {"csv": CsvSink, "parquet": ParquetSink}

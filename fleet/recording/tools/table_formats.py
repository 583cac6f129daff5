"""Writes tables as CSV with the standard library, or as Parquet with pyarrow, imported only then.

Times are UTC with nanoseconds and without a zone, because readers treat zones differently. pandas, DuckDB and Polars
all parse `2026-03-14 15:16:17.123456789` as a time.
"""

import csv
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

from fleet.recording.tools.tables import Column, ColumnKind, Values

MAX_CACHED_SECONDS: Final = 4096
"""Maximum seconds cached as text."""


class FormatMissing(Exception):
    """The package of a format is not installed. The message says how to install it."""


class Sink(Protocol):
    """One table to write; every method may raise OSError."""

    ending: ClassVar[str]

    def __init__(self, path: Path, columns: Sequence[Column]) -> None: ...

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""

    def close(self) -> None:
        """End the file."""


class CsvSink:
    """CSV table (RFC 4180) with a header. Missing values are empty, lists and maps JSON, bytes hexadecimal."""

    ending: ClassVar[str] = ".csv"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow([column.name for column in columns])
        self._texts = [_TO_TEXT.get(column.kind) for column in columns]

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""
        columns = [column if text is None else text(column) for text, column in zip(self._texts, values, strict=True)]
        self._writer.writerows(zip(*columns, strict=True))

    def close(self) -> None:
        """End the file."""
        self._file.close()


class _SecondTexts(dict[int, str]):
    """Cache of seconds since the epoch as text."""

    def __missing__(self, second: int) -> str:
        if len(self) >= MAX_CACHED_SECONDS:
            self.clear()
        words = self[second] = datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%d %H:%M:%S")
        return words


def _times(column: Values) -> Values:
    seconds = _SecondTexts()
    try:
        return [None if ns is None else f"{seconds[ns // 1_000_000_000]}.{ns % 1_000_000_000:09d}" for ns in column]
    except (OverflowError, ValueError, OSError):
        return column  # not a date: the clock of another writer was wrong


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


class ParquetSink:
    """Parquet table, compressed with zstd. The metadata of a field contains its `unit`."""

    ending: ClassVar[str] = ".parquet"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
            import pyarrow.parquet as pq  # type: ignore[import-untyped]  # likewise
        except ImportError:
            raise FormatMissing(
                "Parquet needs pyarrow. Type: pip install 'zenoh-car-fleet[analysis]', or use --csv"
            ) from None
        kinds = {
            ColumnKind.FLOAT: pa.float64(),
            ColumnKind.INT: pa.int64(),
            ColumnKind.UINT: pa.uint64(),
            ColumnKind.BOOL: pa.bool_(),
            ColumnKind.BYTES: pa.binary(),
            ColumnKind.TIME: pa.timestamp("ns"),
        }
        made = {ColumnKind.LIST: pa.list_, ColumnKind.MAP: lambda item: pa.map_(pa.string(), item)}
        self._types = [
            made[column.kind](kinds.get(column.item, pa.string()))
            if column.kind in made
            else kinds.get(column.kind, pa.string())
            for column in columns
        ]
        self._maps = [column.kind is ColumnKind.MAP for column in columns]
        self._array = pa.array
        self._table = pa.Table.from_arrays
        self._schema = pa.schema(
            pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None)
            for column, kind in zip(columns, self._types, strict=True)
        )
        self._file = path.open("wb")
        self._writer = pq.ParquetWriter(self._file, self._schema, compression="zstd")

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""
        arrays = [
            self._array([list(value.items()) for value in column] if is_map else column, kind)
            for kind, is_map, column in zip(self._types, self._maps, values, strict=True)
        ]
        self._writer.write_table(self._table(arrays, schema=self._schema))

    def close(self) -> None:
        """End the file."""
        try:
            self._writer.close()
        finally:
            self._file.close()


FORMATS: Final[dict[str, type[Sink]]] = {"csv": CsvSink, "parquet": ParquetSink}

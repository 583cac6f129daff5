"""Tables as files: CSV with the standard library, Parquet with pyarrow, which is imported only for that.

Times are UTC to the nanosecond without a zone, because readers differ in what they do with one: pandas, DuckDB and
Polars all take `2026-03-14 15:16:17.123456789` for a time as it is.
"""

import csv
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

from fleet.recording.sessions.tables import Column, Kind, Values

SECONDS: Final = 4096
"""So many seconds are remembered as text."""


class FormatMissing(Exception):
    """A format whose package is not installed; its text says how to have it."""


class Sink(Protocol):
    """One table being written; every method may raise OSError."""

    ending: ClassVar[str]

    def __init__(self, path: Path, columns: Sequence[Column]) -> None: ...

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""

    def close(self) -> None:
        """End the file."""


class CsvSink:
    """RFC 4180, header first; nothing where nothing was measured. Lists and maps are JSON, bytes hexadecimal."""

    ending: ClassVar[str] = ".csv"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow([column.name for column in columns])
        self._cells = [_CELLS.get(column.kind) for column in columns]

    def add(self, values: Sequence[Values]) -> None:
        """Write rows: the values of each column."""
        columns = [
            column if cell is None else [None if value is None else cell(value) for value in column]
            for cell, column in zip(self._cells, values, strict=True)
        ]
        self._writer.writerows(zip(*columns, strict=True))

    def close(self) -> None:
        """End the file."""
        self._file.close()


class _Times:
    """Times as text; the seconds met lately are remembered, as most times lie within the same few."""

    def __init__(self) -> None:
        self._words: dict[int, str] = {}

    def __call__(self, ns: int) -> str:
        second, rest = divmod(ns, 1_000_000_000)
        words = self._words.get(second)
        if words is None:
            try:
                words = datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%d %H:%M:%S")
            except (OverflowError, ValueError, OSError):
                return str(ns)  # somebody else's clock
            if len(self._words) >= SECONDS:
                self._words.clear()
            self._words[second] = words
        return f"{words}.{rest:09d}"


_CELLS: Final[dict[Kind, Callable[[Any], str]]] = {
    Kind.BOOL: lambda value: "true" if value else "false",
    Kind.BYTES: bytes.hex,
    Kind.TIME: _Times(),
    Kind.LIST: json.dumps,
    Kind.MAP: json.dumps,
}


class ParquetSink:
    """Parquet, zstd; a column's unit is in the metadata of its field, as `unit`."""

    ending: ClassVar[str] = ".parquet"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
            import pyarrow.parquet as pq  # type: ignore[import-untyped]  # likewise
        except ImportError:
            raise FormatMissing(
                "Parquet needs pyarrow, which is not installed: pip install 'zenoh-car-fleet[parquet]', or use --csv"
            ) from None
        kinds = {
            Kind.FLOAT: pa.float64(),
            Kind.INT: pa.int64(),
            Kind.UINT: pa.uint64(),
            Kind.BOOL: pa.bool_(),
            Kind.BYTES: pa.binary(),
            Kind.TIME: pa.timestamp("ns"),
        }
        made = {Kind.LIST: pa.list_, Kind.MAP: lambda item: pa.map_(pa.string(), item)}
        self._types = [
            made[column.kind](kinds.get(column.item, pa.string()))
            if column.kind in made
            else kinds.get(column.kind, pa.string())
            for column in columns
        ]
        self._maps = [column.kind is Kind.MAP for column in columns]
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

"""Tables of a session for pyarrow and pandas: conversion, and joins by car and time. Imports both only when needed."""

import math
import warnings
from bisect import bisect_right
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.tools.mode_spans import ModeSpan, describe_spans
from fleet.recording.tools.table_export import OTHER_TABLE, STRAY_PREFIX, arrow_tables, is_stray, own_type
from fleet.recording.tools.table_formats import ArrowSink, FormatMissing, import_pyarrow
from fleet.recording.tools.tables import Layout
from schemas import messages, topics
from schemas.commands import COMMANDS
from schemas.printable import printable_lines
from schemas.suggestion import did_you_mean
from schemas.words import UNKNOWN

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs

TIME: Final = "publish_time"
"""Column by which tables are sorted and joined. In all messages of a car, it is by the clock of the car's gateway."""
_NOT_JOINED: Final = frozenset({"key", "car", "log_time", "sequence", "seq", "boot_id"})


class NoTable(ValueError):
    """A name that selects nothing, or more than one table. The text has likely names if there are any."""


def arrow_table(rows: Iterable[Row], of: str, session: str) -> "pa.Table":
    """Return the only table of these messages, sorted by publish_time. Raises NoTable, FormatMissing.

    of, session: names for error messages. If `of` is a topic or a message of ours, the table may be empty.
    """
    tables, exported = arrow_tables(rows)
    strays = {name: tables.pop(name) for name in list(tables) if name.startswith(STRAY_PREFIX)}
    other = tables.pop(OTHER_TABLE, None)
    others = other.num_rows - exported.undecoded if other is not None else 0
    if exported.undecoded:
        _warn(f"{exported.undecoded} messages of {session} do not match their schema and were skipped")
    if exported.undated:
        _warn(f"{sum(exported.undated.values())} times in {of} of {session} are beyond the year 2262: they are null")
    if strays:
        stray_types = ", ".join(name.removeprefix(STRAY_PREFIX) for name in sorted(strays))
        count = sum(table.num_rows for table in strays.values())
        _warn(f"{count} messages on keys of {of} are of another type ({stray_types}): Session.stray_tables() has them")
    if tables and others:
        _warn(f"{others} messages on keys of {of} are not protobuf: Session.stray_tables() has them")
    if not tables:
        owners = {own_type(key) for table in strays.values() for key in table["key"].unique().to_pylist()}
        name = owners.pop() if len(owners) == 1 else of
        tables = {of: other if others and not exported.undecoded and not strays else _empty_table(name, session)}
    # A type whose fields changed within the session has several tables.
    types = sorted({name.partition("-")[0] for name in tables})
    if len(types) > 1:
        raise NoTable(f"{of} selects several types of messages: name one of {', '.join(types)}")
    first, *rest = tables.values()
    if rest:
        first = import_pyarrow().concat_tables([first, *rest], promote_options="permissive")
    return first.sort_by(TIME)


def warn_of_modes(sensor: str, spans: Iterable[ModeSpan]) -> None:
    """Warn about readings that do not exist because of the modes of the cars."""
    if words := describe_spans(sensor, spans):
        _warn(f"{words}. Session.times_without() has the times")


def _warn(words: str) -> None:
    # The warning names the line of the caller of `Session.to_arrow`, but a line of ours for `to_pandas`.
    warnings.warn(printable_lines(words), stacklevel=4)


def stray_tables(rows: Iterable[Row]) -> "dict[str, pa.Table]":
    """Return tables of the messages whose type is not that of their key, and of those that are not protobuf."""
    decoder = MessageDecoder()
    tables, _ = arrow_tables(row for row in rows if decoder.class_of(row[0]) is None or is_stray(row[0]))
    return {name: table.sort_by(TIME) for name, table in tables.items()}


def _empty_table(of: str, session: str) -> "pa.Table":
    known = _known_names()
    if of in known:
        return ArrowSink(Layout(messages.message_class(known[of]).DESCRIPTOR).columns).table()
    raise no_messages(of, session)


def no_messages(of: str, session: str) -> NoTable:
    """Return the error that a session has no messages of this name."""
    # In the name of a topic, compare the last part: whole names of two topics of one family are too much alike.
    likely = topics.likely_name(of) if "/" in of else None
    is_other = likely is not None and not f"/{of}".endswith(f"/{likely}")
    near = f"Did you mean {likely}?" if is_other else did_you_mean(of, _known_names(), 2)
    return NoTable(f"{session} has no messages of {of}. {near}".rstrip())


def is_known(name: str) -> bool:
    """Return True if a topic, a message, or a key of a topic or a command has this name, or if it has wildcards."""
    return "*" in name or "@cmd/" in name or any(f"/{name}".endswith(f"/{known}") for known in _known_names())


def _known_names() -> dict[str, str]:
    """Return the message of each topic and of each name of a message."""
    known = {name: topic.message for name, topic in topics.TOPICS.items()}
    known |= {name: name for name in (*known.values(), *(command.message for command in COMMANDS.values()))}
    return known | {name.rpartition(".")[2]: name for name in known.values()}


def data_frame(table: "pa.Table") -> "pd.DataFrame":
    """Return a table for pandas, with pd.NA for null, and the units in `attrs`. Raises FormatMissing."""
    try:
        import pandas as pd
    except ImportError:
        raise FormatMissing("pandas") from None
    kinds = {
        "double": pd.Float64Dtype(),
        "int64": pd.Int64Dtype(),
        "uint64": pd.UInt64Dtype(),
        "bool": pd.BooleanDtype(),
        "string": pd.StringDtype(),
    }
    frame: Any = table.to_pandas(types_mapper=lambda kind: kinds.get(str(kind)), maps_as_pydicts="strict")
    units = ((field.name, (field.metadata or {}).get(b"unit")) for field in table.schema)
    frame.attrs["units"] = {name: unit.decode() for name, unit in units if unit}
    return frame


def join_as_of(left: "pa.Table", right: "pa.Table", prefix: str, tolerance_s: float | None) -> "pa.Table":
    """Add to each row of `left` the fields of the latest row of `right` of the same car, at most `tolerance_s` older.

    Both tables are sorted by publish_time. tolerance_s: None for the time after which the topic of `right` is stale.
    """
    if tolerance_s is None:
        topic = topics.of_key(right["key"][0].as_py()) if right.num_rows else None
        tolerance_s = topic.stale_after_s if topic is not None else None
    tolerance_ns = (math.inf if tolerance_s is None else tolerance_s) * 1e9
    by_car: dict[str, tuple[list[int], list[int]]] = {}
    for row, (car, at_ns) in enumerate(_cars_and_times(right)):
        times, rows = by_car.setdefault(car, ([], []))
        times.append(at_ns)
        rows.append(row)
    found: list[int | None] = []
    for car, at_ns in _cars_and_times(left):
        times, rows = by_car.get(car, ([], []))
        last = bisect_right(times, at_ns) - 1
        found.append(rows[last] if last >= 0 and at_ns - times[last] <= tolerance_ns else None)
    joined = [name for name in right.column_names if name not in _NOT_JOINED]
    matched = right.select(joined).take(import_pyarrow().array(found, "int64"))
    for field, column in zip(matched.schema, matched.columns, strict=True):
        left = left.append_column(field.with_name(f"{prefix}.{field.name}"), column)
    return left


def add_modes(table: "pa.Table") -> "pa.Table":
    """Add to a table that was joined with `state/mode` the columns `mode` (as commanded) and `mode_seen`.

    Both are null if they are not known. If the table already has a column of that name, nothing is added.
    """
    import_pyarrow()
    import pyarrow.compute as pc  # type: ignore[import-untyped]  # it has no stubs

    for name, source in (("mode", "mode.asked"), ("mode_seen", "mode.inferred")):
        if source in table.column_names and name not in table.column_names:
            words = table[source]
            known = pc.and_(pc.not_equal(words, UNKNOWN), pc.not_equal(words, ""))
            table = table.append_column(name, pc.if_else(known, words, None))
    return table


def mode_rows(table: "pa.Table") -> list[dict[str, Any]]:
    """Return the rows of a table of `state/mode`, with publish_time in ns. Empty for another table."""
    needed = ("car", "asked", "inferred", "verdict")
    if not {*needed, TIME} <= {*table.column_names}:
        return []
    rows: list[dict[str, Any]] = table.select([*needed]).append_column(TIME, table[TIME].cast("int64")).to_pylist()
    return rows


def spans_table(spans: Iterable[ModeSpan]) -> "pa.Table":
    """Return spans as a table: car, mode, begin and end."""
    arrow = import_pyarrow()
    given = list(spans)
    time = arrow.timestamp("ns", "UTC")
    columns = {
        "car": arrow.array([span.car for span in given], "string"),
        "mode": arrow.array([str(span.mode) for span in given], "string"),
        "begin": arrow.array([span.begin_ns for span in given], time),
        "end": arrow.array([span.end_ns for span in given], time),
    }
    return arrow.table(columns)


def _cars_and_times(table: "pa.Table") -> Iterable[tuple[str, int]]:
    return zip(table["car"].to_pylist(), table[TIME].cast("int64").to_pylist(), strict=True)

"""MCAP, .rrd, CSV and Parquet of a session with every type of message hold the same rows and values.

The standard reader of each format reads the file. The message's own fields bring the values into one form. No code of
ours reads its own files.
"""

import csv
import json
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
import pyarrow.parquet as pq  # type: ignore[import-untyped]  # it has no stubs
import pytest
import rerun.chunk as rrc
from click.testing import CliRunner
from mcap.reader import make_reader

from fleet.cli import cli
from fleet.recording.reading.session import Session
from fleet.replay.rerun.rrd_export import export
from schemas import messages
from schemas.topics import TOPICS
from tests.fleet.recording.tools import every_type

NO_FIELD = ("key", "car", "log_time", "publish_time", "sequence")
TIMESTAMP = "google.protobuf.Timestamp"
Rows = dict[str, list[tuple[int, int, dict[str, Any]]]]
"""Log time, publish time and set fields of each message, by key."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "0001.mcap"
    every_type.make(path)
    return path


@pytest.fixture(scope="module")
def tables(session: Path) -> Path:
    done = CliRunner().invoke(
        cli,
        [
            "sessions",
            "export",
            str(session.parent),
            "--csv",
            str(session.parent / "csv"),
            "--parquet",
            str(session.parent / "parquet"),
            "--nanoseconds",
        ],
    )
    assert done.exit_code == 0, done.output
    return session.parent


@pytest.fixture(scope="module")
def original(session: Path) -> Rows:
    """Return the rows by mcap's reader and protobuf's own code."""
    found: Rows = {}
    with session.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            decoded = messages.message_class(schema.name).FromString(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, fields(decoded)))
    assert set(found) == set(every_type.keys_and_types())
    assert {len(rows) for rows in found.values()} == {every_type.EACH}
    return found


def fields(message: Any) -> dict[str, Any]:
    """Return the fields of a message in the common form."""
    return {
        field.name: form(field, getattr(message, field.name), lambda _, inner: fields(inner))
        for field in message.DESCRIPTOR.fields
        if not (field.has_presence and not message.HasField(field.name))
    }


def form(field: Any, value: Any, inner: Callable[[Any, Any], Any]) -> Any:
    """Return a field's value: times in ns, maps as dict, all others as in Python."""
    if field.message_type is not None and field.message_type.GetOptions().map_entry:
        return dict(value)
    if field.message_type is not None and field.message_type.full_name == TIMESTAMP:
        return value.seconds * 10**9 + value.nanos
    if field.message_type is not None:
        return (
            [inner(field.message_type, one) for one in value] if field.is_repeated else inner(field.message_type, value)
        )
    if field.enum_type is not None:
        return field.enum_type.values_by_number[value].name
    return list(value) if field.is_repeated else value


def without_car(rows: Rows) -> Rows:
    """Remove the field `car`, which the tables have once, from the key."""
    return {
        key: [
            (log, published, {name: value for name, value in row.items() if name != "car"})
            for log, published, row in of
        ]
        for key, of in rows.items()
    }


def own_fields(descriptor: Any) -> list[Any]:
    """Return the fields with a column of the same name. The fields of a command's request come after them."""
    return [field for field in descriptor.fields if field.name not in ("car", "request")]


def without_requests(rows: Rows) -> Rows:
    """Remove the requests of commands, which have columns of their own (test_analysis.py)."""
    return {
        key: [(log, at, {name: value for name, value in row.items() if name != "request"}) for log, at, row in of]
        for key, of in rows.items()
    }


def given(descriptor: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a JSON message of `export`."""
    found = {}
    for field in descriptor.fields:
        if field.name not in values:
            continue
        value, message = values[field.name], field.message_type
        if message is not None and message.full_name != TIMESTAMP and not message.GetOptions().map_entry:
            value = [given(message, one) for one in value] if field.is_repeated else given(message, value)
        found[field.name] = value
    return found


def of_cell(field: Any, text: str) -> Any:
    """Return the value of a CSV cell, None if it is empty."""
    message = field.message_type
    if message is not None and message.full_name == TIMESTAMP and not field.is_repeated:
        return nanoseconds(text) if text else None
    if message is not None and message.GetOptions().map_entry:
        return json.loads(text)
    if message is not None:
        value = json.loads(text) if text else None
        if value is None:
            return None
        return [given(message, one) for one in value] if field.is_repeated else given(message, value)
    if field.is_repeated:
        return json.loads(text)
    if field.has_presence and not text:
        return None
    if field.type == field.TYPE_BYTES:
        return bytes.fromhex(text)
    match field.cpp_type:
        case field.CPPTYPE_STRING | field.CPPTYPE_ENUM:
            return text
        case field.CPPTYPE_DOUBLE | field.CPPTYPE_FLOAT:
            return float(text)
        case field.CPPTYPE_BOOL:
            return {"true": True, "false": False}[text]
        case _:
            return int(text)


def nanoseconds(text: str) -> int:
    whole, _, rest = text.partition(".")
    seconds = int(duckdb.execute("select epoch(?::timestamp)", [whole]).fetchall()[0][0])
    assert len(rest) == len("123456789Z")
    assert rest.endswith("Z")
    return seconds * 10**9 + int(rest[:-1])


def test_csv_holds_what_the_recording_holds(original: Rows, tables: Path) -> None:
    found: Rows = {}
    for path in (tables / "csv").iterdir():
        descriptor = messages.message_class(path.stem).DESCRIPTOR
        own = own_fields(descriptor)
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.reader(file)
            header = next(reader)
            assert tuple(header[:5]) == NO_FIELD
            assert all(name.startswith(field.name) for name, field in zip(header[5:], own, strict=False))
            assert all(name.startswith("request_") for name in header[5 + len(own) :])
            for key, car, log, published, _, *cells in reader:
                assert car == key.split("/")[1]
                values = {field.name: of_cell(field, cell) for field, cell in zip(own, cells, strict=False)}
                row = {name: value for name, value in values.items() if value is not None}
                found.setdefault(key, []).append((nanoseconds(log), nanoseconds(published), row))
    assert found == without_requests(without_car(original))


def test_parquet_holds_what_the_recording_holds(original: Rows, tables: Path) -> None:
    found: Rows = {}
    for path in (tables / "parquet").iterdir():
        descriptor = messages.message_class(path.stem).DESCRIPTOR
        own = own_fields(descriptor)
        relation = duckdb.sql(f"from '{path}'")
        assert tuple(relation.columns[:5]) == NO_FIELD
        exact = [
            f'epoch_ns("{name}")' if str(kind) == "TIMESTAMPTZ_NS" else f'"{name}"'
            for name, kind in zip(relation.columns, relation.types, strict=True)
        ]
        for key, car, log, published, _, *cells in relation.project(", ".join(exact)).fetchall():
            assert car == key.split("/")[1]
            row = {}
            for field, cell in zip(own, cells, strict=False):
                message = field.message_type
                nested = message is not None and not message.GetOptions().map_entry and message.full_name != TIMESTAMP
                value = of_cell(field, cell) if nested and cell is not None else cell
                if value is not None:
                    row[field.name] = value
            found.setdefault(key, []).append((log, published, row))
    assert found == without_requests(without_car(original))


def test_times_of_parquet_are_in_microseconds_that_duckdb_subtracts(
    original: Rows, session: Path, tmp_path: Path
) -> None:
    done = CliRunner().invoke(cli, ["sessions", "export", str(session.parent), "--parquet", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    times = {log // 1000 for key, rows in original.items() if key.endswith("sensor/range") for log, _, _ in rows}
    path = tmp_path / "out" / "fleet.v1.Range.parquet"
    stored = pq.read_table(path).column("log_time")
    assert (str(stored.type), {each.value for each in stored}) == ("timestamp[us, tz=UTC]", times)
    (took,) = duckdb.sql(f"select max(log_time) - min(log_time) from '{path}'").fetchall()[0]
    assert took == timedelta(microseconds=max(times) - min(times))


def test_nanoseconds_are_an_option_of_parquet_only(session: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        cli, ["sessions", "export", str(session.parent), "--csv", str(tmp_path / "out"), "--nanoseconds"]
    )
    assert (done.exit_code, (tmp_path / "out").exists()) == (2, False)


def test_rrd_holds_what_the_recording_holds(original: Rows, session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    export(Session(session), out)
    found: Rows = {}
    texts: dict[str, list[tuple[int, int, str]]] = {}
    logs = [key for key, name in every_type.keys_and_types().items() if name == "foxglove.Log"]
    for key, component, log, published, value in arrow_rows(out):
        if component.endswith(":message"):
            descriptor = messages.message_class(component.removesuffix(":message")).DESCRIPTOR
            found.setdefault(key, []).append((log, published, of_arrow(descriptor, value)))
        elif component == "TextLog:text" and key in logs:
            texts.setdefault(key, []).append((log, published, value))
    assert {key: sorted(rows, key=lambda row: row[:2]) for key, rows in found.items()} == {
        key: rows for key, rows in original.items() if key not in logs
    }
    # Rerun turns foxglove.Log into its own text log.
    assert {key: sorted(rows) for key, rows in texts.items()} == {
        key: [(log, published, row["message"]) for log, published, row in original[key]] for key in logs
    }


def arrow_rows(path: Path) -> Iterator[tuple[str, str, int, int, Any]]:
    """Yield key, component, log time, publish time and value of every row in an .rrd."""
    for chunk in rrc.RrdReader(path).store().stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        if "message_log_time" not in columns:
            continue
        times = [[one.value for one in columns[f"message_{name}_time"]] for name in ("log", "publish")]
        for name, column in columns.items():
            if name.endswith(":message") or name == "TextLog:text":
                for log, published, value in zip(*times, column.to_pylist(), strict=True):
                    if value:
                        yield chunk.entity_path.strip("/").replace("\\@", "@"), name, log, published, value[0]


def of_arrow(descriptor: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a message that Rerun's reader decoded by reflection."""
    found: dict[str, Any] = {}
    for field in descriptor.fields:
        value, message = values[field.name], field.message_type
        if message is not None and message.GetOptions().map_entry:
            found[field.name] = dict(value or ())
        elif field.is_repeated:
            found[field.name] = [of_arrow(message, one) if message is not None else one for one in value or ()]
        elif value is None:
            continue
        elif message is not None and message.full_name == TIMESTAMP:
            found[field.name] = value["seconds"] * 10**9 + value["nanos"]
        else:
            found[field.name] = of_arrow(message, value) if message is not None else value
    return found


def test_units_are_in_the_columns_names_and_in_parquets_metadata(tables: Path) -> None:
    for topic in TOPICS.values():
        schema = pq.read_schema(tables / "parquet" / f"{topic.message}.parquet")
        with (tables / "csv" / f"{topic.message}.csv").open(encoding="utf-8") as file:
            assert next(csv.reader(file)) == schema.names
        by_field = {
            name: (schema.field(name).metadata or {}).get(b"unit", b"").decode()
            for name in schema.names[len(NO_FIELD) :]
        }
        for field, unit in topic.units.items():
            columns = [name for name in by_field if name == field or name.startswith(f"{field}_")]
            assert by_field[columns[0]] == unit, (topic.name, field)
    assert pq.read_schema(tables / "parquet" / "fleet.v1.Grayscale.parquet").names[-1] == "raw_count"


def test_duckdb_reads_the_csv_without_being_told_how(tables: Path) -> None:
    relation = duckdb.sql(f"from '{tables / 'csv' / 'fleet.v1.Battery.csv'}'")
    kinds = dict(zip(relation.columns, map(str, relation.types), strict=True))
    assert kinds["log_time"] == kinds["stamp"] == "TIMESTAMP WITH TIME ZONE"
    assert kinds["voltage_v"] == kinds["charge"] == "DOUBLE"
    assert relation.count("*").fetchall() == [(every_type.EACH,)]

"""Formats readings of one message type as a CSV table (RFC 4180) for `fleet get --csv`. Pure.

The columns are the time, the key, and every field of the message with its unit in the name. They are always the same
for a type, and empty where nothing was measured. Numbers, times and booleans are written as in JSON.
"""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any, Final

from fleet.client.reading import Reading
from fleet.recording.time_spec import format_utc
from fleet.recording.tools.table_formats import csv_cells
from fleet.recording.tools.tables import RequestColumns, column_name
from schemas import topics

_OMITTED_FIELDS: Final = frozenset({"stamp", "timestamp", "boot_id"})


def table(readings: Sequence[Reading], topic: topics.Topic) -> str:
    """Return the table with its header. All readings must be of this topic."""
    requests = RequestColumns.of(readings[0].value.DESCRIPTOR)
    fields = [field for field in _fields(readings) if requests is None or field[0] != RequestColumns.FIELD]
    names = [column_name(name, topic.units.get(name, ""), index) for name, index in fields]
    rows = [[_cell(reading.value, *field) for field in fields] for reading in readings]
    if requests is not None:
        names += [column.name for column in requests.columns]
        cells = csv_cells(requests.columns, requests.fill([reading.value for reading in readings]))
        rows = [[*row, *more] for row, more in zip(rows, cells, strict=True)]
    lines = io.StringIO(newline="")
    writer = csv.writer(lines)
    writer.writerow(["time", "key", *names])
    writer.writerows([iso(reading.time), reading.key, *row] for reading, row in zip(readings, rows, strict=True))
    return lines.getvalue()


def iso(time: datetime) -> str:
    """Return a time in ISO 8601, UTC, with microseconds."""
    return format_utc(time, "microseconds")


def _fields(readings: Sequence[Reading]) -> Iterable[tuple[str, int | None]]:
    """Yield each column as field and index. A list of numbers has one column per item of its longest value."""
    for field in readings[0].value.DESCRIPTOR.fields:
        if field.name in _OMITTED_FIELDS:
            continue
        if field.is_repeated and field.cpp_type == field.CPPTYPE_DOUBLE:
            longest = max(len(getattr(reading.value, field.name)) for reading in readings)
            yield from ((field.name, index) for index in range(longest))
        else:
            yield field.name, None


def _cell(message: Any, name: str, index: int | None) -> str:
    field = message.DESCRIPTOR.fields_by_name[name]
    if field.has_presence and not message.HasField(name):
        return ""
    value = getattr(message, name)
    if index is not None:
        return repr(value[index]) if index < len(value) else ""
    if field.is_repeated or field.message_type is not None:
        from google.protobuf import json_format

        whole = json_format.MessageToDict(message, preserving_proto_field_name=True)
        return json.dumps(whole[name]) if name in whole else ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, bytes):
        return value.hex()
    return value if isinstance(value, str) else repr(value)

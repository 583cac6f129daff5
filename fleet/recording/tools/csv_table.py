"""Formats readings of one message type as a CSV table (RFC 4180) for `fleet get --csv`. Pure.

The columns are the time, the key, and the fields of the message with their units in the names. Stamps and the boot id
are left out. The columns are always the same for a type, except that a list of numbers has as many as its longest
value. They are empty where nothing was measured. Numbers, times and booleans are written as in JSON.
"""

import csv
import io
import json
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any, Final

from fleet.client.reading import Reading
from fleet.recording.time_spec import format_utc
from fleet.recording.tools.table_formats import csv_cells
from fleet.recording.tools.tables import Column, ColumnKind, RequestColumns, Values, column_name, column_of
from schemas import topics

_OMITTED_FIELDS: Final = frozenset({"stamp", "timestamp", "boot_id"})


def table(readings: Sequence[Reading], topic: topics.Topic) -> str:
    """Return the table with its header. All readings must be of this topic."""
    found = [reading.value for reading in readings]
    columns, values = map(list, zip(*_columns(found, topic), strict=True))
    requests = RequestColumns.of(found[0].DESCRIPTOR)
    if requests is not None:
        columns, values = columns + requests.columns, values + requests.fill(found)
    lines = io.StringIO(newline="")
    writer = csv.writer(lines)
    writer.writerow(["time", "key", *(column.name for column in columns)])
    cells = csv_cells(columns, values)
    writer.writerows([iso(reading.time), reading.key, *row] for reading, row in zip(readings, cells, strict=True))
    return lines.getvalue()


def iso(time: datetime) -> str:
    """Return a time in ISO 8601, UTC, with microseconds."""
    return format_utc(time, "microseconds")


def _columns(found: Sequence[Any], topic: topics.Topic) -> Iterator[tuple[Column, Values]]:
    """Yield the columns. A list of numbers has one column per item of its longest value; other lists are JSON."""
    for field in found[0].DESCRIPTOR.fields:
        name, unit = field.name, topic.units.get(field.name, "")
        if name in _OMITTED_FIELDS or (name == RequestColumns.FIELD and RequestColumns.of(found[0].DESCRIPTOR)):
            continue
        if field.is_repeated and field.cpp_type == field.CPPTYPE_DOUBLE:
            items = [getattr(message, name) for message in found]
            for index in range(max(map(len, items))):
                column = Column(column_name(name, unit, index), ColumnKind.FLOAT)
                yield column, [each[index] if index < len(each) else None for each in items]
        elif field.is_repeated or field.message_type is not None:
            yield Column(column_name(name, unit), ColumnKind.JSON), [_json(message, name) for message in found]
        else:
            column, fill = column_of(field, column_name(name, unit), unit)
            yield column, fill(found)


def _json(message: Any, name: str) -> str | None:
    from google.protobuf import json_format

    whole = json_format.MessageToDict(message, preserving_proto_field_name=True)
    return json.dumps(whole[name]) if name in whole else None

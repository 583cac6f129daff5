"""Messages as tidy tables: one for each type of message, a row for each message. Pure; formats are not here.

Every table begins with the same columns. `car` is the key's, so it is not repeated. A field with a unit has it in its
name (`rx_bytes`, `uptime_s`, `raw_count`), as in `fleet get --csv`; what was not measured is None.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from operator import attrgetter
from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from fleet.recording.tools.csv_table import column_name
from schemas import keys
from schemas.topics import TOPICS

TIMESTAMP: Final = "google.protobuf.Timestamp"
_UNITS: Final[Mapping[str, Mapping[str, str]]] = {topic.message: topic.units for topic in TOPICS.values()}


class ColumnKind(StrEnum):
    """What is in a column."""

    FLOAT = "float"
    INT = "int"
    UINT = "uint"
    BOOL = "bool"
    TEXT = "text"
    BYTES = "bytes"
    TIME = "time"  # ns since the epoch, UTC
    LIST = "list"
    MAP = "map"  # its keys are text
    JSON = "json"  # what has parts of its own, as text


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    name: str
    kind: ColumnKind
    unit: str = ""
    item: ColumnKind = ColumnKind.TEXT
    """What a LIST or a MAP is of."""


Values = list[Any]
"""The values of one column."""

COMMON: Final = (
    Column("key", ColumnKind.TEXT),
    Column("car", ColumnKind.TEXT),
    Column("log_time", ColumnKind.TIME, "UTC"),
    Column("publish_time", ColumnKind.TIME, "UTC"),
    Column("sequence", ColumnKind.UINT),
)
OTHER: Final = (
    *COMMON,
    Column("message", ColumnKind.TEXT),
    Column("encoding", ColumnKind.TEXT),
    Column("text", ColumnKind.TEXT),
    Column("data", ColumnKind.BYTES),
)
"""Columns of what is no protobuf message: JSON and the like as text, anything else as bytes."""

_KINDS: Final = {
    FieldDescriptor.CPPTYPE_DOUBLE: ColumnKind.FLOAT,
    FieldDescriptor.CPPTYPE_FLOAT: ColumnKind.FLOAT,
    FieldDescriptor.CPPTYPE_INT32: ColumnKind.INT,
    FieldDescriptor.CPPTYPE_INT64: ColumnKind.INT,
    FieldDescriptor.CPPTYPE_UINT32: ColumnKind.UINT,
    FieldDescriptor.CPPTYPE_UINT64: ColumnKind.UINT,
    FieldDescriptor.CPPTYPE_BOOL: ColumnKind.BOOL,
    FieldDescriptor.CPPTYPE_ENUM: ColumnKind.TEXT,
    FieldDescriptor.CPPTYPE_STRING: ColumnKind.TEXT,
    FieldDescriptor.CPPTYPE_MESSAGE: ColumnKind.JSON,
}


class Layout:
    """The columns of one type of message, and how they are filled."""

    def __init__(self, descriptor: Any) -> None:  # the stubs know two types, upb's and pure Python's
        units = _UNITS.get(descriptor.full_name, {})
        taken = {column.name for column in COMMON}
        columns: list[Column] = []
        self._fillers: list[Callable[[Sequence[Any]], Values]] = []
        for field in descriptor.fields:
            if field.name == "car":
                continue
            name = column_name(field.name, units.get(field.name, ""))
            while name in taken:
                name = f"message_{name}"
            taken.add(name)
            column, filler = _filled(field, name, units.get(field.name, ""))
            columns.append(column)
            self._fillers.append(filler)
        self.columns = (*COMMON, *columns)

    def fill(self, messages: Sequence[Message]) -> list[Values]:
        """The values of the columns after the common ones."""
        return [filler(messages) for filler in self._fillers]


def car_of(key: str) -> str:
    """The car, or the service, that a key is of; empty for a key that is not a fleet's."""
    parsed = keys.parse(key)
    return parsed.car if parsed is not None else ""


def kind_of(field: FieldDescriptor) -> ColumnKind:
    """What one value of a field is."""
    if field.type == FieldDescriptor.TYPE_BYTES:
        return ColumnKind.BYTES
    if field.message_type is not None and field.message_type.full_name == TIMESTAMP:
        return ColumnKind.TIME
    return _KINDS[field.cpp_type]


def _filled(field: Any, name: str, unit: str) -> tuple[Column, Callable[[Sequence[Any]], Values]]:
    get = attrgetter(field.name)
    kind = kind_of(field)
    one = _one(field)
    if _is_map(field):
        of = field.message_type.fields_by_name
        item = kind_of(of["value"])
        if of["key"].cpp_type == FieldDescriptor.CPPTYPE_STRING and item in _PLAIN:
            column = Column(name, ColumnKind.MAP, unit, item)
            return column, lambda messages: [dict(sorted(get(message).items())) for message in messages]
        column = Column(name, ColumnKind.JSON, unit)
        return column, lambda messages: [json.dumps(plain(message)[field.name]) for message in messages]
    if field.is_repeated:
        if kind in _PLAIN:
            return Column(name, ColumnKind.LIST, unit, kind), lambda messages: [
                [one(value) for value in get(message)] for message in messages
            ]
        return Column(name, ColumnKind.JSON, unit), lambda messages: [
            json.dumps([plain(value) if kind is ColumnKind.JSON else one(value) for value in get(message)])
            for message in messages
        ]
    column = Column(name, kind, unit or ("UTC" if kind is ColumnKind.TIME else ""))
    if kind is ColumnKind.JSON:
        return column, lambda messages: [
            json.dumps(plain(get(message))) if message.HasField(field.name) else None for message in messages
        ]
    if field.has_presence:
        return column, lambda messages: [
            one(get(message)) if message.HasField(field.name) else None for message in messages
        ]
    if field.enum_type is not None:
        return column, lambda messages: [one(get(message)) for message in messages]
    return column, lambda messages: list(map(get, messages))


_PLAIN: Final = frozenset(
    {ColumnKind.FLOAT, ColumnKind.INT, ColumnKind.UINT, ColumnKind.BOOL, ColumnKind.TEXT, ColumnKind.TIME}
)


def _is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and bool(field.message_type.GetOptions().map_entry)


def _one(field: FieldDescriptor) -> Callable[[Any], Any]:
    """What makes a value of a field one of a column."""
    if field.enum_type is not None:
        names = {number: value.name for number, value in field.enum_type.values_by_number.items()}
        return lambda number: names.get(number, str(number))
    if kind_of(field) is ColumnKind.TIME:
        return _nanoseconds
    return lambda value: value


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.seconds) * 1_000_000_000 + int(stamp.nanos)


def plain(message: Any) -> dict[str, Any]:
    """A message as what JSON can hold: times in ns, bytes in hexadecimal; a field that is not given is left out."""
    found: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if _is_map(field):
            of = field.message_type.fields_by_name["value"]
            found[field.name] = {str(key): _plain_one(of, value[key]) for key in sorted(value)}
        elif field.is_repeated:
            found[field.name] = [_plain_one(field, each) for each in value]
        else:
            found[field.name] = _plain_one(field, value)
    return found


def _plain_one(field: FieldDescriptor, value: Any) -> Any:
    match kind_of(field):
        case ColumnKind.JSON:
            return plain(value)
        case ColumnKind.BYTES:
            return value.hex()
        case ColumnKind.FLOAT if not math.isfinite(value):
            return str(value)  # JSON has no such numbers
        case _:
            return _one(field)(value)

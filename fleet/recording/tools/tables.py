"""Converts messages to tidy tables: one table per message type, one row per message. Pure, without file formats.

Every table begins with the same columns. `car` comes from the key, so the field `car` of a message is left out. A field
with a unit has it in its name (`rx_bytes`, `uptime_s`), as in `fleet get --csv`. Values that were not measured are
None.
The request of a command has a column for each field (`request_motion`). Such a column is None if the request has no
such field.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from operator import attrgetter
from typing import Any, Final, Self

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import Parse, ParseError
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from msgspec import Struct

from schemas import keys, messages
from schemas.topics import PROTOBUF, TOPICS

TIMESTAMP: Final = "google.protobuf.Timestamp"
_UNIT_NAMES: Final = {"1": "", "B": "bytes", "m/s": "m_s"}
_UNITS_BY_MESSAGE: Final[Mapping[str, Mapping[str, str]]] = {topic.message: topic.units for topic in TOPICS.values()}


class ColumnKind(StrEnum):
    """Kind of the values of a column."""

    FLOAT = "float"
    INT = "int"
    UINT = "uint"
    BOOL = "bool"
    TEXT = "text"
    BYTES = "bytes"
    TIME = "time"  # ns since the epoch, UTC
    LIST = "list"
    MAP = "map"  # its keys are text
    JSON = "json"  # a nested message as text


class Column(Struct, frozen=True):
    """One column of a table."""

    name: str
    kind: ColumnKind
    unit: str = ""
    item: ColumnKind = ColumnKind.TEXT
    """Kind of the items of a LIST or MAP."""


Values = list[Any]
"""The values of one column."""

COMMON_COLUMNS: Final = (
    Column("key", ColumnKind.TEXT),
    Column("car", ColumnKind.TEXT),
    Column("log_time", ColumnKind.TIME),
    Column("publish_time", ColumnKind.TIME),
    Column("sequence", ColumnKind.UINT),
)
OTHER_COLUMNS: Final = (
    *COMMON_COLUMNS,
    Column("message", ColumnKind.TEXT),
    Column("encoding", ColumnKind.TEXT),
    Column("text", ColumnKind.TEXT),
    Column("data", ColumnKind.BYTES),
)
"""Columns of messages that are not decoded, mostly because they are not protobuf: UTF-8 as text, others as bytes."""

_COLUMN_KINDS: Final = {
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
    """Columns of one message type, and the functions that fill them."""

    def __init__(self, descriptor: Any) -> None:  # the stubs know two types, upb's and pure Python's
        units = _UNITS_BY_MESSAGE.get(descriptor.full_name, {})
        taken = {column.name for column in COMMON_COLUMNS}
        columns: list[Column] = []
        self._fillers: list[Callable[[Sequence[Any]], Values]] = []
        self._requests = RequestColumns.of(descriptor)
        for field in descriptor.fields:
            if field.name == "car" or (self._requests is not None and field.name == RequestColumns.FIELD):
                continue
            name = column_name(field.name, units.get(field.name, ""))
            while name in taken:
                name = f"message_{name}"
            taken.add(name)
            column, filler = column_of(field, name, units.get(field.name, ""))
            columns.append(column)
            self._fillers.append(filler)
        self.columns = (*COMMON_COLUMNS, *columns, *(self._requests.columns if self._requests is not None else ()))

    def fill(self, messages: Sequence[Message]) -> list[Values]:
        """Return the values of the columns after the common ones."""
        own = [filler(messages) for filler in self._fillers]
        return own if self._requests is None else own + self._requests.fill(messages)


class RequestColumns:
    """Columns for the fields of all commands, in place of the bytes of a command event's request."""

    FIELD: Final = "request"

    def __init__(self, descriptor: Any) -> None:
        # Use the commands of the recording's own schema, which may be older than ours.
        commands = {
            name.removesuffix("Command").lower(): command
            for name, command in descriptor.file.message_types_by_name.items()
            if name.endswith("Command")
        }
        self._classes = {verb: GetMessageClass(command) for verb, command in commands.items()}
        event = {field.name for field in descriptor.fields}
        fields: dict[str, Any] = {}
        for field in (each for command in commands.values() for each in command.fields if each.name not in event):
            fields.setdefault(field.name, field)
        self.columns = [Column(f"{self.FIELD}_unreadable", ColumnKind.TEXT)]
        """The first column has the request as text or hexadecimal if it cannot be parsed as the message of its verb."""
        self._fillers: dict[str, Callable[[Sequence[Any]], Values]] = {}
        for name, field in fields.items():
            unit = name.rpartition("_")[2]
            column, self._fillers[name] = column_of(
                field, f"{self.FIELD}_{name}", unit if unit in _REQUEST_UNITS else ""
            )
            self.columns.append(column)

    @classmethod
    def of(cls, descriptor: Any) -> Self | None:
        """Return the columns for messages of this type, or None if it is not an event of a command.

        Also return None if its schema lacks the fields from which a request is read, or has them with other types.
        """
        is_event = descriptor.full_name == TOPICS["event/command"].message
        kinds = {field.name: field.type for field in descriptor.fields if not field.is_repeated}
        return cls(descriptor) if is_event and _REQUEST_FIELDS.items() <= kinds.items() else None

    def fill(self, events: Sequence[Any]) -> list[Values]:
        """Return the values of the columns."""
        rows = [self._row(event) for event in events]
        return [list(column) for column in zip(*rows, strict=True)] if rows else [[] for _ in self.columns]

    def _row(self, event: Any) -> Values:
        request = self._parse(event)
        if request is None:
            return [text_or_hex(event.request) or None, *(None for _ in self._fillers)]
        fields = request.DESCRIPTOR.fields_by_name
        return [None, *(fill([request])[0] if name in fields else None for name, fill in self._fillers.items())]

    def _parse(self, event: Any) -> Message | None:
        message_class = self._classes.get(event.verb)
        if message_class is None or not event.request:
            return None
        try:
            if event.request_encoding.startswith(PROTOBUF):
                return message_class.FromString(event.request)
            return Parse(event.request, message_class())
        except (DecodeError, ParseError, UnicodeDecodeError):
            return None


_REQUEST_UNITS: Final = ("s", "deg")
_REQUEST_FIELDS: Final = {
    "verb": FieldDescriptor.TYPE_STRING,
    "request": FieldDescriptor.TYPE_BYTES,
    "request_encoding": FieldDescriptor.TYPE_STRING,
}
"""The fields of a command event from which its request is read, with their types."""


def text_or_hex(payload: bytes) -> str:
    """Return UTF-8 as text, other bytes as hexadecimal."""
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return payload.hex()


def column_name(name: str, unit: str, index: int | None = None) -> str:
    """Return the column name of a field: with the number of a list item, and with its unit unless the name has it."""
    unit = _UNIT_NAMES.get(unit, unit).lower()
    numbered = name if index is None else f"{name}_{index + 1}"
    return numbered if not unit or name.endswith(f"_{unit}") or name == unit else f"{numbered}_{unit}"


def car_of(key: str) -> str:
    """Return the car or service of a key, or an empty text if the key belongs to no fleet."""
    parsed = keys.parse(key)
    return parsed.car if parsed is not None else ""


def kind_of(field: FieldDescriptor) -> ColumnKind:
    """Return the kind of one value of a field."""
    if field.type == FieldDescriptor.TYPE_BYTES:
        return ColumnKind.BYTES
    if field.message_type is not None and field.message_type.full_name == TIMESTAMP:
        return ColumnKind.TIME
    return _COLUMN_KINDS[field.cpp_type]


def column_of(field: Any, name: str, unit: str) -> tuple[Column, Callable[[Sequence[Any]], Values]]:
    """Return the column of a field, and the function that fills it."""
    get = attrgetter(field.name)
    kind = kind_of(field)
    convert = _converter(field)
    if _is_map(field):
        of = field.message_type.fields_by_name
        item = kind_of(of["value"])
        if of["key"].cpp_type == FieldDescriptor.CPPTYPE_STRING and item in _SCALAR_KINDS:
            column = Column(name, ColumnKind.MAP, unit, item)
            return column, lambda messages: [dict(sorted(get(message).items())) for message in messages]
        column = Column(name, ColumnKind.JSON, unit)
        return column, lambda messages: [json.dumps(plain(message)[field.name]) for message in messages]
    if field.is_repeated:
        if kind in _SCALAR_KINDS:
            return Column(name, ColumnKind.LIST, unit, kind), lambda messages: [
                [convert(value) for value in get(message)] for message in messages
            ]
        return Column(name, ColumnKind.JSON, unit), lambda messages: [
            json.dumps([_plain_value(field, value) for value in get(message)]) for message in messages
        ]
    column = Column(name, kind, unit)
    if kind is ColumnKind.JSON:
        return column, lambda messages: [
            json.dumps(plain(get(message))) if message.HasField(field.name) else None for message in messages
        ]
    if field.has_presence:
        return column, lambda messages: [
            convert(get(message)) if message.HasField(field.name) else None for message in messages
        ]
    if field.enum_type is not None:
        return column, lambda messages: [convert(get(message)) for message in messages]
    return column, lambda messages: list(map(get, messages))


_SCALAR_KINDS: Final = frozenset(
    {ColumnKind.FLOAT, ColumnKind.INT, ColumnKind.UINT, ColumnKind.BOOL, ColumnKind.TEXT, ColumnKind.TIME}
)


def _is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and bool(field.message_type.GetOptions().map_entry)


def _converter(field: FieldDescriptor) -> Callable[[Any], Any]:
    """Return the function that converts a value of a field to a value of its column."""
    if field.enum_type is not None:
        names = {number: value.name for number, value in field.enum_type.values_by_number.items()}
        return lambda number: names.get(number, str(number))
    if kind_of(field) is ColumnKind.TIME:
        return messages.stamp_ns
    return lambda value: value


def plain(message: Any) -> dict[str, Any]:
    """Return a message as a JSON object: times in ns, bytes in hexadecimal, without unset fields."""
    found: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if _is_map(field):
            of = field.message_type.fields_by_name["value"]
            found[field.name] = {str(key): _plain_value(of, value[key]) for key in sorted(value)}
        elif field.is_repeated:
            found[field.name] = [_plain_value(field, each) for each in value]
        else:
            found[field.name] = _plain_value(field, value)
    return found


def _plain_value(field: FieldDescriptor, value: Any) -> Any:
    match kind_of(field):
        case ColumnKind.JSON:
            return plain(value)
        case ColumnKind.BYTES:
            return value.hex()
        case ColumnKind.FLOAT if not math.isfinite(value):
            return str(value)  # JSON has no such numbers
        case _:
            return _converter(field)(value)

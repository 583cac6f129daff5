"""The fields of a message as names of a condition, with their types and values."""

from collections.abc import Callable, Collection, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from schemas.keys import person_of

_TYPES: Final[Mapping[int, type]] = {
    FieldDescriptor.CPPTYPE_BOOL: bool,
    FieldDescriptor.CPPTYPE_STRING: str,
    FieldDescriptor.CPPTYPE_ENUM: str,
}
"""Types of fields by protobuf's C++ type. All other types except messages are numbers."""
LAST: Final = ("car", "seq", "boot_id")
"""Fields of every published message but logs. They are the last ones in lists of names."""

OWNERS: Final = frozenset({"by", "holder", "owner", "sender"})
"""Fields with a sender: a person, or a person's process (`mia@laptop-4711`)."""
SHORT_NAMES: Final = MappingProxyType({"distance_m": "range.range_m", "battery_v": "battery.voltage_v"})
"""Everyday names of fields, each with topic and field."""


def aliases_of(names: Collection[str]) -> dict[str, str]:
    """Return other spellings of names with a topic: `range_m` for `range.range_m`, unless two topics have it."""
    short = [name.partition(".")[2] for name in names]
    unique = {name.partition(".")[2]: name for name in names if short.count(name.partition(".")[2]) == 1}
    return unique | {alias: name for alias, name in SHORT_NAMES.items() if name in names}


def topic_aliases_of(topic: str, fields: Collection[str]) -> dict[str, str]:
    """Return other spellings of one message's fields: `range.range_m` for `range_m`."""
    spelled = {f"{topic}.{name}": name for name in fields}
    return spelled | {alias: spelled[name] for alias, name in SHORT_NAMES.items() if name in spelled}


def fields_of(message_class: type[Message]) -> Mapping[str, type]:
    """Return the fields that a condition may name, with their types: float, bool or str.

    A nested message has its own fields (`hold.by`) and a boolean for its presence (`hold`). A repeated field is a
    boolean, true if it has elements (`estops`). An enum is a word. Times and bytes cannot be compared.
    """
    result = dict(_fields(message_class.DESCRIPTOR))
    return MappingProxyType({name: result[name] for name in sorted(result, key=LAST.__contains__)})


def value_in(message: Message) -> Callable[[str], object | None]:
    """Return a lookup of names in a message. It returns None if the field was not measured or its message is absent."""
    return lambda name: _value(message, name)


def compared_in(message: Message) -> Callable[[str], object | None]:
    """Return a lookup of the values that conditions compare. For a sender, that is the person without the process."""
    look = value_in(message)

    def value(name: str) -> object | None:
        found = look(name)
        return person_of(found) if isinstance(found, str) and name.rpartition(".")[2] in OWNERS else found

    return value


def _fields(descriptor: Any, prefix: str = "") -> Iterator[tuple[str, type]]:
    for each in descriptor.fields:
        name = prefix + each.name
        inner = each.message_type
        if each.is_repeated:
            yield name, bool
        elif inner is None:
            if each.type != FieldDescriptor.TYPE_BYTES:
                yield name, _TYPES.get(each.cpp_type, float)
        elif inner.file.package != "google.protobuf":
            yield name, bool
            yield from _fields(inner, f"{name}.")


def _value(message: Any, name: str) -> object | None:
    first, _, rest = name.partition(".")
    field = message.DESCRIPTOR.fields_by_name[first]
    if field.is_repeated:
        return len(getattr(message, first)) > 0
    if rest:
        return _value(getattr(message, first), rest) if message.HasField(first) else None
    if field.message_type is not None:
        result: bool = message.HasField(first)
        return result
    if field.has_presence and not message.HasField(first):
        return None
    value: object = getattr(message, first)
    if field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        return known.name if known is not None else str(value)
    return value

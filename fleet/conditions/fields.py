"""The fields of a message as names of a condition: which there are, of which type, and their values."""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

_TYPES: Final[Mapping[int, type]] = {
    FieldDescriptor.CPPTYPE_INT32: float,
    FieldDescriptor.CPPTYPE_INT64: float,
    FieldDescriptor.CPPTYPE_UINT32: float,
    FieldDescriptor.CPPTYPE_UINT64: float,
    FieldDescriptor.CPPTYPE_DOUBLE: float,
    FieldDescriptor.CPPTYPE_FLOAT: float,
    FieldDescriptor.CPPTYPE_BOOL: bool,
    FieldDescriptor.CPPTYPE_STRING: str,
    FieldDescriptor.CPPTYPE_ENUM: str,
}
LAST: Final = ("car", "seq", "boot_id")
"""Every message has them; few ask for them."""


def fields_of(message_class: type[Message]) -> Mapping[str, type]:
    """The fields that a condition may name, with their types: float, bool or str.

    A message within is there as its own fields (`hold.by`) and as a truth, whether it is there (`hold`); of what is
    repeated only whether there is any (`estops`). An enum is a word. Times and bytes cannot be compared.
    """
    found = dict(_fields(message_class.DESCRIPTOR))
    return MappingProxyType({name: found[name] for name in sorted(found, key=LAST.__contains__)})


def value_in(message: Message) -> Callable[[str], object | None]:
    """Looks names of `fields_of` up in a message; None: not measured, or its message is not there."""
    return lambda name: _value(message, name)


def _fields(descriptor: Any, prefix: str = "") -> Iterator[tuple[str, type]]:
    for each in descriptor.fields:
        name = prefix + each.name
        inner = each.message_type
        if each.is_repeated:
            yield name, bool
        elif inner is None:
            if each.cpp_type in _TYPES and each.type != FieldDescriptor.TYPE_BYTES:
                yield name, _TYPES[each.cpp_type]
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
        found: bool = message.HasField(first)
        return found
    if field.has_presence and not message.HasField(first):
        return None
    value: object = getattr(message, first)
    if field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        return known.name if known is not None else str(value)
    return value

"""Payloads of a recording as messages, by the schemas that are in the file: it may be older or newer than we are."""

from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from fleet.recording.reading.mcap_reader import ChannelInfo
from schemas import messages

SAME: Final = "same"
"""The state of a schema that has the fields of today's."""


class MessageDecoder:
    """Message classes of a session's lanes."""

    def __init__(self) -> None:
        self._classes: dict[tuple[str, bytes], type[Message] | None] = {}

    def class_of(self, lane: ChannelInfo) -> type[Message] | None:
        """The class of a lane's messages; None if it is not protobuf, or its schema cannot be understood."""
        schema = lane.schema
        if schema is None or schema.encoding != "protobuf" or lane.channel.message_encoding != "protobuf":
            return None
        kind = (schema.name, schema.data)
        if kind not in self._classes:
            self._classes[kind] = _made(*kind)
        return self._classes[kind]

    def message(self, lane: ChannelInfo, payload: bytes) -> Message | None:
        """A payload as a message; None if it is none."""
        made = self.class_of(lane)
        if made is None:
            return None
        message = made()
        try:
            message.ParseFromString(payload)
        except DecodeError:
            return None
        return message


def _made(name: str, data: bytes) -> type[Message] | None:
    pool = DescriptorPool()
    try:
        for file in FileDescriptorSet.FromString(data).file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(name))
    # What protobuf raises for a schema that makes no sense depends on where it does not.
    except (DecodeError, KeyError, TypeError, ValueError):
        return None


def compared(made: type[Message]) -> str:
    """How a schema in a file differs from today's of the same name: `same`, or in words."""
    name = made.DESCRIPTOR.full_name
    try:
        today = _shape(messages.message_class(name).DESCRIPTOR)
    except KeyError:
        return "not one of ours"
    then = _shape(made.DESCRIPTOR)
    parts = [
        f"{words} {', '.join(sorted(fields))}"
        for words, fields in (
            ("has more:", then.keys() - today.keys()),
            ("lacks:", today.keys() - then.keys()),
            ("has otherwise:", {field for field in then.keys() & today.keys() if then[field] != today[field]}),
        )
        if fields
    ]
    return "; ".join(parts) or SAME


def _shape(descriptor: Any, prefix: str = "", above: frozenset[str] = frozenset()) -> dict[str, tuple[int, ...]]:
    """Every field by its path: number and type. A message within itself is not followed.

    The stubs know two types of descriptors, upb's and pure Python's.
    """
    found: dict[str, tuple[int, ...]] = {}
    for field in descriptor.fields:
        path = prefix + field.name
        found[path] = (field.number, field.type, field.is_repeated)
        inner = field.message_type
        if field.type == FieldDescriptor.TYPE_MESSAGE and inner is not None and inner.full_name not in above:
            found |= _shape(inner, f"{path}.", above | {descriptor.full_name})
    return found

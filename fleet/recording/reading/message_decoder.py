"""Decodes recorded payloads with the schemas embedded in the file, which may be older or newer than ours."""

from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from fleet.recording.left_out import LeftOutCause
from fleet.recording.reading.mcap_reader import ChannelInfo
from schemas import messages

SAME_SCHEMA: Final = "same"
"""Result for a schema with the same fields as ours."""


class MessageDecoder:
    """Decoder of the messages of a session, with a cache of message classes."""

    def __init__(self) -> None:
        self._classes: dict[tuple[str, bytes], type[Message] | None] = {}

    def class_of(self, info: ChannelInfo) -> type[Message] | None:
        """Return the class of the messages of a channel, or None if it is not protobuf, or its schema is invalid."""
        schema = info.schema
        if schema is None or schema.encoding != "protobuf" or info.channel.message_encoding != "protobuf":
            return None
        kind = (schema.name, schema.data)
        if kind not in self._classes:
            self._classes[kind] = _build_class(*kind)
        return self._classes[kind]

    def message(self, info: ChannelInfo, payload: bytes) -> Message | None:
        """Return the decoded payload, or None if it does not match its schema, or if `class_of` returns None."""
        message_class = self.class_of(info)
        if message_class is None:
            return None
        message = message_class()
        try:
            message.ParseFromString(payload)
        except DecodeError:
            return None
        return message


def _build_class(name: str, data: bytes) -> type[Message] | None:
    pool = DescriptorPool()
    try:
        for file in FileDescriptorSet.FromString(data).file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(name))
    # For an invalid schema, protobuf raises one of these, depending on where the fault is.
    except (DecodeError, KeyError, TypeError, ValueError):
        return None


def compare_schema(message_class: type[Message]) -> str:
    """Describe how a recorded schema differs from ours of the same name, or return SAME_SCHEMA."""
    name = message_class.DESCRIPTOR.full_name
    try:
        today = _field_shapes(messages.message_class(name).DESCRIPTOR)
    except KeyError:
        return "not one of ours"
    then = _field_shapes(message_class.DESCRIPTOR)
    parts = [
        f"{words} {', '.join(sorted(fields))}"
        for words, fields in (
            ("has more:", then.keys() - today.keys()),
            ("lacks:", today.keys() - then.keys()),
            ("has otherwise:", {field for field in then.keys() & today.keys() if then[field] != today[field]}),
        )
        if fields
    ]
    return "; ".join(parts) or SAME_SCHEMA


def _field_shapes(descriptor: Any, prefix: str = "", above: frozenset[str] = frozenset()) -> dict[str, tuple[int, ...]]:
    """Return number, type and label of every field by its path. Skip messages nested in themselves."""
    # Any, because the stubs have two types of descriptors: for upb and for pure Python.
    found: dict[str, tuple[int, ...]] = {}
    for field in descriptor.fields:
        path = prefix + field.name
        found[path] = (field.number, field.type, field.is_repeated)
        inner = field.message_type
        if field.type == FieldDescriptor.TYPE_MESSAGE and inner is not None and inner.full_name not in above:
            found |= _field_shapes(inner, f"{path}.", above | {descriptor.full_name})
    return found


def message_of(info: ChannelInfo) -> str:
    """Return the full protobuf name of the messages of a channel, or an empty text if the file has no schema for it."""
    return info.schema.name if info.schema is not None and info.schema.encoding == "protobuf" else ""


def why_not_decoded(decoder: MessageDecoder, info: ChannelInfo) -> LeftOutCause:
    """Return why the decoder has no message for a payload of this channel."""
    if decoder.class_of(info) is not None:
        return LeftOutCause.UNREADABLE
    is_protobuf = info.channel.message_encoding == "protobuf" and message_of(info)
    return LeftOutCause.BAD_SCHEMA if is_protobuf else LeftOutCause.NOT_PROTOBUF

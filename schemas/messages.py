"""Message classes by name, their encodings and JSON (that any Zenoh tool can read), and observations. No bus here."""

import json
from functools import cache
from typing import Any, Final

from google.protobuf import json_format
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message
from msgspec import Struct

from schemas.gen import fleet_v1_pb2
from schemas.topics import PROTOBUF
from schemas.words import Level

JSON: Final = "application/json"


class Observation(Struct, frozen=True):
    """A message, and the time from which its age counts: s, by the observer's clock."""

    message: Any
    at: float
    earlier: "tuple[Observation, ...]" = ()
    """Earlier observations that are kept for conditions over several readings, the newest last."""

    def aged(self, by_s: float) -> "Observation":
        """Return this observation as if it were `by_s` older."""
        return Observation(self.message, self.at - by_s, tuple(each.aged(by_s) for each in self.earlier))


class BadPayload(ValueError):
    """A payload that is not the expected message. The text gives the reason."""


@cache
def message_class(name: str) -> type[Message]:
    """Return the class of a full message name (`fleet.v1.Range`, `foxglove.Log`). Raises KeyError if it is unknown."""
    if name == "foxglove.Log":
        from foxglove_schemas_protobuf.Log_pb2 import Log

        return Log
    package, _, short = name.rpartition(".")
    found = getattr(fleet_v1_pb2, short, None) if package == "fleet.v1" else None
    if found is None:
        raise KeyError(name)
    return found  # type: ignore[no-any-return]  # getattr on the generated module


def encoding_of(name: str) -> str:
    """Return the Zenoh encoding of a message, with the full name in the schema part."""
    return f"{PROTOBUF};{name}"


def name_in(encoding: str) -> str | None:
    """Return the message name in a Zenoh encoding. None if it is not protobuf with a schema part."""
    kind, _, name = encoding.partition(";")
    return name if kind == PROTOBUF and name else None


def to_dict(message: Message) -> dict[str, Any]:
    """Return protobuf's JSON mapping with the field names of the .proto, without fields that were not measured."""
    return json_format.MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )


def to_json(message: Message) -> str:
    """Return `to_dict` as one line of JSON."""
    return json.dumps(to_dict(message), separators=(",", ":"))


_FOXGLOVE_LEVELS: Final = {Level.DEBUG: 1, Level.INFO: 2, Level.WARNING: 3, Level.ERROR: 4}


def log_message(at_ns: int, level: Level, name: str, words: str) -> Message:
    """Return a foxglove.Log. `at_ns` is in ns since the epoch."""
    message: Any = message_class("foxglove.Log")(level=_FOXGLOVE_LEVELS[level], name=name, message=words)
    message.timestamp.seconds, message.timestamp.nanos = divmod(at_ns, 1_000_000_000)
    return message  # type: ignore[no-any-return]  # the class has no types


def level_of(message: Any) -> Level:
    """Return the level of a foxglove.Log. A level below those that we write becomes DEBUG, one above them ERROR."""
    below = [level for level, number in _FOXGLOVE_LEVELS.items() if number <= message.level]
    return below[-1] if below else Level.DEBUG


def stamp_ns(stamp: Any) -> int:
    """Return a Timestamp as ns since the epoch."""
    return int(stamp.seconds * 1_000_000_000 + stamp.nanos)


def stamp_ms(stamp: Any) -> int:
    """Return a Timestamp as ms since the epoch. Unlike ToMilliseconds, accept nanoseconds that are out of range."""
    return stamp_ns(stamp) // 1_000_000


def parse(name: str, payload: bytes, encoding: str) -> Message:
    """Parse a payload as message `name`, protobuf or JSON by its encoding. Raises BadPayload."""
    kind, _, schema = encoding.partition(";")
    message = message_class(name)()
    if kind == PROTOBUF:
        if schema not in ("", name):
            raise BadPayload(f"the payload is a {schema}, this key takes {name}")
        try:
            message.ParseFromString(payload)
        except DecodeError:
            raise BadPayload(f"the payload does not parse as {name}") from None
        return message
    # Parse any other encoding as JSON: shells and REST clients seldom set one.
    try:
        json_format.Parse(payload, message)
    except (json_format.ParseError, UnicodeDecodeError) as error:
        words = " ".join(str(error).split())
        raise BadPayload(f"the payload is not the JSON of {name}: {words}") from None
    return message


@cache
def descriptor_set(name: str) -> bytes:
    """Return the FileDescriptorSet of a message, dependencies first, as MCAP embeds it in a schema."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(descriptor: Any) -> None:  # the stubs know two FileDescriptor types, upb's and pure Python's
        if descriptor.name in seen:
            return
        seen.add(descriptor.name)
        for dependency in descriptor.dependencies:
            add(dependency)
        proto = FileDescriptorProto()
        descriptor.CopyToProto(proto)
        files.file.append(proto)

    add(message_class(name).DESCRIPTOR.file)
    return files.SerializeToString()

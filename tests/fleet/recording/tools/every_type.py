"""A session with every recorded type of message, made from the table of topics and the messages' own fields."""

from collections import Counter
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from schemas import messages
from schemas.commands import COMMANDS
from schemas.topics import CAR_TOPICS, SERVICE_TOPICS
from tests.fleet.replay.make_session import START_NS

EACH = 4
"""Number of messages of a type: three with different values in all fields, and one without fields."""
TEXTS = ('with "quotes", commas\r\nand lines', "ümläut, 漢字", " spaces ")


def filled(message: Any, number: int, depth: int = 0) -> Any:
    """Give every field a value of its own."""
    for at, field in enumerate(message.DESCRIPTOR.fields):
        name = field.name
        if name in ("stamp", "timestamp"):
            getattr(message, name).FromNanoseconds(1_790_000_000_123_456_789 + number)
        elif field.message_type is not None and field.message_type.GetOptions().map_entry:
            of = field.message_type.fields_by_name["value"]
            getattr(message, name).update({f"k{part}": _value(of, number + part) for part in range(3)})
        elif field.message_type is not None and depth < 2:
            inner = getattr(message, name)
            for part in range(2) if field.is_repeated else (0,):
                filled(inner.add() if field.is_repeated else inner, number + part, depth + 1)
        elif field.message_type is None:
            value = _value(field, number * 100 + at)
            if field.is_repeated:
                getattr(message, name).extend([value, _value(field, number * 100 + at + 7)])
            else:
                setattr(message, name, value)
    return message


def _value(field: Any, number: int) -> Any:
    match field.cpp_type:
        case field.CPPTYPE_DOUBLE | field.CPPTYPE_FLOAT:
            return number + 0.1
        case field.CPPTYPE_BOOL:
            return bool(number % 2)
        case field.CPPTYPE_INT32:
            return -number
        case field.CPPTYPE_ENUM:
            return number % 5
        case field.CPPTYPE_UINT64:
            return 2**63 + number
        case field.CPPTYPE_STRING if field.type == field.TYPE_BYTES:
            return bytes([number % 256, 0, 255])
        case field.CPPTYPE_STRING:
            return f"{number} {TEXTS[number % 3]}"
        case _:
            return number


def keys_and_types() -> dict[str, str]:
    """Return key and full message name, one of each topic, and the published command."""
    return {
        **{f"fleet/red/{topic.name}": topic.message for topic in CAR_TOPICS},
        **{f"fleet/{topic.name}": topic.message for topic in SERVICE_TOPICS},
        "fleet/red/@cmd/drive": COMMANDS["drive"].message,
    }


def make(path: Path) -> Counter[str]:
    """Write one MCAP file with mcap's writer. Return the number of messages by key."""
    counts: Counter[str] = Counter()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {
            key: writer.register_channel(
                key, "protobuf", writer.register_schema(name, "protobuf", messages.descriptor_set(name))
            )
            for key, name in keys_and_types().items()
        }
        at_ns = START_NS
        for number in range(EACH):
            for key, name in keys_and_types().items():
                message = messages.message_class(name)()
                if number < EACH - 1:
                    filled(message, number)
                at_ns += 1_000_001
                counts[key] += 1
                writer.add_message(channels[key], at_ns, message.SerializeToString(), at_ns - 1234, counts[key])
        writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
    return counts

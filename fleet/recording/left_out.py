"""Counts the messages that a view, a table or a replay leaves out, by key and cause. Pure.

A module that shows recorded messages counts here those that it does not show. So recorded = shown + left out.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any, Final

from msgspec import Struct, field

from schemas.printable import printable

MAX_LEFT_OUT_LINES: Final = 20
"""Maximum number of lines to print. One more line sums up the rest."""


class LeftOutCause(StrEnum):
    """Why a message is left out."""

    OTHER_TYPE = "not of the type of its key"
    NOT_PROTOBUF = "not protobuf"
    UNREADABLE = "does not match its schema"
    BAD_SCHEMA = "its schema is unreadable"
    OTHER_FIELD = "its schema lacks a field of the condition, or has another type for it"
    UNKNOWN_ENUM = "has a number that its schema has no name for"
    VIEWER = "not read by Rerun"
    NO_FLEET = "not a key of a car or service that is replayed"
    COMMAND = "a command, which is never published again"
    BAD_KEY = "the bus cannot carry its key"
    TOO_MANY_TOPICS = "of too many topics"
    LONG_ENCODING = "the bus cannot carry its encoding: over 255 bytes"


class LeftOut(Struct):
    """Number of messages by key and cause."""

    counts: Counter[tuple[str, LeftOutCause]] = field(default_factory=Counter)

    def add(self, key: str, cause: LeftOutCause, count: int = 1) -> None:
        """Count messages. 0 adds nothing."""
        if count:
            self.counts[key, cause] += count

    @property
    def total(self) -> int:
        """Return the number of messages left out."""
        return self.counts.total()

    def by_key(self) -> Mapping[str, int]:
        """Return the number of messages left out by key."""
        found: Counter[str] = Counter()
        for (key, _), count in self.counts.items():
            found[key] += count
        return found

    def words(self) -> Iterator[str]:
        """Yield a line for each key and cause, those with the most messages first, fit for a terminal."""
        ordered = sorted(self.counts.items(), key=lambda each: (-each[1], each[0]))
        for (key, cause), count in ordered[:MAX_LEFT_OUT_LINES]:
            yield f"{count} of {printable(key)}: {cause}"
        if rest := ordered[MAX_LEFT_OUT_LINES:]:
            yield f"{sum(count for _, count in rest)} more, of {len(rest)} other keys or causes"


def has_unknown_enum(message: Any) -> bool:
    """Return True if an enum of a message, or of a message in it, has a number without a name. Rerun would abort."""
    for descriptor, value in message.ListFields():
        values = value if descriptor.is_repeated else (value,)
        if descriptor.message_type is not None:
            if descriptor.message_type.GetOptions().map_entry:
                of = descriptor.message_type.fields_by_name["value"]
                items = tuple(value.values())
                if of.enum_type is not None and any(each not in of.enum_type.values_by_number for each in items):
                    return True
                values = items if of.message_type is not None else ()
            if any(map(has_unknown_enum, values)):
                return True
        elif descriptor.enum_type is not None:
            named = descriptor.enum_type.values_by_number
            if any(each not in named for each in values):
                return True
    return False


def may_have_enum(descriptor: Any, above: frozenset[str] = frozenset()) -> bool:
    """Return True if messages of this type, or messages inside them, have an enum."""
    inside = above | {descriptor.full_name}
    return any(
        field.enum_type is not None
        or (
            field.message_type is not None
            and field.message_type.full_name not in inside
            and may_have_enum(field.message_type, inside)
        )
        for field in descriptor.fields
    )

"""Selects messages of a session by key expression and by time of the recorder's clock. Pure; reads no files."""

import re
from contextlib import suppress
from functools import cache
from typing import Final

from msgspec import Struct

from schemas import keys
from schemas.commands import COMMANDS
from schemas.topics import TOPICS


class Selection(Struct, frozen=True):
    """Selection by keys and by time from `start_ns` (included) to `end_ns` (excluded). None means no limit."""

    keys: tuple[str, ...] | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    def has_key(self, key: str) -> bool:
        """Return True if messages of this key are selected."""
        return self.keys is None or any(matches(expression, key) for expression in self.keys)

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """Return True if any time between these two (both included) is selected."""
        return (self.start_ns is None or last_ns >= self.start_ns) and (self.end_ns is None or first_ns < self.end_ns)

    def has_time(self, at_ns: int) -> bool:
        """Return True if messages of this time are selected."""
        return self.overlaps(at_ns, at_ns)


EVERYTHING: Final = Selection()


_GROUPS: Final = frozenset(topic.partition("/")[0] for topic in TOPICS)
"""First chunks of topics."""


def key_expressions(name: str, fleet: str) -> tuple[str, ...]:
    """Return the key expressions of a topic (`sensor/*`), a message, or a key with or without the fleet's name."""
    if name.partition("/")[0] in _GROUPS:
        return (_any_fleet(name),)
    messages = (name, f"fleet.v1.{name}")
    found = [_any_fleet(topic.name) for topic in TOPICS.values() if topic.message in messages]
    found += [f"*/*/@cmd/{command.verb}" for command in COMMANDS.values() if command.message in messages]
    if found:
        return tuple(found)
    if name.partition("/")[0] not in (fleet, "**"):
        with suppress(keys.BadKey):
            return name, keys.expand(name, fleet)
    return (name,)


def _any_fleet(topic: str) -> str:
    return f"*/{topic}" if topic.startswith("@") else f"*/*/{topic}"


def matches(expression: str, key: str) -> bool:
    """Return True if a key equals or matches a key expression of the bus.

    `*` matches one chunk (the text between two slashes), `**` any number of chunks, `$*` any part of a chunk. None of
    them matches a chunk that begins with @.
    """
    return expression == key or ("*" in expression and _pattern(expression).fullmatch(f"{key}/") is not None)


@cache
def _pattern(expression: str) -> re.Pattern[str]:
    parts = []
    for chunk in expression.split("/"):
        if chunk == "**":
            parts.append("(?:[^@/][^/]*/)*")
        elif chunk == "*":
            parts.append("[^@/][^/]*/")
        else:
            first = "(?!@)" if chunk.startswith("$*") else ""
            parts.append(first + "[^/]*".join(re.escape(part) for part in chunk.split("$*")) + "/")
    return re.compile("".join(parts))

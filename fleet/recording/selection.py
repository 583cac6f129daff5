"""Which messages of a session are meant: by key expression and by the recorder's time. Pure; no files here."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Final, Self


@dataclass(frozen=True, slots=True)
class Selection:
    """Messages of some keys, from `start_ns` until before `end_ns` of the recorder's clock; None: no bound."""

    keys: tuple[str, ...] | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    @classmethod
    def of(cls, keys: Iterable[str] | None, start_ns: int | None, end_ns: int | None) -> Self:
        """As `Session.messages` takes it; one key may be given as it is."""
        if isinstance(keys, str):
            keys = (keys,)
        return cls(None if keys is None else tuple(keys), start_ns, end_ns)

    def has_key(self, key: str) -> bool:
        """Whether messages of this key are meant."""
        return self.keys is None or any(matches(expression, key) for expression in self.keys)

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """Whether some of what lies between two times, both included, can be meant."""
        return (self.start_ns is None or last_ns >= self.start_ns) and (self.end_ns is None or first_ns < self.end_ns)

    def has_time(self, at_ns: int) -> bool:
        """Whether messages of this time are meant."""
        return self.overlaps(at_ns, at_ns)


EVERYTHING: Final = Selection()


def matches(expression: str, key: str) -> bool:
    """Whether a key is the one that is written, or matches a key expression of the bus.

    `*` is one chunk, `**` any number of them, `$*` any part of one; none of them matches a chunk that begins with @.
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
            parts.append("[^/]*".join(re.escape(part) for part in chunk.split("$*")) + "/")
    return re.compile("".join(parts))

"""Key expressions: build them, take them apart, check names. Pure; what lies under the keys is in topics.py."""

import re
from dataclasses import dataclass
from typing import Final

DEFAULT_FLEET: Final = "fleet"
NAME_RULE: Final = "1 to 32 of a-z, 0-9, _ and -, beginning with a letter or digit"
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")

COORDINATOR: Final = "@coordinator"
RECORDER: Final = "@recorder"
SUPERVISOR: Final = "@supervisor"
SIMULATOR: Final = "@sim"
OPERATOR: Final = "@operator"
REPLAY: Final = "@replay"
"""`<fleet>/@replay/<session>`: the token that says that a fleet is a recording."""


class BadKey(ValueError):
    """A name or a key expression that is not allowed; its text says which, and what is."""


def check_name(name: str, what: str = "car name") -> str:
    """Return `name` if it may be a car's or a fleet's; raises BadKey naming it and the rule."""
    if not _NAME.fullmatch(name):
        raise BadKey(f"{what} {name!r} is not allowed: use {NAME_RULE}")
    return name


@dataclass(frozen=True, slots=True)
class Key:
    """A concrete key, taken apart: `fleet/red/sensor/range` is (fleet, red, sensor/range)."""

    fleet: str
    car: str
    topic: str

    def __str__(self) -> str:
        return f"{self.fleet}/{self.car}/{self.topic}" if self.topic else f"{self.fleet}/{self.car}"


def parse(key: str) -> Key | None:
    """Take a concrete key apart; None if it has no fleet and car."""
    fleet, _, rest = key.partition("/")
    car, _, topic = rest.partition("/")
    return Key(fleet, car, topic) if fleet and car else None


def topic_key(fleet: str, car: str, topic: str) -> str:
    """The key of one topic of one car, or of a service (`@recorder`)."""
    return f"{fleet}/{car}/{topic}"


def command_key(fleet: str, car: str, verb: str) -> str:
    """The key on which a car takes a command."""
    return f"{fleet}/{car}/@cmd/{verb}"


def car_token(fleet: str, car: str) -> str:
    """The liveliness token of a car's gateway."""
    return f"{fleet}/{car}"


def operator_token(fleet: str, sender: str) -> str:
    """The liveliness token of a sender that wants to be watched; `sender` must be one chunk without wildcards."""
    if not sender or set(sender) & set("/*$#?"):
        raise BadKey(f"sender {sender!r} is not allowed: no /, *, $, # or ?, at least one character")
    return f"{fleet}/{OPERATOR}/{sender}"


def recorded(fleet: str) -> tuple[str, ...]:
    """What a recorder subscribes to: `**` does not match chunks that begin with @."""
    services = (f"{fleet}/{service}/**" for service in (COORDINATOR, RECORDER, SUPERVISOR, SIMULATOR))
    return (f"{fleet}/**", *services, f"{fleet}/*/@cmd/drive")


def expand(expression: str, fleet: str = DEFAULT_FLEET) -> str:
    """Write a short form out: `red` is every reading of red; `red/sensor/range`, `*/sensor/battery` get the fleet.

    An expression that begins with the fleet's name (or with `**`) is taken as written. Raises BadKey.
    """
    text = expression.strip("/")
    if not text or "//" in text or set(text) & set("#? \t\n"):
        raise BadKey(
            f"key expression {expression!r} is not allowed: chunks separated by single /, "
            "* for one chunk, ** for any number; for example red, red/sensor/range or '*/sensor/battery'"
        )
    chunks = text.split("/")
    for chunk in chunks:
        if "*" in chunk.replace("$*", "") and chunk not in ("*", "**"):
            raise BadKey(
                f"key expression {expression!r} is not allowed: * and ** stand alone between /, inside a chunk write $*"
            )
    if chunks[0] in (fleet, "**"):
        chunks = chunks[1:] if chunks[0] == fleet else chunks
        if not chunks:
            chunks = ["*"]
        if chunks[0] == "**":
            return f"{fleet}/{'/'.join(chunks)}"
    if len(chunks) == 1 and chunks[0] != "**":
        chunks += ["sensor", "*"]
    return "/".join([fleet, *chunks])

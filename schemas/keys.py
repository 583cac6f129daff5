"""Builds, parses and checks keys, key expressions and names. Pure. `topics` lists the topics under the keys.

A key is the address of a message on the Zenoh bus, such as `fleet/red/sensor/range`: chunks with slashes between them.
A key expression is a key that may have wildcards, such as `fleet/*/sensor/range`. A liveliness token is a key that
others can see on the bus while the program that declared it is connected.
"""

import re
from typing import Final, NamedTuple

DEFAULT_FLEET: Final = "fleet"
NAME_RULE: Final = "1 to 32 of a-z, 0-9, _ and -, beginning with a letter or digit"
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")

COORDINATOR: Final = "@coordinator"
RECORDER: Final = "@recorder"
SUPERVISOR: Final = "@supervisor"
SIMULATOR: Final = "@sim"
OPERATOR: Final = "@operator"
BY: Final = "@by"
"""Part of a command's key before the identity that the rules of the hub have checked."""
HUB_RULES: Final = "@hub/rules"
"""Key at which the first hub answers the hubs of other sites, which are linked to it, with their rules."""
HUB_RENEWAL: Final = "@hub/@renew"
"""`@hub/@renew/<identity>` is where the first hub answers that identity with its next certificate."""
REPLAY: Final = "@replay"
"""`<fleet>/@replay/<session>` is the token of a program that plays this session in the fleet."""


class BadKey(ValueError):
    """An invalid name or key expression. The text names it and the rule."""


def is_name(name: str) -> bool:
    """Return True for a valid name of a car or fleet."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str, what: str = "car name") -> str:
    """Return `name` if it is a valid name of a car or fleet. Raises BadKey."""
    if not is_name(name):
        likely = name.strip().lower().replace(" ", "_")
        near = f". Did you mean {likely}?" if is_name(likely) else ""
        raise BadKey(f"{what} {name!r} is not allowed: use {NAME_RULE}{near}")
    return name


def person_of(sender: str) -> str:
    """Return the person of a sender: `group_a` of `group_a@host-4711`."""
    return sender.partition("@")[0]


def name_of(sender: str) -> str:
    """Return a sender's name as texts show it: only the person. JSON and records also have the host and the process."""
    return person_of(sender) or sender


def describe_fleet(fleet: str) -> str:
    """Return a fleet's name as texts show it. The default name is left out."""
    return "the fleet" if fleet == DEFAULT_FLEET else f"fleet {fleet}"


class Key(NamedTuple):
    """The parts of a concrete key: `fleet/red/sensor/range` is (fleet, red, sensor/range)."""

    fleet: str
    car: str
    topic: str

    def __str__(self) -> str:
        return f"{self.fleet}/{self.car}/{self.topic}" if self.topic else f"{self.fleet}/{self.car}"


def parse(key: str) -> Key | None:
    """Split a concrete key. Return None if it has no fleet and car."""
    fleet, _, rest = key.partition("/")
    car, _, topic = rest.partition("/")
    return Key(fleet, car, topic) if fleet and car else None


def topic_key(fleet: str, car: str, topic: str) -> str:
    """Return the key of one topic of one car, or of a service (`@recorder`)."""
    return f"{fleet}/{car}/{topic}"


def command_key(fleet: str, car: str, verb: str, identity: str = "") -> str:
    """Return the key of a car's command. On a hub with rules, it carries the `identity` of the certificate."""
    by = f"{BY}/{identity}/" if identity else ""
    return f"{fleet}/{car}/@cmd/{by}{verb}"


def command_keys(fleet: str, car: str, verb: str = "*") -> tuple[str, str]:
    """Return the key expressions of a car's commands, without and with an identity."""
    return command_key(fleet, car, verb), command_key(fleet, car, verb, "*")


def identity_of(key: str) -> str:
    """Return the identity in the key of a command, or an empty text if it has none."""
    before, by, rest = key.rpartition(f"/@cmd/{BY}/")
    return rest.partition("/")[0] if before and by else ""


def car_token(fleet: str, car: str) -> str:
    """Return the liveliness token of a car's gateway."""
    return f"{fleet}/{car}"


def recorder_token(fleet: str, site: str = "") -> str:
    """Return the liveliness token of a fleet's recorder, or of its recorder at another site.

    The key of that recorder's status begins with this token.
    """
    return f"{fleet}/{RECORDER}/{site}" if site else f"{fleet}/{RECORDER}"


def recorder_site(fleet: str, token: str) -> str | None:
    """Return the site of a recorder's token, empty for the recorder of the fleet, or None for another key."""
    start, _, site = token.partition(f"{fleet}/{RECORDER}")
    if start or not (site == "" or site.startswith("/")):
        return None
    site = site[1:]
    return site if not site or is_name(site) else None


def renewal_key(identity: str) -> str:
    """Return where an identity asks for its next certificate. The rules of the hub let nobody else ask there."""
    return f"{HUB_RENEWAL}/{identity}"


def replay_token(fleet: str, session: str = "*") -> str:
    """Return the liveliness token of a program that plays a session in a fleet."""
    return f"{fleet}/{REPLAY}/{session}"


def operator_token(fleet: str, sender: str) -> str:
    """Return the liveliness token of a sender. Raises BadKey unless `sender` is one chunk without wildcards."""
    if not sender or set(sender) & set("/*$#?"):
        raise BadKey(f"sender {sender!r} is not allowed: no /, *, $, # or ?, at least one character")
    return f"{fleet}/{OPERATOR}/{sender}"


def recorded_keys(fleet: str) -> tuple[str, ...]:
    """Return the key expressions of a recorder's subscriptions. `**` does not match chunks that begin with @."""
    services = (f"{fleet}/{service}/**" for service in (COORDINATOR, RECORDER, SUPERVISOR, SIMULATOR))
    return (f"{fleet}/**", *services, *command_keys(fleet, "*", "drive"))


def expand(expression: str, fleet: str = DEFAULT_FLEET) -> str:
    """Return the whole key expression of a short form. Raises BadKey.

    `red` and `fleet/red` stand for every reading of red. The fleet's name is put before an expression that does not
    begin with it, such as `red/sensor/range`, `*/sensor/battery` or `**`.
    """
    text = expression.strip("/")
    if not text or "//" in text or set(text) & set("#? \t\n"):
        raise BadKey(
            f'"{expression}" is not a key. Write parts with one / between: red, red/sensor/range, '
            "'*/sensor/battery' (* is one part, ** any number)."
        )
    chunks = text.split("/")
    for chunk in chunks:
        if "*" in chunk.replace("$*", "") and chunk not in ("*", "**"):
            raise BadKey(f'"{expression}" is not a key. * and ** stand alone between /; within a part write $*.')
    if chunks[0] in (fleet, "**"):
        chunks = chunks[1:] if chunks[0] == fleet else chunks
        if not chunks:
            chunks = ["*"]
        if chunks[0] == "**":
            return f"{fleet}/{'/'.join(chunks)}"
    if len(chunks) == 1 and chunks[0] != "**":
        chunks += ["sensor", "*"]
    return "/".join([fleet, *chunks])

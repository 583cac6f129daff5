"""Identities: whose certificate a program has on a hub with rules, and for whom it may speak. Pure.

An identity is `person.mia`, `car.red`, `service.recorder` or, at another site, `service.recorder@north`. It is the
common name of a certificate, and a part of the keys of its commands (`keys.command_key`). The hub's rules let nobody
use the identity of somebody else. But the name of the sender in a command is only text. So whoever carries out a
command checks that name: a gateway with `speaks_for`, a service with `sender_for`.
"""

from enum import StrEnum
from typing import Final

from schemas.commands import COMMANDS, STOPS, Verb
from schemas.keys import is_name, person_of
from schemas.words import Rank


class IdentityRole(StrEnum):
    """The kind of an identity's owner."""

    PERSON = "person"
    CAR = "car"
    """The gateway of a car."""
    SERVICE = "service"
    SITE = "site"
    """The hub of another site, which is linked to this one."""


class Service(StrEnum):
    """The services that have an identity."""

    SUPERVISOR = "supervisor"
    COORDINATOR = "coordinator"
    RECORDER = "recorder"
    CONSOLE = "console"
    SIMULATOR = "sim"
    LOCATOR = "locator"
    """A program that measures where cars are, such as a camera above the floor."""


ANONYMOUS: Final = "anonymous"
"""The sender of a command that names none, on a hub without certificates."""
_AT: Final = "@"
"""Separates a service from the site where it runs."""
_FORWARDED: Final = frozenset({Verb.ESTOP, Verb.RESUME, Verb.PAUSE, Verb.UNPAUSE})
"""Verbs that a gateway passes on to the others, in the name of the sender who gave it the command."""


def person(name: str) -> str:
    """Return the identity of a person."""
    return f"{IdentityRole.PERSON}.{name}"


def car(name: str) -> str:
    """Return the identity of a car's gateway."""
    return f"{IdentityRole.CAR}.{name}"


def service(name: Service, at_site: str = "") -> str:
    """Return the identity of a service. `at_site` is the other site where it runs, or empty at the first hub."""
    return f"{IdentityRole.SERVICE}.{name}{_AT}{at_site}" if at_site else f"{IdentityRole.SERVICE}.{name}"


def site(name: str) -> str:
    """Return the identity of the hub of another site."""
    return f"{IdentityRole.SITE}.{name}"


AS_THE_USER: Final = frozenset({service(Service.CONSOLE), service(Service.SIMULATOR)})
"""The services that use the certificate of the user if they have none. Then the console acts as that person, and the
simulator publishes no truth."""


class NotTheSender(Exception):
    """A command names a sender for whom the owner of the certificate may not speak."""


def parse(identity: str) -> tuple[IdentityRole, str] | None:
    """Return the role and the name of an identity, or None if it is not one. The site of a service is left out."""
    role, _, name = identity.partition(".")
    if role == IdentityRole.SERVICE:
        name, at, site = name.partition(_AT)
        if name not in tuple(Service) or (at and not is_name(site)):
            return None
    if role not in tuple(IdentityRole) or not is_name(name):
        return None
    return IdentityRole(role), name


def role_of(identity: str) -> IdentityRole | None:
    """Return the role of an identity, or None if it is not one."""
    known = parse(identity)
    return None if known is None else known[0]


def speaks_for(identity: str, sender: str, kind: str, verb: str) -> bool:
    """Return True if an identity may send this command in the name of a sender of this kind.

    The console checks by pairing who its people are, so it may speak for any person. The supervisor may stop cars,
    because it stops them when it ends.
    """
    known = parse(identity)
    if known is None:
        return False
    role, name = known
    match role:
        case IdentityRole.PERSON:
            return person_of(sender) == name and kind != Rank.COORDINATOR
        case IdentityRole.CAR:
            return verb in _FORWARDED
        case IdentityRole.SERVICE:
            is_coordinator = kind == Rank.COORDINATOR
            if name == Service.COORDINATOR:
                return is_coordinator
            if name == Service.SUPERVISOR:
                return verb in STOPS or verb not in COMMANDS  # the others are verbs of services, such as a new plan
            return name == Service.CONSOLE and not is_coordinator
        case IdentityRole.SITE:
            return False  # the hub of a site passes on what others send under their own identities


def may_locate(identity: str, of: str) -> bool:
    """Return True if an identity may publish the pose of this car. The car's own gateway and a locator may.

    `identity` is empty on a hub without certificates, where everyone may.
    """
    return identity in ("", car(of)) or parse(identity) == (IdentityRole.SERVICE, Service.LOCATOR)


def sender_for(identity: str, sender: str, verb: str) -> str:
    """Return the sender of a person's command to a service: the name in the command, else the certificate's owner.

    `identity` is empty on a hub without certificates, where every name is believed. Raises NotTheSender.
    """
    sender = sender or identity.partition(".")[2] or ANONYMOUS
    if identity and not speaks_for(identity, sender, Rank.PERSON, verb):
        raise NotTheSender(f"{identity} asks in the name of {sender}. Each certificate speaks for its owner only.")
    return sender

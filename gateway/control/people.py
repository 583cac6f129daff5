"""The senders of commands, and the people as the gateway of one car knows them: who may drive it, who is a lead. Pure.

Without a table every person may drive every car, and nobody is a lead. A name on the bus is a convention: the gateway
checks nobody's identity.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Self

from schemas.keys import NAME_RULE, is_name, person_of
from schemas.words import Rank


@dataclass(frozen=True, slots=True)
class Sender:
    """The sender of a command."""

    name: str = "anonymous"
    kind: Rank = Rank.SCRIPT

    @property
    def person(self) -> str:
        """Return the person: `group_a` of `group_a@host-4711`."""
        return person_of(self.name)


class PersonRole(StrEnum):
    """The role of a person for this car."""

    DRIVER = "driver"
    LEAD = "lead"
    OTHER = "other"
    """A person of the fleet who drives other cars."""


@dataclass(frozen=True, slots=True)
class People:
    """The table of one car. `roles` is None if the fleet has no people."""

    roles: dict[str, PersonRole] | None = None

    @classmethod
    def parse(cls, entries: Iterable[str]) -> Self:
        """Return the table of the entries `teacher:lead`, `group_a`, `group_b:other`. Raises ValueError."""
        return cls(dict(_parse(entry) for entry in entries))

    @property
    def leads(self) -> tuple[str, ...]:
        """Return the names of the leads, sorted."""
        return self.named(PersonRole.LEAD)

    def named(self, role: PersonRole) -> tuple[str, ...]:
        """Return the names of the people with this role, sorted."""
        return tuple(sorted(name for name, each in (self.roles or {}).items() if each is role))

    def ranked(self, sender: Sender) -> Sender:
        """Return the sender with its rank: only a person whom the table names as a lead is one."""
        if sender.kind not in (Rank.PERSON, Rank.LEAD):
            return sender
        leads = self.role(sender.person) is PersonRole.LEAD
        return replace(sender, kind=Rank.LEAD if leads else Rank.PERSON)

    def role(self, person: str) -> PersonRole | None:
        """Return what a person is to this car; None for a person who is not listed."""
        return PersonRole.DRIVER if self.roles is None else self.roles.get(person)

    def may_drive(self, person: str) -> bool:
        """Return True if this person, and the scripts of this person, may drive the car."""
        return self.role(person) in (PersonRole.DRIVER, PersonRole.LEAD)

    def may_end(self, sender: Sender, by: str, rank: Rank) -> bool:
        """Return True if this sender may end what `by` of this rank began. Only a lead ends what a lead began."""
        if rank is not Rank.LEAD or sender.kind is Rank.LEAD:
            return True
        if self.roles is None:
            # A gateway without a table knows one lead: who began it. If another lead ends a pause or a fleet-wide
            # e-stop at the other gateways, this one learns the end from them.
            return sender.kind is Rank.PERSON and sender.person == person_of(by)
        # After a restart with another table there may be no lead: then the car must not stay stopped for ever.
        return not self.leads


NO_PEOPLE: Final = People()
"""A fleet without people."""
_ROLES: Final = {"": PersonRole.DRIVER, "lead": PersonRole.LEAD, "other": PersonRole.OTHER}


def _parse(entry: str) -> tuple[str, PersonRole]:
    name, _, role = entry.partition(":")
    if not is_name(name) or role not in _ROLES:
        raise ValueError(f"{entry!r} is no person: write NAME, NAME:lead or NAME:other ({NAME_RULE})")
    return name, _ROLES[role]

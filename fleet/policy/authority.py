"""Decides who may act on the whole fleet: change its plan, and start and stop its recorder. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Authority:
    """The people of a fleet. names: all of them (None: the fleet lists nobody). leads: the leads among them."""

    leads: tuple[str, ...] = ()
    names: frozenset[str] | None = None

    def lists(self, person: str) -> bool:
        """Return True if this person is one of the fleet, or if the fleet lists nobody."""
        return self.names is None or person in self.names

    def refusal(self, person: str) -> str:
        """Return why this person may not act on the fleet; empty if allowed. If there are leads, only they may."""
        if person in self.leads:
            return ""
        if self.leads:
            return f"Only a lead may ({', '.join(self.leads)})."
        return "" if self.lists(person) else unlisted_words(person)


def authority_of(people: Any) -> Authority:
    """Return the people of a fleet.v1.CarPeople, or of what has its fields. None: its gateway knows nobody."""
    if people is None:
        return Authority()
    return Authority(tuple(people.leads), frozenset((*people.leads, *people.drivers, *people.others)))


def merge_authority(parts: Iterable[Authority]) -> Authority:
    """Return the people that several gateways know."""
    known = list(parts)
    listed = [each.names for each in known if each.names is not None]
    leads = dict.fromkeys(lead for each in known for lead in each.leads)
    return Authority(tuple(leads), frozenset().union(*listed) if listed else None)


def unlisted_words(person: str) -> str:
    """Return what a person may do whom the fleet file does not list, in words."""
    return f"{person} watches and stops: the fleet file does not list {person}."

"""The rights of a person on a car, in words, so that a page shows beforehand what a gateway would refuse. Pure."""

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, Final

from fleet.policy.denial_words import describe, fleet_refusal
from schemas.keys import person_of
from schemas.rights import Authority, People, Right, Sender
from schemas.words import Rank

GUEST_REFUSAL: Final = "You watch, and you can STOP. A lead assigns this device on the page Board."


def refusals(car: str, authority: Authority, sender: str) -> dict[Right, str]:
    """Return the rights that this sender, a person, does not have, each with the reason in words.

    A stop is always allowed.
    """
    people = authority.people
    ranked = people.ranked(Sender(sender, Rank.PERSON))
    denials = {right: authority.denies(ranked, right) for right in Right}
    return {right: describe(each, ranked, people, car) for right, each in denials.items() if each is not None}


def management_refusal(cars: Mapping[str, Authority], sender: str) -> str:
    """Return why this person may not start and stop the recorder and plans. Empty if they may.

    The recorder and plans are for the whole fleet. The coordinator and the recorder decide by the same rule, so a page
    can show the refusal beforehand.
    """
    return fleet_refusal(People.merged(each.people for each in cars.values()), person_of(sender))


def rights_of(sender: str, cars: Mapping[str, Authority]) -> dict[str, Any]:
    """Return the words of what is refused to this sender, by car and action, and for the whole fleet.

    `mine` are the cars that this sender may drive by the people of the fleet and by loans, whatever else refuses now.
    """
    by_car = {car: _cached(car, authority, sender) for car, authority in cars.items()}
    fleet = {str(right): next(_common(by_car, right), "") for right in (Right.PAUSE, Right.UNPAUSE)}
    fleet["manage"] = management_refusal(cars, sender)
    leads = any(person_of(sender) in each.people.leads for each in cars.values())
    mine = [car for car, authority in cars.items() if _is_mine(authority, sender)]
    return {"cars": by_car, **fleet, "lead": leads, "mine": mine}


def guest_rights(cars: Iterable[str]) -> dict[str, Any]:
    """Return the rights of a device of a class that nobody has assigned yet, in the form of `rights_of`.

    It may only stop.
    """
    refused = dict.fromkeys(map(str, Right), GUEST_REFUSAL)
    fleet = dict.fromkeys((str(Right.PAUSE), str(Right.UNPAUSE), "manage"), GUEST_REFUSAL)
    return {"cars": dict.fromkeys(cars, refused), **fleet, "lead": False, "mine": []}


def _is_mine(authority: Authority, sender: str) -> bool:
    return authority.denies_drive(authority.people.ranked(Sender(sender, Rank.PERSON))) is None


def _common(by_car: Mapping[str, Mapping[Right, str]], right: Right) -> Iterator[str]:
    """If every car refuses this right, yield the words of the first car."""
    if by_car and all(right in refused for refused in by_car.values()):
        yield next(iter(by_car.values()))[right]


@lru_cache(maxsize=4096)  # called ten times a second, for each page and car
def _cached(car: str, authority: Authority, sender: str) -> Mapping[Right, str]:
    return refusals(car, authority, sender)

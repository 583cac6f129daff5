"""Describes a denial of a right in a few words, for a page or an answer. Pure.

The gateway's own texts are longer, because they say what to type.
"""

from schemas.keys import person_of
from schemas.rights import Bar, Denial, Estop, FleetPause, LeaseState, Loan, People, Sender
from schemas.words import Rank


def describe(denial: Denial, sender: Sender, people: People, car: str) -> str:
    """Return a text about a denial, for the denied person.

    `car` is not used for rights that are about the whole fleet.
    """
    mark, person = denial.mark, sender.person
    by = person_of(mark.by) if mark is not None else ""
    who = f"{by}: {mark.why}" if isinstance(mark, Estop | FleetPause) and mark.why else by
    match denial.bar:
        case Bar.NOT_A_LEAD:
            return f"Only a lead may ({', '.join(people.leads)})."
        case Bar.UNLISTED:
            return f"{person} watches and stops: the fleet file does not list {person}."
        case Bar.OTHER_CAR:
            return f"{person} drives other cars, not {car}."
        case Bar.LENT if isinstance(mark, Loan):
            return f"{car} is lent to {mark.to} (by {by})."
        case Bar.ESTOPPED:
            return f"{car} is emergency-stopped ({who})."
        case Bar.LEADS_ESTOP:
            return f"{who}: only a lead ends this e-stop."
        case Bar.PAUSED:
            return f"The fleet is paused ({who})."
        case Bar.LEADS_PAUSE:
            return f"{who}: only a lead ends this pause."
        case Bar.LEADS_HOLD:
            return f"{by} stopped {car}: only a lead lets it go."
        case Bar.LEASED if isinstance(mark, LeaseState):
            todo = "Take it over." if sender.kind is mark.holder.kind else "Wait until the car is free."
            return f"{by} drives {car}. {todo}"
        case _:
            raise AssertionError(f"no person meets {denial}")


def fleet_refusal(people: People, person: str) -> str:
    """Return why a person may not change the plan or recorder of the whole fleet, or an empty text if they may."""
    sender = people.ranked(Sender(person, Rank.PERSON))
    denial = people.denies_directing(sender)
    return "" if denial is None else describe(denial, sender, people, "")

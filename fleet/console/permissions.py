"""The rights of a person on a car, with the reasons: the gateway's rules again, so that a page shows them. Pure.

The gateway decides (`gateway.control.arbiter`). A test compares both in one table.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Self

from fleet.policy.authority import Authority, authority_of, merge_authority, unlisted_words
from schemas.keys import person_of
from schemas.words import Rank, Reason, Scope, Verb

ACTIONS: Final = ("move", "act", "take", "resume", "end_estops", "pause", "unpause", "lend", "end_loan")
"""`move`: drive, modes, speed, servos, arm, fan. `act`: lights and sound. A stop is always allowed."""
_RANKS: Final = {str(rank): number for number, rank in enumerate(reversed(Rank))}

Refusal = tuple[str, str]
"""The gateway's reason, and words."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Who did something to a car: an e-stop, a hold, a pause or a lease."""

    by: str
    rank: str
    why: str = ""
    fleet_wide: bool = False

    @property
    def person(self) -> str:
        """The person of the sender."""
        return person_of(self.by)


@dataclass(frozen=True, slots=True)
class CarRules:
    """The facts that decide about rights on a car, from its `state/safety`."""

    car: str
    listed: bool = False
    """True if the fleet file names people."""
    leads: tuple[str, ...] = ()
    drivers: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    """People who drive other cars."""
    estops: tuple[Mark, ...] = ()
    hold: Mark | None = None
    pause: Mark | None = None
    lease: Mark | None = None
    loan_to: str = ""
    loan_by: str = ""

    @classmethod
    def of(cls, car: str, safety: Any) -> Self:
        """Return the rules of a car from its newest `state/safety`."""
        people = safety.people
        pause = max(reversed(safety.pauses), key=lambda each: each.rank == Rank.LEAD, default=None)
        return cls(
            car,
            safety.HasField("people"),
            tuple(people.leads),
            tuple(people.drivers),
            tuple(people.others),
            tuple(Mark(each.by, each.rank, each.why, each.scope == Scope.FLEET) for each in safety.estops),
            Mark(safety.hold.by, safety.hold.rank) if safety.HasField("hold") else None,
            None if pause is None else Mark(pause.by, pause.rank, pause.why),
            Mark(safety.lease.holder, safety.lease.kind) if safety.HasField("lease") else None,
            safety.loan.to,
            person_of(safety.loan.by),
        )

    @property
    def authority(self) -> Authority:
        """The people of the fleet, as the gateway of this car knows them."""
        return authority_of(self if self.listed else None)


def refusals(rules: CarRules, sender: str) -> dict[str, Refusal]:
    """Return the actions that the gateway would refuse to this sender, a person, each with the reason and words."""
    judge = _Judge(rules, sender, person_of(sender))
    found = {action: judge.refusal(action) for action in ACTIONS}
    return {action: refusal for action, refusal in found.items() if refusal is not None}


def management_refusal(cars: Iterable[CarRules], sender: str) -> str:
    """Return why this person may not start and stop the recorder and plans. Empty if allowed.

    Both are of the whole fleet. The coordinator decides about the plan by the same rule. The recorder refuses nobody,
    so the console holds its own pages to the rule.
    """
    return merge_authority(rules.authority for rules in cars).refusal(person_of(sender))


@dataclass(frozen=True, slots=True)
class _Judge:
    """The rules for one sender."""

    rules: CarRules
    sender: str
    person: str

    @property
    def _is_lead(self) -> bool:
        return self.person in self.rules.leads

    def refusal(self, action: str) -> Refusal | None:
        """Return why this action is refused; None if it is allowed."""
        match action:
            case "move":
                return self._kept_away() or self._held() or self._leased(take=False)
            case "act":
                return self._kept_away() or self._held()
            case "take":
                return self._kept_away() or self._held() or self._leased(take=True)
            case Verb.RESUME:
                return self._held() or self._not_a_driver(even_if_lent=True)
            case "end_estops":
                return self._estopped()
            case "end_loan" if self.rules.loan_to in ("", self.person):
                return None
            case Verb.LEND:
                return self._cannot_direct() or self._not_a_driver()
            case Verb.UNPAUSE:
                return self._cannot_direct() or self._paused()
            case _:
                return self._cannot_direct()

    def _cannot_direct(self) -> Refusal | None:
        """Return why this person may not pause or lend."""
        words = self.rules.authority.refusal(self.person)
        return (Reason.NOT_ALLOWED, words) if words else None

    @property
    def _is_unlisted(self) -> bool:
        return not self.rules.authority.lists(self.person)

    def _unlisted(self) -> Refusal:
        return Reason.NOT_ALLOWED, unlisted_words(self.person)

    def _not_a_driver(self, *, even_if_lent: bool = False) -> Refusal | None:
        """Return why the people of the fleet or a loan keep this person from the car."""
        rules = self.rules
        if self._is_lead or (rules.loan_to and self.person == rules.loan_to):
            return None
        if rules.loan_to and not even_if_lent:
            return Reason.LENT, f"{rules.car} is lent to {rules.loan_to} (by {rules.loan_by})."
        if not rules.listed or self.person in rules.drivers:
            return None
        if self._is_unlisted:
            return self._unlisted()
        return Reason.NOT_ALLOWED, f"{self.person} drives other cars, not {rules.car}."

    def _kept_away(self) -> Refusal | None:
        rules = self.rules
        if rules.estops:
            return Reason.ESTOPPED, f"{rules.car} is emergency-stopped ({_words(rules.estops[0])})."
        refusal = self._not_a_driver()
        if refusal is not None or rules.pause is None or self._is_lead:
            return refusal
        return Reason.PAUSED, f"The fleet is paused ({_words(rules.pause)})."

    def _may_end(self, mark: Mark) -> bool:
        """Return True if this person's rank ends this. Only a lead ends what a lead began."""
        if mark.rank != Rank.LEAD or self._is_lead:
            return True
        return not self.rules.leads if self.rules.listed else self.person == mark.person

    def _paused(self) -> Refusal | None:
        pause = self.rules.pause
        if pause is None or self._may_end(pause):
            return None
        return Reason.PAUSED, f"{_words(pause)}: only a lead ends this pause."

    def _held(self) -> Refusal | None:
        hold = self.rules.hold
        if hold is None or self._may_end(hold):
            return None
        return Reason.HELD, f"{hold.person} stopped {self.rules.car}: only a lead lets it go."

    def _estopped(self) -> Refusal | None:
        """Return why this person may end none of the e-stops; None if there is none."""
        rules = self.rules
        stays = [each for each in rules.estops if not self._may_end_estop(each)]
        if len(stays) < len(rules.estops) or not stays:
            return None
        if self._may_end(stays[0]):
            return self._not_a_driver(even_if_lent=True) or self._unlisted()
        return Reason.ESTOPPED, f"{_words(stays[0])}: only a lead ends this e-stop."

    def _may_end_estop(self, estop: Mark) -> bool:
        rules = self.rules
        if not self._may_end(estop):
            return False
        drives = not rules.listed or self.person in (*rules.drivers, *rules.leads, rules.loan_to)
        return self.person == estop.person or drives or (estop.fleet_wide and self.person in rules.others)

    def _leased(self, *, take: bool) -> Refusal | None:
        lease = self.rules.lease
        if lease is None or lease.by == self.sender:
            return None
        mine, theirs = _RANKS[Rank.LEAD if self._is_lead else Rank.PERSON], _RANKS.get(lease.rank, 0)
        if mine > theirs or (mine == theirs and take):
            return None
        todo = "Take it over." if mine == theirs else "Wait until the car is free."
        return Reason.LEASED, f"{lease.person} drives {self.rules.car}. {todo}"


def _words(mark: Mark) -> str:
    return f"{mark.person}: {mark.why}" if mark.why else mark.person


def rights_of(sender: str, cars: Mapping[str, CarRules]) -> dict[str, Any]:
    """Return the words of what is refused to this sender, by car and action, and for the whole fleet."""
    by_car = {car: _cached(rules, sender) for car, rules in cars.items()}
    fleet = {action: next(_common(by_car, action), "") for action in map(str, (Verb.PAUSE, Verb.UNPAUSE))}
    fleet["manage"] = management_refusal(cars.values(), sender)
    return {"cars": by_car, **fleet, "lead": any(person_of(sender) in rules.leads for rules in cars.values())}


def _common(by_car: Mapping[str, Mapping[str, str]], action: str) -> Iterator[str]:
    """Yield the words of the first car if every car refuses the action."""
    if by_car and all(action in refused for refused in by_car.values()):
        yield next(iter(by_car.values()))[action]


@lru_cache(maxsize=4096)  # ten times a second, for each page and car
def _cached(rules: CarRules, sender: str) -> Mapping[str, str]:
    return {action: words for action, (_, words) in refusals(rules, sender).items()}

"""Decides who may do what with a car: people and ranks, e-stops, pauses, holds, loans and leases. Pure.

Gateway, console and coordinator use the same rules. A gateway makes its `Authority` from its own state, the others from
the `state/safety` that the gateway publishes. Only the gateway decides; the others show in advance what it would
answer.

A hold keeps the coordinator from moving a stopped car, a loan gives the car to one person, and a lease says who
controls the car now. A lead is a person with more rights than the others, such as a teacher.

Without people in the fleet file, every person may drive every car, and nobody is a lead. These rules take the name of
a sender as true (`identity` checks it on a hub with certificates). A stop or an e-stop needs no right.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from math import inf
from typing import Any, Final, Self

from msgspec import Struct
from msgspec.structs import replace

from schemas.keys import NAME_RULE, is_name, name_of, person_of
from schemas.words import Rank, Reason, Scope

_STRENGTH: Final = {rank: -number for number, rank in enumerate(Rank)}


def strength(rank: Rank) -> int:
    """Return the strength of a rank as a number. A rank has a higher number than the ranks that it outranks."""
    return _STRENGTH[rank]


def rank_of(text: str) -> Rank:
    """Return the rank that a message names. An unknown word, of another version, counts as PERSON."""
    return Rank(text) if text in tuple(Rank) else Rank.PERSON


# ---------------------------------------------------------------------- people


class Sender(Struct, frozen=True):
    """The sender of a command."""

    name: str = "anonymous"
    kind: Rank = Rank.SCRIPT

    @property
    def person(self) -> str:
        """Return the person: `group_a` of `group_a@host-4711`."""
        return person_of(self.name)

    @property
    def text_name(self) -> str:
        """Return the name for a text: the person, without the host and the process (`keys.name_of`)."""
        return name_of(self.name)

    def told_beside(self, other: "Sender") -> str:
        """Return the name for a text that also names `other`: the whole name if both belong to the same person."""
        return self.name if self.person == other.person else self.text_name


class PersonRole(StrEnum):
    """The role of a person for this car."""

    DRIVER = "driver"
    LEAD = "lead"
    OTHER = "other"
    """A person of the fleet who drives other cars."""


class People(Struct, frozen=True):
    """The people of a fleet, as one car sees them. `roles` is None if the fleet has no people."""

    roles: Mapping[str, PersonRole] | None = None

    def __hash__(self) -> int:
        return hash(None if self.roles is None else frozenset(self.roles.items()))

    @classmethod
    def parse(cls, entries: Iterable[str]) -> Self:
        """Return the table of the entries `teacher:lead`, `group_a`, `group_b:other`. Raises ValueError."""
        return cls(dict(_parse(entry) for entry in entries))

    @classmethod
    def of(cls, message: Any) -> Self:
        """Return the people in a fleet.v1.CarPeople. None means that the fleet has no people."""
        if message is None:
            return cls()
        roles = dict.fromkeys(message.others, PersonRole.OTHER) | dict.fromkeys(message.drivers, PersonRole.DRIVER)
        return cls(roles | dict.fromkeys(message.leads, PersonRole.LEAD))

    @classmethod
    def merged(cls, parts: Iterable["People"]) -> Self:
        """Return the people of several cars: whoever is a lead of one is a lead of all.

        Of the roles of one person that are not lead, the last one counts.
        """
        listed = [each for each in parts if each.roles is not None]
        if not listed:
            return cls()
        roles = {name: role for each in listed for name, role in (each.roles or {}).items()}
        return cls(roles | {name: PersonRole.LEAD for each in listed for name in each.leads})

    def fill(self, message: Any) -> None:
        """Write these people to a fleet.v1.CarPeople."""
        message.SetInParent()
        message.leads.extend(self.leads)
        message.drivers.extend(self.named(PersonRole.DRIVER))
        message.others.extend(self.named(PersonRole.OTHER))

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
        """Return the role of a person, or None for a person who is not listed. Without people everyone is a driver."""
        return PersonRole.DRIVER if self.roles is None else self.roles.get(person)

    def may_drive(self, person: str) -> bool:
        """Return True if this person, and the scripts of this person, may drive the car."""
        return self.role(person) in (PersonRole.DRIVER, PersonRole.LEAD)

    def may_end(self, sender: Sender, by: str, rank: Rank) -> bool:
        """Return True if this sender may end what `by` of this rank began.

        What a lead began, only a lead may end, as long as the table names one. Without a table, also the person who
        began it may.
        """
        if rank is not Rank.LEAD or sender.kind is Rank.LEAD:
            return True
        if self.roles is None:
            # Without a table, this gateway knows no leads, so only the person who began it may end it here. If a lead
            # ends a pause or a fleet-wide e-stop at the other gateways, this gateway learns of the end from them.
            return sender.kind is Rank.PERSON and sender.person == person_of(by)
        # After a restart with another table there may be no lead left. Then anyone may end it, else the car would stay
        # stopped for ever.
        return not self.leads

    def denies_directing(self, sender: Sender) -> "Denial | None":
        """Return why this sender may not act on the whole fleet: pause it, lend a car, change its plan.

        Where there are leads, only they may. Elsewhere every person of the fleet may.
        """
        if sender.kind is Rank.LEAD:
            return None
        if self.leads:
            return Denial(Bar.NOT_A_LEAD)
        if sender.kind is not Rank.PERSON:
            return Denial(Bar.NOT_A_PERSON)
        return Denial(Bar.UNLISTED) if self.role(sender.person) is None else None


NO_PEOPLE: Final = People()
"""A fleet without people."""
_ROLES: Final = {"": PersonRole.DRIVER, "lead": PersonRole.LEAD, "other": PersonRole.OTHER}


def _parse(entry: str) -> tuple[str, PersonRole]:
    name, _, role = entry.partition(":")
    if not is_name(name) or role not in _ROLES:
        raise ValueError(f"{entry!r} is not a person: write NAME, NAME:lead or NAME:other ({NAME_RULE})")
    return name, _ROLES[role]


# ---------------------------------------------------------------------- holds, e-stops, pauses, loans, leases


class Hold(Struct, frozen=True):
    """Keeps the coordinator from moving a stopped car. The hold of a lead also keeps persons and scripts from doing so.

    `since_ns` is in ns since the epoch.
    """

    by: str
    since_ns: int
    rank: Rank = Rank.PERSON


class Estop(Struct, frozen=True):
    """One emergency stop in force; if `fleet_wide`, for all cars. `at_ns` is the wall clock, ns since the epoch."""

    id: str
    by: str
    why: str
    at_ns: int
    fleet_wide: bool
    rank: Rank = Rank.PERSON


class FleetPause(Struct, frozen=True):
    """One pause of the whole fleet. `at_ns` is the wall clock, ns since the epoch."""

    id: str
    by: str
    why: str
    at_ns: int
    rank: Rank = Rank.PERSON


class Loan(Struct, frozen=True):
    """The car is lent to the person `to`. `since_ns` is the wall clock. `duration_s` is not published."""

    to: str
    by: str
    rank: Rank
    since_ns: int
    duration_s: float = inf

    def left_s(self, now_ns: int) -> float:
        """Return the remaining time by the wall clock: `duration_s` at most, even if the clock was set back."""
        return self.duration_s - max(0.0, (now_ns - self.since_ns) / 1e9)


class LeaseState(Struct, frozen=True):
    """The sender who controls the car. `until` (s, monotonic) is known only to the gateway."""

    holder: Sender
    until: float = inf
    gone: bool = False
    """True if the holder has disconnected. Then a sender of the same rank need not wait."""

    @property
    def by(self) -> str:
        """Return the name of the holder."""
        return self.holder.name

    def refuses(self, sender: Sender, *, take: bool) -> bool:
        """Return True if `sender` may not drive. With `take`, a person takes the car from another person."""
        if sender == self.holder:
            return False
        mine, theirs = strength(sender.kind), strength(self.holder.kind)
        takes = take and sender.kind in (Rank.PERSON, Rank.LEAD)
        return mine < theirs or (mine == theirs and not self.gone and not takes)


Mark = Hold | Estop | FleetPause | Loan | LeaseState


def binding_pause(pauses: Iterable[Any]) -> Any:
    """Return the pause that binds: the newest of the highest rank. Returns None if there is no pause.

    `pauses` are FleetPauses, or the pauses of a fleet.v1.Safety, the oldest first.
    """
    return max(reversed(list(pauses)), key=lambda pause: strength(rank_of(pause.rank)), default=None)


# ---------------------------------------------------------------------- rights


class Right(StrEnum):
    """A right of a sender on a car."""

    MOVE = "move"
    """Drive the car, change its mode or speed, move its servos or arm, switch its fan."""
    ACT = "act"
    """Use the lights and the whistle of the car."""
    TAKE = "take"
    """Take the car from another person, and move it."""
    RESUME = "resume"
    """End the hold of the car."""
    END_ESTOPS = "end_estops"
    """End one of the e-stops of the car."""
    PAUSE = "pause"
    UNPAUSE = "unpause"
    LEND = "lend"
    END_LOAN = "end_loan"


class Bar(StrEnum):
    """The rule by which a right is denied."""

    NOT_A_LEAD = "not_a_lead"
    NOT_A_PERSON = "not_a_person"
    UNLISTED = "unlisted"
    OTHER_CAR = "other_car"
    """The people table gives this person other cars."""
    LENT = "lent"
    ESTOPPED = "estopped"
    PAUSED = "paused"
    ON_HOLD = "on_hold"
    """A hold keeps the coordinator from the car."""
    LEADS_HOLD = "leads_hold"
    LEADS_ESTOP = "leads_estop"
    LEADS_PAUSE = "leads_pause"
    LEASED = "leased"


_REASONS: Final = {
    Bar.NOT_A_LEAD: Reason.NOT_ALLOWED,
    Bar.NOT_A_PERSON: Reason.NOT_ALLOWED,
    Bar.UNLISTED: Reason.NOT_ALLOWED,
    Bar.OTHER_CAR: Reason.NOT_ALLOWED,
    Bar.LENT: Reason.LENT,
    Bar.ESTOPPED: Reason.ESTOPPED,
    Bar.PAUSED: Reason.PAUSED,
    Bar.ON_HOLD: Reason.HELD,
    Bar.LEADS_HOLD: Reason.HELD,
    Bar.LEADS_ESTOP: Reason.ESTOPPED,
    Bar.LEADS_PAUSE: Reason.PAUSED,
    Bar.LEASED: Reason.LEASED,
}


class Denial(Struct, frozen=True):
    """Why a right is denied. `mark` is the e-stop, pause, hold, loan or lease that denies it."""

    bar: Bar
    mark: Mark | None = None

    @property
    def reason(self) -> Reason:
        """Return the reason of the answer."""
        return _REASONS[self.bar]


class Authority(Struct, frozen=True):
    """The rules and facts that decide about rights on one car now. E-stops and pauses are listed oldest first."""

    people: People = NO_PEOPLE
    estops: tuple[Estop, ...] = ()
    pauses: tuple[FleetPause, ...] = ()
    hold: Hold | None = None
    loan: Loan | None = None
    lease: LeaseState | None = None

    @classmethod
    def of(cls, safety: Any) -> Self:
        """Return the authority of a car by its fleet.v1.Safety."""
        hold, loan, lease = safety.hold, safety.loan, safety.lease
        return cls(
            People.of(safety.people if safety.HasField("people") else None),
            estops_of(safety),
            pauses_of(safety),
            Hold(hold.by, hold.since.ToNanoseconds(), rank_of(hold.rank)) if safety.HasField("hold") else None,
            Loan(loan.to, loan.by, rank_of(loan.rank), loan.since.ToNanoseconds()) if loan.to else None,
            LeaseState(Sender(lease.holder, rank_of(lease.kind))) if safety.HasField("lease") else None,
        )

    def denies(self, sender: Sender, right: Right) -> Denial | None:
        """Return why this sender lacks the right, or None if the sender has it.

        `People.ranked` must have set the sender's rank.
        """
        people = self.people
        match right:
            case Right.MOVE | Right.TAKE:
                return self._kept_away(sender) or self._held(sender) or self._leased(sender, take=right is Right.TAKE)
            case Right.ACT:
                return self._kept_away(sender) or self._held(sender)
            case Right.RESUME if sender.kind is Rank.COORDINATOR:
                return Denial(Bar.ON_HOLD, self.hold)
            case Right.RESUME:
                return self._held(sender) or self._denies_any_drive(sender)
            case Right.END_ESTOPS:
                stays = [each for each in self.estops if not self.may_end_estop(each, sender)]
                return self.estop_stays(stays[0], sender) if stays and len(stays) == len(self.estops) else None
            case Right.LEND:
                return people.denies_directing(sender) or self.denies_drive(sender)
            case Right.UNPAUSE:
                return people.denies_directing(sender) or self._pause_stays(sender)
            case Right.END_LOAN if self.loan is None or self.loan.to == sender.person:
                return None
            case _:
                return people.denies_directing(sender)

    def denies_resume(self, sender: Sender, ids: tuple[str, ...] = (), *, every: bool = False) -> Denial | None:
        """Return None if the sender may end at least one of the things that a resume names, else why not.

        The resume names the e-stops `ids`, or without ids the hold. With `every`, it names the hold and all e-stops.
        If none of `ids` is in force, there is nothing to deny.
        """
        hold = self.denies(sender, Right.RESUME)
        if sender.kind is Rank.COORDINATOR:
            return hold
        named = [estop for estop in self.estops if every or estop.id in ids]
        stays = [estop for estop in named if not self.may_end_estop(estop, sender)]
        if len(stays) < len(named) or (ids and not named):
            return None
        ends_the_hold = every and self.hold is not None and hold is None
        return self.estop_stays(stays[0], sender) if stays and not ends_the_hold else hold

    def denies_drive(self, sender: Sender) -> Denial | None:
        """Return why the people of the fleet or a loan keep this sender from the car."""
        person, people, loan = sender.person, self.people, self.loan
        if sender.kind is Rank.LEAD:
            return None
        if loan is not None and person != loan.to and person not in people.leads:
            return Denial(Bar.LENT, loan)
        borrowed = loan is not None and person == loan.to
        if sender.kind is Rank.COORDINATOR or borrowed or people.may_drive(person):
            return None
        return Denial(Bar.UNLISTED if people.role(person) is None else Bar.OTHER_CAR)

    def may_end_estop(self, estop: Estop, sender: Sender) -> bool:
        """Return True if the sender may end this e-stop. The coordinator ends none.

        A lead's e-stop may be ended by a lead (`People.may_end`). Another one may be ended by the person who began it,
        by the person who has borrowed this car, and by all who may drive it. If it is fleet-wide, every person of the
        fleet may end it, so that all gateways decide alike.
        """
        people, person = self.people, sender.person
        if sender.kind is Rank.COORDINATOR or not people.may_end(sender, estop.by, estop.rank):
            return False
        is_theirs = person in (person_of(estop.by), self.loan and self.loan.to)
        return is_theirs or people.may_drive(person) or (estop.fleet_wide and people.role(person) is PersonRole.OTHER)

    def estop_stays(self, estop: Estop, sender: Sender) -> Denial:
        """Return why the sender may not end this e-stop."""
        if self.people.may_end(sender, estop.by, estop.rank):
            return self._denies_any_drive(sender) or Denial(Bar.UNLISTED)
        return Denial(Bar.LEADS_ESTOP, estop)

    def _denies_any_drive(self, sender: Sender) -> Denial | None:
        """Return why the people of the fleet keep this sender from the car. Ignore a loan to another person."""
        loan = self.loan if self.loan is not None and self.loan.to == sender.person else None
        return replace(self, loan=loan).denies_drive(sender)

    def _kept_away(self, sender: Sender) -> Denial | None:
        """Return why an e-stop, a pause, a loan or the people of the fleet keep the sender from the car."""
        if self.estops:
            return Denial(Bar.ESTOPPED, self.estops[0])
        denial = self.denies_drive(sender)
        if denial is not None or not self.pauses or sender.kind is Rank.LEAD:
            return denial
        return Denial(Bar.PAUSED, binding_pause(self.pauses))

    def _held(self, sender: Sender) -> Denial | None:
        hold = self.hold
        if hold is None:
            return None
        if sender.kind is Rank.COORDINATOR:
            return Denial(Bar.ON_HOLD, hold)
        return None if self.people.may_end(sender, hold.by, hold.rank) else Denial(Bar.LEADS_HOLD, hold)

    def _pause_stays(self, sender: Sender) -> Denial | None:
        stays = (each for each in self.pauses if not self.people.may_end(sender, each.by, each.rank))
        return next((Denial(Bar.LEADS_PAUSE, each) for each in stays), None)

    def _leased(self, sender: Sender, *, take: bool) -> Denial | None:
        lease = self.lease
        return Denial(Bar.LEASED, lease) if lease is not None and lease.refuses(sender, take=take) else None


def estops_of(safety: Any) -> tuple[Estop, ...]:
    """Return the e-stops of a fleet.v1.Safety, oldest first."""
    return tuple(
        Estop(each.id, each.by, each.why, each.stamp.ToNanoseconds(), each.scope == Scope.FLEET, rank_of(each.rank))
        for each in safety.estops
    )


def pauses_of(safety: Any) -> tuple[FleetPause, ...]:
    """Return the pauses of a fleet.v1.Safety, oldest first."""
    return tuple(
        FleetPause(each.id, each.by, each.why, each.stamp.ToNanoseconds(), rank_of(each.rank)) for each in safety.pauses
    )

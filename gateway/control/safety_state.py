"""Stores the hold, e-stops, pauses, loan and lease of one car, which decide who may move it.

`gateway.safety_state_file` writes `PersistedSafety` to disk, so that all of them except the lease survive a restart.
"""

from collections.abc import Iterable
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from schemas.limits import MAX_NAME_LENGTH
from schemas.rights import Estop, FleetPause, Hold, LeaseState, Loan, Sender, strength
from schemas.words import Rank

LEASE_S: Final = 2.0
"""Duration of a lease after the drive (docs/explanation/who-may-drive.md#lease)."""
# Each e-stop in force is in each `state/safety` and in the state file. Without a limit, 200 new ones a second made a
# gateway hang after four seconds.
MAX_ESTOPS: Final = 32
"""Maximum e-stops in force for one car, and also for the whole fleet. A further one only stops the car."""
MAX_ENDED_ESTOPS: Final = 2 * MAX_ESTOPS
"""Maximum ended e-stops that are remembered and published in `state/safety`. The oldest are forgotten."""
MAX_PAUSES: Final = 32
"""Maximum pauses in force. A further one only stops the cars."""
MAX_ENDED_PAUSES: Final = 2 * MAX_PAUSES
"""Maximum ended pauses that are remembered."""


class PersistedSafety(Struct, frozen=True):
    """The part of the safety state that survives a restart."""

    hold: Hold | None = None
    estops: tuple[Estop, ...] = ()
    ended: tuple[str, ...] = ()
    pauses: tuple[FleetPause, ...] = ()
    ended_pauses: tuple[str, ...] = ()
    loan: Loan | None = None


class Safety(Struct):
    """Hold, e-stops, pauses, loan and lease of one car."""

    hold: Hold | None = None
    lease: LeaseState | None = None
    loan: Loan | None = None
    loan_until: float = 0.0
    """When the loan ends, s, monotonic."""
    _estops: dict[str, Estop] = field(default_factory=dict)
    _ended: dict[str, None] = field(default_factory=dict)
    _pauses: dict[str, FleetPause] = field(default_factory=dict)
    _ended_pauses: dict[str, None] = field(default_factory=dict)

    @classmethod
    def restore(cls, persisted: PersistedSafety, now: float = 0.0, now_ns: int = 0) -> "Safety":
        """Return the state from before a restart. `now_ns` is the wall clock at `now`."""
        loan = persisted.loan
        return cls(
            persisted.hold,
            None,
            loan,
            0.0 if loan is None else now + loan.left_s(now_ns),
            {estop.id: estop for estop in persisted.estops},
            dict.fromkeys(persisted.ended),
            {pause.id: pause for pause in persisted.pauses},
            dict.fromkeys(persisted.ended_pauses),
        )

    @property
    def persisted(self) -> PersistedSafety:
        """Return the part of the state that must survive a restart."""
        return PersistedSafety(self.hold, self.estops, self.ended, self.pauses, self.ended_pauses, self.loan)

    @property
    def estops(self) -> tuple[Estop, ...]:
        """Return the e-stops in force, in the order in which this gateway learned of them."""
        return tuple(self._estops.values())

    @property
    def ended(self) -> tuple[str, ...]:
        """Return the ids of ended e-stops, oldest first."""
        return tuple(self._ended)

    @property
    def pauses(self) -> tuple[FleetPause, ...]:
        """Return the pauses in force, oldest first."""
        return tuple(sorted(self._pauses.values(), key=lambda pause: (pause.at_ns, pause.id)))

    @property
    def ended_pauses(self) -> tuple[str, ...]:
        """Return the ids of ended pauses."""
        return tuple(self._ended_pauses)

    # ------------------------------------------------------------------ hold and e-stops

    def put_on_hold(self, name: str, at_ns: int, rank: Rank = Rank.PERSON) -> None:
        """Put the car on hold, and end a lease of the coordinator. A lead's hold replaces one that no lead began."""
        if self.hold is None or (rank is Rank.LEAD and self.hold.rank is not Rank.LEAD):
            self.hold = Hold(name, at_ns, rank)
        if self.lease is not None and self.lease.holder.kind is Rank.COORDINATOR:
            self.lease = None

    def latch(self, estop: Estop) -> Estop:
        """Latch an e-stop (put it in force), and put the car on hold. An e-stop whose id has ended gets a new id.

        If too many e-stops are in force, do not latch this one. The car stays stopped anyway, until all of those are
        released.
        """
        if estop.id in self._ended:
            estop = replace(estop, id=f"{estop.id}.{estop.at_ns:x}"[-MAX_NAME_LENGTH:])
        self.put_on_hold(estop.by, estop.at_ns, estop.rank)
        first = self._estops.get(estop.id)
        is_new = first is None or (estop.fleet_wide and not first.fleet_wide)  # new, or from now on for all cars
        if is_new and sum(each.fleet_wide is estop.fleet_wide for each in self.estops) >= MAX_ESTOPS:
            return first or estop
        if first is None:
            self._estops[estop.id] = estop
        else:  # keep the higher rank, so that nobody can lower the rank of somebody else's e-stop
            stronger = max(first, estop, key=lambda each: strength(each.rank))
            self._estops[estop.id] = replace(stronger, fleet_wide=first.fleet_wide or estop.fleet_wide)
        return self._estops[estop.id]

    def end(self, ids: Iterable[str]) -> list[Estop]:
        """End e-stops. Return those that were in force."""
        ended = [self._estops.pop(each) for each in dict.fromkeys(ids) if each in self._estops]
        _remember(self._ended, (estop.id for estop in ended), MAX_ENDED_ESTOPS)
        return ended

    def merge(self, estops: Iterable[Estop], ended: Iterable[str]) -> tuple[list[Estop], list[Estop]]:
        """Merge the fleet-wide e-stops of another gateway. Return (latched, ended). An ended e-stop stays ended."""
        named = list(ended)
        removed = self.end(each for each in named if each in self._estops and self._estops[each].fleet_wide)
        # Also unknown ones, because a third gateway may still report them as in force.
        _note_unknown(self._ended, (each for each in named if each not in self._estops), MAX_ENDED_ESTOPS)
        known = {*self._estops, *self._ended}
        shared = [each for each in estops if each.fleet_wide]
        latched = [self.latch(each) for each in shared if each.id not in known]
        for each in shared:  # correct the rank: a gateway that knows no people takes a lead for a person
            first = self._estops.get(each.id)
            if first is not None and strength(each.rank) > strength(first.rank):
                self.latch(each)
        return [each for each in latched if each.id in self._estops], removed

    # ------------------------------------------------------------------ pauses

    def pause(self, pause: FleetPause) -> bool:
        """Pause the fleet. Return False if this pause has ended or is in force already, or if too many are in force."""
        if pause.id in self._ended_pauses or (pause.id not in self._pauses and len(self._pauses) >= MAX_PAUSES):
            return False
        first = self._pauses.get(pause.id)
        self._pauses[pause.id] = pause if first is None else max(first, pause, key=_strength)
        return first is None

    def end_pauses(self, ids: Iterable[str]) -> list[FleetPause]:
        """End pauses, even unknown ones, because they may arrive later. Return those that were in force."""
        named = list(ids)
        _remember(self._ended_pauses, named, MAX_ENDED_PAUSES)
        return [self._pauses.pop(each) for each in named if each in self._pauses]

    def merge_pauses(
        self, pauses: Iterable[FleetPause], ended: Iterable[str]
    ) -> tuple[list[FleetPause], list[FleetPause]]:
        """Merge the pauses of another gateway. Return (joined, removed). An ended pause stays ended."""
        named = list(ended)
        removed = self.end_pauses(each for each in named if each in self._pauses)
        _note_unknown(self._ended_pauses, named, MAX_ENDED_PAUSES)
        return [pause for pause in pauses if self.pause(pause)], removed

    # ------------------------------------------------------------------ loan

    def loan_at(self, now: float) -> Loan | None:
        """Return the loan, or None if it is over."""
        return self.loan if now < self.loan_until else None

    def lend(self, loan: Loan, now: float) -> None:
        """Lend the car. This replaces an earlier loan."""
        self.loan, self.loan_until = loan, now + loan.duration_s

    # ------------------------------------------------------------------ lease

    def lease_at(self, now: float) -> LeaseState | None:
        """Return the lease, or None if it is over."""
        return self.lease if self.lease is not None and now < self.lease.until else None

    def grant(self, sender: Sender, until: float) -> None:
        """Grant the lease until `LEASE_S` after `until`."""
        self.lease = LeaseState(sender, until + LEASE_S)

    def shorten_lease(self, now: float) -> None:
        """Shorten the lease to `LEASE_S` from now, because the holder's motion has ended."""
        if self.lease is not None:
            self.lease = replace(self.lease, until=min(self.lease.until, now + LEASE_S))

    def mark_holder(self, name: str, *, connected: bool) -> None:
        """Record whether the holder of the lease is connected."""
        if self.lease is not None and self.lease.holder.name == name:
            self.lease = replace(self.lease, gone=not connected)

    def release(self, sender: Sender) -> bool:
        """End the lease of this sender. Return False if it has none."""
        if self.lease is None or self.lease.holder != sender:
            return False
        self.lease = None
        return True


def _remember(ended: dict[str, None], ids: Iterable[str], maximum: int) -> None:
    """Add ended ids, and forget the oldest ones beyond the maximum."""
    ended.update(dict.fromkeys(ids))
    while len(ended) > maximum:
        del ended[next(iter(ended))]


def _note_unknown(ended: dict[str, None], ids: Iterable[str], maximum: int) -> None:
    """Add ids of which only another gateway knows that they have ended, as the oldest ones, as far as there is room.

    Added as the newest ones, they would replace what has just ended here. And several gateways that together remember
    more than the maximum would replace each other's ids for ever, and save their states each time.
    """
    unknown = [each for each in dict.fromkeys(ids) if each not in ended]
    if room := max(maximum - len(ended), 0):
        known = list(ended)
        ended.clear()
        ended.update(dict.fromkeys([*unknown[-room:], *known]))


def _strength(pause: FleetPause) -> tuple[int, int, str, str]:
    """Order two reports of one pause, so that all gateways choose the same one, whichever arrives first."""
    return strength(pause.rank), -pause.at_ns, pause.by, pause.why

"""Who may move the car: the hold, the e-stops, and the lease. Values and small rules; what is sent is not decided here.

What must survive a restart is `PersistedSafety`; `gateway.state_file` writes it to disk.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

from gateway.control.commands import Sender, SenderKind

LEASE_S: Final = 2.0
"""How long a lease outlives the driving (docs/explanation/who-may-drive.md#lease)."""
REMEMBERED_ENDED: Final = 64
"""Ended e-stops that are remembered, and shown in `state/safety` once a second: the newest."""
_RANK: Final = {SenderKind.PERSON: 2, SenderKind.SCRIPT: 1, SenderKind.COORDINATOR: 0}


@dataclass(frozen=True, slots=True)
class Hold:
    """Who stopped the car, and when, ns since the epoch: the coordinator leaves it alone."""

    by: str
    since_ns: int


@dataclass(frozen=True, slots=True)
class Estop:
    """One latched emergency stop. `at_ns`: wall clock, ns since the epoch; `fleet_wide`: every gateway latches it."""

    id: str
    by: str
    why: str
    at_ns: int
    fleet_wide: bool


@dataclass(frozen=True, slots=True)
class PersistedSafety:
    """What survives a restart."""

    hold: Hold | None = None
    estops: tuple[Estop, ...] = ()
    ended: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LeaseState:
    """Who drives the car, and until when (monotonic) it is theirs."""

    holder: Sender
    until: float
    gone: bool = False
    """Its holder is not there any more, a command line that is done: who ranks as high need not wait."""

    def refuses(self, sender: Sender, now: float, *, take: bool) -> bool:
        """Whether `sender` may not drive now: it ranks lower, or as high and does not take it as a person may."""
        if now >= self.until or sender == self.holder:
            return False
        mine, theirs = _RANK[sender.kind], _RANK[self.holder.kind]
        return mine < theirs or (mine == theirs and not self.gone and not (take and sender.kind is SenderKind.PERSON))


@dataclass(slots=True)
class Safety:
    """Hold, e-stops and lease of one car."""

    hold: Hold | None = None
    lease: LeaseState | None = None
    _estops: dict[str, Estop] = field(default_factory=dict)
    _ended: dict[str, None] = field(default_factory=dict)

    @classmethod
    def restored(cls, kept: PersistedSafety) -> "Safety":
        """As it was before a restart."""
        estops = {estop.id: estop for estop in kept.estops}
        return cls(kept.hold, None, estops, dict.fromkeys(kept.ended))

    @property
    def kept(self) -> PersistedSafety:
        """What must survive a restart, as it is now."""
        return PersistedSafety(self.hold, self.estops, self.ended)

    @property
    def estops(self) -> tuple[Estop, ...]:
        """Those in force, oldest first; the car is e-stopped while there is one."""
        return tuple(self._estops.values())

    @property
    def ended(self) -> tuple[str, ...]:
        """Ids of e-stops that were ended, oldest first."""
        return tuple(self._ended)

    # ------------------------------------------------------------------ hold and e-stops

    def held_by(self, name: str, at_ns: int) -> None:
        """Put the car on hold, which the coordinator then has no more; the first who did keeps it."""
        if self.hold is None:
            self.hold = Hold(name, at_ns)
        if self.lease is not None and self.lease.holder.kind is SenderKind.COORDINATOR:
            self.lease = None

    def latch(self, estop: Estop) -> Estop:
        """Latch an e-stop and hold the car; an id that was ended already is latched under a new one, never ignored."""
        if estop.id in self._ended:
            estop = Estop(f"{estop.id}.{estop.at_ns:x}", estop.by, estop.why, estop.at_ns, estop.fleet_wide)
        self.held_by(estop.by, estop.at_ns)
        first = self._estops.get(estop.id)
        if first is None or (estop.fleet_wide and not first.fleet_wide):  # said of this car, then of the fleet
            self._estops[estop.id] = estop
        return self._estops[estop.id]

    def end(self, ids: Iterable[str]) -> list[Estop]:
        """End e-stops; returns those that were in force."""
        ended = [self._estops.pop(each) for each in dict.fromkeys(ids) if each in self._estops]
        self._remember(estop.id for estop in ended)
        return ended

    def unite(self, estops: Iterable[Estop], ended: Iterable[str]) -> tuple[list[Estop], list[Estop]]:
        """Take over what another gateway of the fleet shows: (latched, ended). Only fleet-wide ids; ended wins."""
        over = self.end(each for each in ended if each in self._estops and self._estops[each].fleet_wide)
        known = {*self._estops, *self._ended}
        begun = [self.latch(each) for each in estops if each.fleet_wide and each.id not in known]
        return begun, over

    def _remember(self, ids: Iterable[str]) -> None:
        self._ended.update(dict.fromkeys(ids))
        while len(self._ended) > REMEMBERED_ENDED:
            del self._ended[next(iter(self._ended))]

    # ------------------------------------------------------------------ lease

    def leased(self, now: float) -> LeaseState | None:
        """The lease, while it lasts."""
        return self.lease if self.lease is not None and now < self.lease.until else None

    def grant(self, sender: Sender, until: float) -> None:
        """The car is the sender's until then, and `LEASE_S` longer."""
        self.lease = LeaseState(sender, until + LEASE_S)

    def driven_no_more(self, now: float) -> None:
        """The holder's motion has ended: what is left of the lease is `LEASE_S`."""
        if self.lease is not None:
            self.lease = replace(self.lease, until=min(self.lease.until, now + LEASE_S))

    def holder_there(self, name: str, *, there: bool) -> None:
        """Its token came or went: the lease lasts, but for whoever ranks as high."""
        if self.lease is not None and self.lease.holder.name == name:
            self.lease = replace(self.lease, gone=not there)

    def release(self, sender: Sender) -> bool:
        """The holder gives it back; False if somebody else, or nobody, has it."""
        if self.lease is None or self.lease.holder != sender:
            return False
        self.lease = None
        return True

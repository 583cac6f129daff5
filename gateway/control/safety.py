"""Holds the hold, the e-stops and the lease of one car, which decide who may move it.

`gateway.state_file` writes `PersistedSafety` to disk, so that hold and e-stops survive a restart.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

from gateway.control.commands import Sender, SenderKind

LEASE_S: Final = 2.0
"""Duration of a lease after the drive (docs/explanation/who-may-drive.md#lease)."""
# Each e-stop in force is in each `state/safety` and in the state file. 200 a second hung a gateway after four seconds.
MAX_ESTOPS: Final = 32
"""Maximum e-stops in force of one car, and as many of the whole fleet. A further one only stops the car."""
MAX_ENDED_ESTOPS: Final = 2 * MAX_ESTOPS
"""Maximum ended e-stops that are remembered and published in `state/safety`: the newest."""
_SENDER_RANK: Final = {SenderKind.PERSON: 2, SenderKind.SCRIPT: 1, SenderKind.COORDINATOR: 0}


@dataclass(frozen=True, slots=True)
class Hold:
    """Keeps the coordinator from moving a stopped car. `since_ns`: ns since the epoch."""

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
    """The part of the safety state that survives a restart."""

    hold: Hold | None = None
    estops: tuple[Estop, ...] = ()
    ended: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LeaseState:
    """The sender who controls the car, and until when (s, monotonic)."""

    holder: Sender
    until: float
    gone: bool = False
    """True if the holder has disconnected. A sender of the same rank need not wait then."""

    def refuses(self, sender: Sender, now: float, *, take: bool) -> bool:
        """Return True if `sender` may not drive now. `take`: a person takes the car from another person."""
        if now >= self.until or sender == self.holder:
            return False
        mine, theirs = _SENDER_RANK[sender.kind], _SENDER_RANK[self.holder.kind]
        return mine < theirs or (mine == theirs and not self.gone and not (take and sender.kind is SenderKind.PERSON))


@dataclass(slots=True)
class Safety:
    """Hold, e-stops and lease of one car."""

    hold: Hold | None = None
    lease: LeaseState | None = None
    _estops: dict[str, Estop] = field(default_factory=dict)
    _ended: dict[str, None] = field(default_factory=dict)

    @classmethod
    def restore(cls, persisted: PersistedSafety) -> "Safety":
        """Return the state from before a restart."""
        estops = {estop.id: estop for estop in persisted.estops}
        return cls(persisted.hold, None, estops, dict.fromkeys(persisted.ended))

    @property
    def persisted(self) -> PersistedSafety:
        """Return the part of the state that must survive a restart."""
        return PersistedSafety(self.hold, self.estops, self.ended)

    @property
    def estops(self) -> tuple[Estop, ...]:
        """Return the e-stops in force, oldest first."""
        return tuple(self._estops.values())

    @property
    def ended(self) -> tuple[str, ...]:
        """Return the ids of ended e-stops, oldest first."""
        return tuple(self._ended)

    # ------------------------------------------------------------------ hold and e-stops

    def put_on_hold(self, name: str, at_ns: int) -> None:
        """Put the car on hold, and end a lease of the coordinator. An earlier hold stays in force."""
        if self.hold is None:
            self.hold = Hold(name, at_ns)
        if self.lease is not None and self.lease.holder.kind is SenderKind.COORDINATOR:
            self.lease = None

    def latch(self, estop: Estop) -> Estop:
        """Latch an e-stop and put the car on hold. An e-stop whose id has already ended gets a new id.

        If too many are in force, it is not latched: the car stays stopped until all of them are released.
        """
        if estop.id in self._ended:
            estop = Estop(f"{estop.id}.{estop.at_ns:x}", estop.by, estop.why, estop.at_ns, estop.fleet_wide)
        self.put_on_hold(estop.by, estop.at_ns)
        first = self._estops.get(estop.id)
        if sum(each.fleet_wide is estop.fleet_wide for each in self.estops) >= MAX_ESTOPS:
            return first or estop
        if first is None or (estop.fleet_wide and not first.fleet_wide):  # widened from this car to the fleet
            self._estops[estop.id] = estop
        return self._estops[estop.id]

    def end(self, ids: Iterable[str]) -> list[Estop]:
        """End e-stops. Return those that were in force."""
        ended = [self._estops.pop(each) for each in dict.fromkeys(ids) if each in self._estops]
        self._remember(estop.id for estop in ended)
        return ended

    def merge(self, estops: Iterable[Estop], ended: Iterable[str]) -> tuple[list[Estop], list[Estop]]:
        """Merge the fleet-wide e-stops of another gateway. Return (latched, ended). An ended e-stop stays ended."""
        removed = self.end(each for each in ended if each in self._estops and self._estops[each].fleet_wide)
        known = {*self._estops, *self._ended}
        latched = [self.latch(each) for each in estops if each.fleet_wide and each.id not in known]
        return [each for each in latched if each.id in self._estops], removed

    def _remember(self, ids: Iterable[str]) -> None:
        self._ended.update(dict.fromkeys(ids))
        while len(self._ended) > MAX_ENDED_ESTOPS:
            del self._ended[next(iter(self._ended))]

    # ------------------------------------------------------------------ lease

    def lease_at(self, now: float) -> LeaseState | None:
        """Return the lease; None if it is over."""
        return self.lease if self.lease is not None and now < self.lease.until else None

    def grant(self, sender: Sender, until: float) -> None:
        """Grant the lease until then, and `LEASE_S` longer."""
        self.lease = LeaseState(sender, until + LEASE_S)

    def shorten_lease(self, now: float) -> None:
        """Shorten the lease to `LEASE_S`: the holder's motion has ended."""
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

"""The lease of a car, `with fleet.car("red").lease() as car`. The end of the block stops the car.

A car whose lease was lost is not stopped, because it has another holder.
`Lease` acquires, renews and releases the lease. `LeaseMonitor` detects its loss from the gateway's messages (pure).
"""

import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, Final, Generic, Protocol, TypeVar

from msgspec.structs import replace

from fleet.client.commands import CommandRequest, drive_request, lease_request
from fleet.client.outcome import OUTCOME_MARGIN_S, LeaseLost, NotCarriedOut, Outcome
from fleet.client.reading import Reading
from fleet.policy.denial_words import describe
from schemas import keys, messages
from schemas.bus import Bus, BusError, Sample
from schemas.rights import Authority, Denial, Hold, Right, Sender, rank_of
from schemas.words import Motion, Phase, Reason

C_co = TypeVar("C_co", covariant=True)

LEASE_RENEWAL_INTERVAL_S: Final = 0.8
"""Interval of renewals. A lease expires after 2 s, so one renewal may be lost."""
SAFETY_RETRY_DELAY_S: Final = 0.2
"""Delay before a gateway that did not answer is queried again."""
_STOP_NOT_NEEDED: Final = frozenset({Reason.LEASED, Reason.LENT, Reason.PAUSED, Reason.ESTOPPED, Reason.SUPERSEDED})
"""Reasons that make the final stop unnecessary: another sender has the car, or has stopped it."""


class LeaseMonitor:
    """Detects the loss of a lease: another holder, a stop by another sender, an e-stop, a loan or a pause.

    A lost lease stays lost.
    """

    def __init__(self, car: str, sender: Sender) -> None:
        self.lost = ""
        """Words about who took or stopped the car. Empty while the lease is valid."""
        self._car = car
        self._sender = sender
        self._begun = False
        self._hold: Hold | None = None
        self._newest = ("", 0)
        """The gateway's boot id and the sequence number of the newest message."""

    def on_safety(self, safety: Any) -> None:
        """Handle a `fleet.v1.Safety` of this car. Ignore messages that are older than the newest one."""
        boot_id, seq = self._newest
        if boot_id and safety.boot_id == boot_id and safety.seq <= seq:
            return
        self._newest = (safety.boot_id, safety.seq)
        authority, ours = Authority.of(safety), self._sender.name
        hold, lease = authority.hold, authority.lease
        if not self._begun:  # changes before our lease do not count
            self._begun = lease is not None and lease.by == ours
        elif self.lost:
            return
        elif lease is not None and lease.by != ours:
            self.lost = f"{self._car} was taken by {_other(lease.by, ours)} ({lease.holder.kind})"
        elif authority.estops:
            self.lost = f"{self._car} was e-stopped by {keys.name_of(authority.estops[0].by)}"
        elif hold is not None and hold != self._hold and hold.by != ours:
            self.lost = f"{self._car} was stopped by {_other(hold.by, ours)}"
        elif denial := self._denial(authority):
            self.lost = describe(denial, self._sender, authority.people, self._car)
        self._hold = hold

    def _denial(self, authority: Authority) -> Denial | None:
        """Return why a pause, a loan or the rank of our person keeps us from the car."""
        # A hold may be older than our lease, and then it has not ended the lease.
        return replace(authority, hold=None).denies(authority.people.ranked(self._sender), Right.ACT)

    def on_outcome(self, outcome: Outcome) -> None:
        """Handle the outcome of a command of ours."""
        if outcome.reason in (Reason.LEASED, Reason.LENT, Reason.PAUSED):
            self.lost = self.lost or outcome.words


def _other(sender: str, ours: str) -> str:
    """Return the name of another sender, or say that it is another program of our own person."""
    name = keys.name_of(sender)
    return f"another program of {name}" if name == keys.name_of(ours) else name


class LeasingFleet(Protocol):
    """The part of a `Fleet` that a lease uses."""

    name: str
    sender: str
    kind: str
    bus: Bus

    def check_open(self) -> None:
        """Raise BusError if the fleet is closed."""
        ...

    def ask(self, request: CommandRequest, cars: Iterable[str] | None = None) -> list[Outcome]:
        """Send one command to these cars, and return their outcomes."""
        ...

    def get(self, expression: str) -> list[Reading]:
        """Return the latest readings."""
        ...


class Lease(Generic[C_co]):
    """The lease of a car, which `Car.lease` returns. Use it with `with`. Raises LeaseLost if another client has it."""

    def __init__(self, fleet: LeasingFleet, name: str, leased: "Callable[[Lease[C_co]], C_co]", *, take: bool) -> None:
        """`leased` makes the car that the block gets."""
        self._fleet = fleet
        self._name = name
        self._leased = leased
        self._take = take
        self._monitor = self._new_monitor()
        self._monitor_lock = threading.Lock()
        self._over = threading.Event()
        self._undeclare: Any = lambda: None

    def _new_monitor(self) -> LeaseMonitor:
        return LeaseMonitor(self._name, Sender(self._fleet.sender, rank_of(self._fleet.kind)))

    def __enter__(self) -> C_co:
        self._fleet.check_open()
        # An earlier block with this lease may have lost it, and its thread may still run.
        self._monitor, self._over = self._new_monitor(), threading.Event()
        key = keys.topic_key(self._fleet.name, self._name, "state/safety")
        self._undeclare = self._fleet.bus.subscribe(key, self._on_sample).undeclare
        try:
            self.check_outcome(self._fleet.ask(lease_request(take=self._take), [self._name])[0])
            self._query()  # the message that shows our lease may still be on its way
        except BaseException:
            self._undeclare()
            raise
        name, arguments = f"fleet-lease-{self._name}", (self._monitor, self._over)
        threading.Thread(target=self._renew, args=arguments, name=name, daemon=True).start()
        return self._leased(self)

    def __exit__(
        self, _type: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._over.set()
        try:
            self._release(error)
        finally:
            self._undeclare()

    def check_outcome(self, outcome: Outcome) -> Outcome:
        """Return the outcome of a command. Raises LeaseLost or NotCarriedOut if the command was not carried out."""
        if outcome.ok:
            return outcome
        self._monitor.on_outcome(outcome)
        if outcome.reason == Reason.SUPERSEDED:  # the message with the new holder may not have arrived
            self._query()
        if self._monitor.lost:
            raise LeaseLost(outcome, self._monitor.lost)
        raise NotCarriedOut(outcome)

    def check(self) -> None:
        """Raise LeaseLost if the lease is lost. The car then belongs to its new holder."""
        if self._monitor.lost:
            lost = self._monitor.lost
            raise LeaseLost(
                Outcome(self._name, ok=False, phase=str(Phase.REJECTED), reason=str(Reason.LEASED), words=lost), lost
            )

    def _release(self, error: BaseException | None) -> None:
        if self._monitor.lost:
            return
        (stopped,) = self._fleet.ask(drive_request(Motion.STOP), [self._name])
        self._fleet.ask(lease_request(release=True), [self._name])
        if stopped.ok or stopped.reason in _STOP_NOT_NEEDED:
            return
        words = f"{self._name} may still be driving: its stop failed. {stopped.effect}"
        if error is None:
            raise NotCarriedOut(stopped, words)
        error.add_note(words)

    def _renew(self, monitor: LeaseMonitor, over: threading.Event) -> None:
        """Renew the lease until it ends or is lost. Runs on its own thread."""
        while not over.wait(LEASE_RENEWAL_INTERVAL_S) and not monitor.lost:
            try:
                (outcome,) = self._fleet.ask(lease_request(), [self._name])
            except (BusError, RuntimeError):  # the Fleet is closed, and its token is gone
                return
            monitor.on_outcome(outcome)

    def _query(self) -> None:
        """Query the car's safety state. Repeat for OUTCOME_MARGIN_S while the gateway does not answer."""
        until = time.monotonic() + OUTCOME_MARGIN_S
        while not (readings := self._fleet.get(f"{self._name}/state/safety")) and time.monotonic() < until:
            time.sleep(SAFETY_RETRY_DELAY_S)
        for reading in readings:
            with self._monitor_lock:
                self._monitor.on_safety(reading.value)

    def _on_sample(self, sample: Sample) -> None:
        """Handle a safety state. Runs on a Zenoh thread."""
        try:
            message = sample.message()
        except (messages.BadPayload, KeyError):
            return  # not from a gateway of this fleet
        with self._monitor_lock:
            self._monitor.on_safety(message)

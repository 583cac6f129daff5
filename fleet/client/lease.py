"""A car that is one operator's for a while: `with fleet.car("red").lease() as car`. When the block ends, the car stops.

`LeaseMonitor` judges whether it still is, from what its gateway says: pure. `Lease` asks, renews and gives back.
"""

import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from fleet.client.commands import drive_request, lease_request
from fleet.client.outcome import MARGIN_S, LeaseLost, NotCarriedOut, Outcome
from schemas import keys, messages
from schemas.bus import BusError, Sample

if TYPE_CHECKING:
    from fleet.client.client import Fleet, LeasedCar

RENEW_S: Final = 0.8
"""A gateway's lease ends 2 s after the last that was asked for: one renewal may be lost."""
LOOK_DELAY_S: Final = 0.2
"""Delay of a second question to a gateway that did not answer the first."""
_STOPPED_ANYWAY: Final = frozenset({"leased", "estopped", "superseded"})
"""Why the stop at the end is not carried out, and need not be: the car is another's, or is being stopped."""


class LeaseMonitor:
    """Whether the car is still ours: not once another has it, or has stopped it. What was lost stays lost."""

    def __init__(self, car: str, sender: str) -> None:
        self.lost = ""
        """By whom, in words; empty while it is ours."""
        self._car = car
        self._sender = sender
        self._begun = False
        self._hold: tuple[str, int] | None = None
        self._newest = ("", 0)
        """Its gateway's number of the newest that was taken."""

    def heard(self, safety: Any) -> None:
        """Take a `fleet.v1.Safety` of this car; what was published before another that was taken is no news."""
        boot_id, seq = self._newest
        if boot_id and safety.boot_id == boot_id and safety.seq <= seq:
            return
        self._newest = (safety.boot_id, safety.seq)
        hold = (safety.hold.by, safety.hold.since.ToNanoseconds()) if safety.HasField("hold") else None
        holder = safety.lease.holder
        if not self._begun:  # what was so before is not news
            self._begun = holder == self._sender
        elif self.lost:
            return
        elif holder not in ("", self._sender):
            self.lost = f"{self._car} was taken by {holder} ({safety.lease.kind})"
        elif safety.estops:
            self.lost = f"{self._car} was e-stopped by {safety.estops[0].by}"
        elif hold not in (None, self._hold) and safety.hold.by != self._sender:
            self.lost = f"{self._car} was stopped by {safety.hold.by}"
        self._hold = hold

    def refused(self, outcome: Outcome) -> None:
        """Take the outcome of a command of ours."""
        if outcome.reason == "leased":
            self.lost = self.lost or outcome.words


class Lease:
    """Made by `Car.lease`; use it with `with`, which raises LeaseLost if the car is another's."""

    def __init__(self, fleet: "Fleet", name: str, *, take: bool) -> None:
        self._fleet = fleet
        self._name = name
        self._take = take
        self._ours = LeaseMonitor(name, fleet.sender)
        self._hearing = threading.Lock()
        self._over = threading.Event()
        self._undeclare: Any = lambda: None
        self._keeper = threading.Thread(target=self._keep, name=f"fleet-lease-{name}", daemon=True)

    def __enter__(self) -> "LeasedCar":
        from fleet.client.client import LeasedCar

        key = keys.topic_key(self._fleet.name, self._name, "state/safety")
        self._undeclare = self._fleet.bus.subscribe(key, self._heard).undeclare
        try:
            self.checked(self._fleet.ask(lease_request(take=self._take), [self._name])[0])
            self._look()  # that it is ours is published, and may be under way when it is lost
        except BaseException:
            self._undeclare()
            raise
        self._keeper.start()
        return LeasedCar(self._fleet, self._name, self)

    def __exit__(
        self, _type: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._over.set()
        try:
            self._give_back(error)
        finally:
            self._undeclare()

    def checked(self, outcome: Outcome) -> Outcome:
        """The outcome of a command of ours; raises what it means that it was not carried out."""
        if outcome.ok:
            return outcome
        self._ours.refused(outcome)
        if outcome.reason == "superseded":  # by whom is published, and may be under way
            self._look()
        if self._ours.lost:
            raise LeaseLost(outcome, self._ours.lost)
        raise NotCarriedOut(outcome)

    def check(self) -> None:
        """Raises LeaseLost if the car is not ours any more: it is left to whom it is."""
        if self._ours.lost:
            raise LeaseLost(Outcome(self._name, ok=False, phase="rejected", reason="leased"), self._ours.lost)

    def _give_back(self, error: BaseException | None) -> None:
        if self._ours.lost:
            return
        (stopped,) = self._fleet.ask(drive_request("stop"), [self._name])
        self._fleet.ask(lease_request(release=True), [self._name])
        if stopped.ok or stopped.reason in _STOPPED_ANYWAY:
            return
        words = f"{self._name} may still drive, its stop was not carried out: {stopped}"
        if error is None:
            raise NotCarriedOut(stopped, words)
        error.add_note(words)

    def _keep(self) -> None:
        """Renew the lease until it is over or lost; on a thread of its own."""
        while not self._over.wait(RENEW_S) and not self._ours.lost:
            try:
                (outcome,) = self._fleet.ask(lease_request(), [self._name])
            except (BusError, RuntimeError):  # the fleet was closed under the lease: its token is gone, too
                return
            self._ours.refused(outcome)

    def _look(self) -> None:
        """Ask the gateway for the state of the car now. A gateway that is held up is asked again for a while."""
        until = time.monotonic() + MARGIN_S
        while not (readings := self._fleet.get(f"{self._name}/state/safety")) and time.monotonic() < until:
            time.sleep(LOOK_DELAY_S)
        for reading in readings:
            with self._hearing:
                self._ours.heard(reading.value)

    def _heard(self, sample: Sample) -> None:
        """On a Zenoh thread."""
        try:
            message = sample.message()
        except (messages.BadPayload, KeyError):
            return  # no message of a gateway of ours
        with self._hearing:
            self._ours.heard(message)

"""What the car is still to do: the motion that is held, the mode to be opened, what acts once. Each ends with a record.

What is written when is the controller's; here is what waits, for whom, until when, and what became of it.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from gateway.control.command_log import CommandLog, Pending
from gateway.control.commands import Phase, Reason, Sender
from gateway.control.safety import Safety
from gateway.control.senders import Senders
from gateway.protocol.enums import Motion

PATIENCE_S: Final = 10.0
"""How long a one-shot or a mode may wait for a busy car before it is too old to matter."""


@dataclass(slots=True)
class HeldMotion:
    """The motion that is held, for whom, and until when."""

    motion: Motion
    pending: Pending
    expires_at: float
    began_at: float | None = None
    """When its frame was written."""

    @property
    def sender(self) -> Sender:
        """Who holds it."""
        return self.pending.command.sender


@dataclass(slots=True)
class CommandQueue:
    """One motion at most, one mode at most, a queue of what acts once. Times: s, monotonic."""

    ledger: CommandLog
    senders: Senders
    safety: Safety
    held: HeldMotion | None = None
    opening: Pending | None = None
    acts: deque[Pending] = field(default_factory=deque)

    @property
    def held_until(self) -> float:
        """When the held motion is over, or its sender lost; inf if none is held."""
        held = self.held
        return float("inf") if held is None else min(held.expires_at, self.senders.lost_at(held.sender.name))

    def deadlines(self) -> list[float]:
        """When something that waits is over if nothing happens before."""
        waiting = [*self.acts, *([self.opening] if self.opening is not None else [])]
        times = [pending.asked_at + PATIENCE_S for pending in waiting]
        return times if self.held is None else [*times, self.held_until]

    def give_up_old(self, now: float) -> None:
        """What has waited too long for a busy car is too old to matter."""
        words = f"waited {PATIENCE_S:g} s for a busy car"
        while self.acts and now >= self.acts[0].asked_at + PATIENCE_S:
            self.ledger.record(self.acts.popleft(), Phase.EXPIRED, now, reason=Reason.EXPIRED, words=words)
        if self.opening is not None and now >= self.opening.asked_at + PATIENCE_S:
            self.close_opening(Phase.EXPIRED, Reason.EXPIRED, words, now)

    def drop(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        """All of it is over."""
        self.close_held(phase, reason, words, now)
        self.close_opening(phase, reason, words, now)
        while self.acts:
            self.ledger.record(self.acts.popleft(), phase, now, reason=reason, words=words)

    def close_held(self, phase: Phase, reason: Reason | None, words: str, now: float, basis: str = "") -> None:
        """End the held motion. Release the lease too if its holder has disconnected."""
        held, self.held = self.held, None
        if held is None:
            return
        if self.senders.forget(held.sender.name):
            self.safety.release(held.sender)
        if phase is not Phase.SUPERSEDED:
            self.safety.driven_no_more(now)
        self.ledger.record(held.pending, phase, now, reason=reason, words=words, basis=basis)

    def close_opening(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        """The mode will not be opened."""
        pending, self.opening = self.opening, None
        if pending is not None:
            self.ledger.record(pending, phase, now, reason=reason, words=words)

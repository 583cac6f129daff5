"""Holds the commands in progress of one car: the held motion, the pending mode, and the actions on its parts.

An action on a part is, for example, a color, an angle of a servo, or the whistle. It may have several frames, with
delays between them. This module decides which command is next, and records the end of each. The driver decides when its
frame is written.
"""

from collections import deque
from collections.abc import Hashable, Iterable, Iterator
from typing import Any

from msgspec import Struct, field

from gateway.control.command_records import CommandLog, Pending
from gateway.control.safety_state import Safety
from gateway.control.sender_presence import SENDER_GONE_S, Senders
from schemas.limits import MAX_QUEUE_TIME_S
from schemas.rights import Sender
from schemas.words import Motion, Phase, Reason


class HeldMotion(Struct):
    """A drive in progress."""

    motion: Motion
    pending: Pending
    expires_at: float
    """When the drive ends. Before its frame is written: when the drive is given up, unless its sender renews it."""
    duration_s: float = 0.0
    """How long the drive lasts after its frame is written. 0 for a stream: each sample counts from its arrival."""
    began_at: float | None = None
    """When the frame of the drive was written, or None if the drive still waits.

    If the drive continues the same motion of another sender without a frame: when it was accepted."""
    range_cm: float | None = None
    """The last distance (in cm) that was measured before that frame was written. None if it is not known."""
    waited_for: str = ""
    """Why the drive had to wait for more than other commands, as a text for a person. Empty if it had not to."""

    @property
    def sender(self) -> Sender:
        """Return the sender of the drive."""
        return self.pending.command.sender

    @property
    def ends_at(self) -> float:
        """Return the latest time at which the drive ends, even if it still waits for the car."""
        return self.expires_at + (self.duration_s if self.began_at is None else 0.0)

    def begin(self, now: float, range_cm: float | None) -> None:
        """Record that the frame is written, so that the duration counts from now."""
        self.began_at, self.range_cm = now, range_cm
        if self.duration_s:
            self.expires_at = now + self.duration_s


class CommandQueue(Struct):
    """At most one motion, at most one mode, and a queue of actions on parts of the car. Times: s, monotonic."""

    log: CommandLog
    senders: Senders
    safety: Safety
    held: HeldMotion | None = None
    mode_change: Pending | None = None
    part_actions: deque[Pending] = field(default_factory=deque)

    @property
    def has_commands(self) -> bool:
        """Return True if there is a motion, a mode or an action."""
        return self.held is not None or self.mode_change is not None or bool(self.part_actions)

    @property
    def held_until(self) -> float:
        """Return when the held motion ends, by its duration or by the loss of its sender, or inf if none is held."""
        held = self.held
        return float("inf") if held is None else min(held.expires_at, self.senders.lost_at(held.sender.name))

    def deadlines(self) -> list[float]:
        """Return when the queued commands expire, and when the held motion ends."""
        if not self.has_commands:
            return []
        waiting = [*self.part_actions, *([self.mode_change] if self.mode_change is not None else [])]
        times = [min(pending.waits_since + MAX_QUEUE_TIME_S, pending.sender_lost_at) for pending in waiting]
        return times if self.held is None else [*times, self.held_until]

    def expire(self, now: float) -> None:
        """Expire the actions and the mode that have waited too long for a busy car.

        An action with many frames does not expire while they are written: the time counts anew for each frame.
        """
        words = f"the car was busy for {MAX_QUEUE_TIME_S:g} s"
        for pending in [each for each in self.part_actions if now >= each.waits_since + MAX_QUEUE_TIME_S]:
            written, total = pending.frames_written, pending.frames_written + len(pending.frames)
            begun = f"only {written} of its {total} frames were sent: " if written else ""
            self._end_part_action(pending, Phase.EXPIRED, Reason.EXPIRED, f"{begun}{words}", now)
        change = self.mode_change
        if change is not None and now >= change.sender_lost_at:  # nobody would be there to see the car drive off
            name = change.command.sender.text_name
            self.close_mode_change(Phase.EXPIRED, Reason.EXPIRED, f"its sender {name} disconnected", now)
        elif change is not None and now >= change.waits_since + MAX_QUEUE_TIME_S:
            self.close_mode_change(Phase.EXPIRED, Reason.EXPIRED, words, now)

    # ------------------------------------------------------------------ actions on parts of the car

    def add_part_action(self, pending: Pending, frames: Iterable[Any], part: Hashable, now: float) -> None:
        """Queue an action on a part of the car. End an action on the same part that has delayed frames left."""
        words = f"another {pending.command.verb} by {pending.command.sender.text_name}"
        for other in [each for each in self.part_actions if each.lasts and each.part == part]:
            self._end_part_action(other, Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        pending.part = part
        pending.frames.extend(frames)
        pending.begin_delay(now)
        self.part_actions.append(pending)

    @property
    def turns(self) -> Iterator[Pending]:
        """Yield the actions whose frame may be written next: an action may overtake only those with a delay."""
        for pending in self.part_actions:
            yield pending
            if not pending.is_delayed:
                return

    def next_part_action(self, now: float) -> Pending | None:
        """Return the action whose frame is due, if any."""
        return next((each for each in self.turns if now >= each.due_at), None)

    @property
    def part_action_at(self) -> float:
        """Return when the next frame of an action is due, or inf if none waits."""
        return min((each.due_at for each in self.turns), default=float("inf"))

    @property
    def has_undelayed_part_action(self) -> bool:
        """Return True if an action waits only for the car, and for no delay."""
        return any(not each.is_delayed for each in self.part_actions)

    def on_part_action_written(self, pending: Pending, now: float) -> None:
        """Remove the frame of an action that was written. Record the action as sent.

        An action is recorded as sent at its first frame if there is a delay after that, else at its last frame.
        """
        pending.frames.popleft()
        pending.frames_written += 1
        pending.begin_delay(now)
        if pending.lasts or not pending.frames:
            self.log.record_sent(pending, now)
        if not pending.frames:
            self._remove(pending)

    def end_lasting(self, words: str, now: float) -> None:
        """End the actions that still have delayed frames, because another command takes their place."""
        for pending in [each for each in self.part_actions if each.lasts]:
            self._end_part_action(pending, Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)

    def reject_part_action(self, pending: Pending, reason: Reason, words: str, now: float) -> None:
        """End an action that must not be carried out any more."""
        self._end_part_action(pending, Phase.REJECTED, reason, words, now)

    def _end_part_action(self, pending: Pending, phase: Phase, reason: Reason, words: str, now: float) -> None:
        self._remove(pending)
        self.log.record(pending, phase, now, reason=reason, words=words)

    def _remove(self, pending: Pending) -> None:
        self.part_actions = deque(each for each in self.part_actions if each is not pending)

    # ------------------------------------------------------------------ the end of commands

    def on_sender_token(self, name: str, *, alive: bool, now: float) -> None:
        """Note that the sender of a waiting mode has lost its token, or has it again."""
        change = self.mode_change
        if change is not None and change.command.sender.name == name:
            change.sender_lost_at = float("inf") if alive else now + SENDER_GONE_S

    def drop(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        """End all commands."""
        self.close_held(phase, reason, words, now)
        self.close_mode_change(phase, reason, words, now)
        while self.part_actions:
            self.log.record(self.part_actions.popleft(), phase, now, reason=reason, words=words)

    def close_held(
        self,
        phase: Phase,
        reason: Reason | None,
        words: str,
        now: float,
        *,
        basis: str = "",
        evidence: tuple[str, ...] = (),
    ) -> None:
        """End the held motion. Release the lease too if its holder has disconnected."""
        held, self.held = self.held, None
        if held is None:
            return
        if self.senders.forget(held.sender.name):
            self.safety.release(held.sender)
        if phase is not Phase.SUPERSEDED:
            self.safety.shorten_lease(now)
        self.log.record(held.pending, phase, now, reason=reason, words=words, basis=basis, evidence=evidence)

    def close_mode_change(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        """End the pending mode without opening it."""
        pending, self.mode_change = self.mode_change, None
        if pending is not None:
            self.log.record(pending, phase, now, reason=reason, words=words)

"""What is sent to one car, and when: what waits, the stops, the pacing, and what is believed of the car from it.

Each layer of control knows those below it only: commands (controller.py) on evidence (evidence.py) on execution.
"""

from dataclasses import replace
from typing import Final

from gateway.control import recipes, stop
from gateway.control.battery import Battery, Policy
from gateway.control.believed import Believed
from gateway.control.ledger import Ledger, Pending
from gateway.control.mode import ModeTruth, Verdict
from gateway.control.obedience import Obedience
from gateway.control.outbox import FLIGHT_S, Pacing
from gateway.control.platform import PlatformTruth
from gateway.control.recipes import Recipe
from gateway.control.records import (
    Fan,
    Level,
    Phase,
    Reason,
    Record,
    SetMode,
    Why,
    Write,
)
from gateway.control.safety import Hold, Kept, Safety
from gateway.control.senders import Senders
from gateway.control.stop import Running
from gateway.control.waiting import Held, Waiting
from gateway.protocol.encode import Frame, General, ModeClose, ModeOpen, encode
from gateway.protocol.profile import Profile, StopStyle
from gateway.protocol.values import Mode, Motion

TRIES: Final = 3
"""So often a car that showed nothing of `MODE00` is asked by itself whether it hears."""
LATE_S: Final = 0.1
"""A motion that was written later after it was asked, from which its time counts, is said to be shorter."""
LISTEN_S: Final = 2.2
"""How long a gateway that ends listens to the car that it stopped: a report a second, and one more without an echo."""


class Execution:
    """What waits for the car, and how it gets there: one frame in flight, a stop ahead of everything."""

    def __init__(
        self,
        car: str,
        profile: Profile,
        *,
        auto: bool = False,
        kept: Kept | None = None,
        battery_policy: Policy | None = None,
        speed_max: float = 1.0,
    ) -> None:
        self.car = car
        self.profile = profile
        self.platform = PlatformTruth(profile, auto=auto)
        self.mode = ModeTruth(profile)
        self.battery = Battery(battery_policy or Policy())
        self.pacing = Pacing(profile)
        self.believed = Believed(profile)
        self._speed_max = speed_max
        self.safety = Safety.restored(kept or Kept())
        self.known = False
        """The last recovery is complete and no write has failed since: what is sent will be read as it is meant."""
        self._link_open = False
        self.was_open = False
        """The link was open at least once: the car may have been set going."""
        self._link_reason = "not connected yet"
        self._gave_up = False
        self._unheard = False
        """The car was silent for longer than it ever is, on an open link: what was sent may not have come."""
        self._unsure = False
        """Its bytes have spoken against its platform since it was stopped last: that stop may not have been its own."""
        self._closing = False
        self.unstopped = False
        """The gateway ends, and the car could not be stopped."""
        self._ledger = Ledger()
        self._running: Running | None = None
        self._source: Running | Held | Pending | None = None
        """Whose frame `poll` returned last; None for a repetition."""
        self._mode_sent: tuple[Pending, float] | None = None
        """A mode whose effect has not been seen yet, and when its frame went out."""
        self._senders = Senders()
        self._waiting = Waiting(self._ledger, self._senders, self.safety)
        self._obedience = Obedience()
        self.deaf = False
        """It reports as if it had not got `MODE00`, and has not shown on this link that it hears at all."""
        self._tries_left = 0
        """How often it may still be asked by itself whether it hears: not once anybody has told it anything."""
        self.disobeyed = 0
        """How often what was heard has shown that a frame was lost."""
        self._left_at = self._left_until = float("-inf")
        """When the frame was written that leaves a mode, and when the car has left it at the latest."""

    # ------------------------------------------------------------------ what is known

    @property
    def motors(self) -> str:
        """`off` only after a stop that is complete; `unknown` while the car's state is."""
        if not self.known or self._unsure or self.deaf or self.mode.verdict is Verdict.CONTRADICTED:
            return "unknown"
        return "on" if self.believed.motors_on else "off"

    @property
    def motion(self) -> Motion | None:
        """The motion that was sent last; None while the car's state is unknown, and where it moves of its own."""
        return self.believed.motion if self.known and self._manual else None

    @property
    def owner(self) -> str:
        """Who holds the motion; empty if nobody does."""
        return self._waiting.held.sender.name if self._waiting.held else ""

    def expires_in_s(self, now: float) -> float:
        """How long the held motion lasts; 0 if none is held."""
        return max(0.0, self._waiting.held.expires_at - now) if self._waiting.held else 0.0

    @property
    def asked(self) -> Mode | None:
        """The mode the car is in or about to be brought to, as far as we asked; None if unknown."""
        if self._waiting.opening is not None and isinstance(self._waiting.opening.command.what, SetMode):
            return self._waiting.opening.command.what.mode
        return self.mode.asked

    @property
    def hold(self) -> Hold | None:
        """Who stopped the car, if it is on hold."""
        return self.safety.hold

    @property
    def has_records(self) -> bool:
        """Whether there is something to take."""
        return self._ledger.waiting

    def take_records(self) -> list[Record]:
        """The records since the last call."""
        return self._ledger.take()

    # ------------------------------------------------------------------ the link

    def link_up(self, now: float) -> None:
        """The link is open: bring the car to a known state."""
        self._link_open = self.was_open = True
        self._gave_up = self._unheard = self.deaf = False
        self._obedience = Obedience()
        self._tries_left = TRIES
        self.known = False
        if self.platform.auto:  # another car may have been plugged in
            self.platform = PlatformTruth(self.platform.told, auto=True)
            self._treat_as(self.platform.told)
        self.pacing.reset()
        self._begin(self._recovery(now), Why.RECOVERY, now)

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """The link is gone: nothing that waits can be sent, and the car may do anything."""
        self._link_open = False
        self._link_reason = reason
        self.known = False
        self.believed.repeat = False
        self._mode_sent = None
        self._source = None
        running, self._running = self._running, None
        for pending in running.commands if running else ():
            self._ledger.record(pending, Phase.FAILED, now, reason=cause, words=reason)
        if self._closing and running is not None and not running.frames_sent:
            self._not_stopped(now)
        self._waiting.drop(Phase.FAILED, cause, reason, now)
        self.mode.forget()
        self.believed.fan = None

    def write_failed(self, reason: str, now: float) -> None:
        """The frame that `poll` returned did not go out whole: the caller closes the link and opens it again."""
        self.link_down(reason, now, cause=Reason.WRITE_FAILED)

    def _treat_as(self, profile: Profile) -> None:
        self.profile = self.mode.profile = self.pacing.profile = profile
        self.believed = replace(self.believed, profile=profile)

    # ------------------------------------------------------------------ frames out

    def poll(self, now: float) -> Write | None:
        """The frame to write now, if any."""
        if not self._link_open:
            return None
        self._expire(now)
        if self._running is not None:
            return self._step(now)
        if self._gave_up and self._waiting.acts and isinstance(self._waiting.acts[0].command.what, Fan):
            pending = self._waiting.acts[
                0
            ]  # what silences it may be the fan: when that is off, a reading begins a recovery
            return self._write(pending.frames[0], Why.COMMAND, pending, pending) if now >= self._ready_at else None
        if not self.known or now < self._ready_at:
            return None
        held = self._waiting.held
        if held is not None and not held.pending.sent:
            return self._write(General(held.motion), Why.COMMAND, held, held.pending)
        if self._waiting.opening is not None and not (self._waiting.acts and self.at_rest):
            return self._open_mode(self._waiting.opening, now)
        if self._waiting.acts and now >= self.pacing.act_at(self._waiting.acts[0].frames[0]):
            pending = self._waiting.acts[0]  # asked before the mode, in which the car would ignore them
            return self._write(self.believed.with_motion(pending.frames[0]), Why.COMMAND, pending, pending)
        if self.believed.repeat and now >= self.pacing.repeat_at:
            return self._write(General(self.believed.motion), Why.REPEAT, None, held.pending if held else None)
        return None

    def wrote(self, write: Write, now: float) -> None:
        """The frame that `poll` returned was handed to the link."""
        source, self._source = self._source, None
        if isinstance(write.frame, ModeClose) and not self._manual:
            # A turn of the mode that is left may be deaf for longer than the closing takes; only a stop may meet it.
            deaf_until = max(now, self.pacing.block_until) + self._for_stop(now).turn_s
            self._left_at, self._left_until = now, deaf_until + self.profile.block_s(write.frame) + FLIGHT_S
        if isinstance(write.frame, ModeClose):
            self._obedience.closed(now, awake=self._awake(now))
        self.pacing.wrote(write.frame, now)
        self._note_frame(write.frame, now)
        match source:
            case Running():
                self._stepped(source, now)
            case Held():
                source.began_at = now
                self._ledger.sent(source.pending, now)
            case Pending() if source is self._waiting.opening:
                self._waiting.opening = None
                self._mode_sent = (source, now)
                self._ledger.sent(source, now)
            case Pending():
                source.frames.popleft()
                if not source.frames:
                    self._ledger.sent(source, now)
                    if self._waiting.acts and self._waiting.acts[0] is source:
                        self._waiting.acts.popleft()
            case None:
                self.believed.repeat = False

    def next_at(self, now: float) -> float:
        """When `poll` may have something to do, if nothing happens before; inf if never."""
        if not self._link_open:
            return float("inf")
        times = self._waiting.deadlines()
        if self._running is not None:
            listening = self._closing and self._running.frames_sent and self._listens(self._running)
            wake_at = self._running.last_at + LISTEN_S if listening else self._running.wake_at(self.pacing)
            times.append(max(wake_at, self._obedience.doubt_until) if self._running.frames_sent else wake_at)
        elif self.known:
            if self._waiting.acts:
                times.append(max(self.pacing.act_at(self._waiting.acts[0].frames[0]), self._left_until))
            if self._waiting.held is not None and not self._waiting.held.pending.sent:
                times.append(self._ready_at)
            if self._waiting.opening is not None:
                times.append(max(self.pacing.open_at(now), self._left_until) if self.at_rest else self._ready_at)
            if self.believed.repeat:
                times.append(max(self.pacing.repeat_at, self._left_until))
        return max(now, min(times, default=float("inf")))

    def _write(self, frame: Frame, why: Why, source: Running | Held | Pending | None, by: Pending | None) -> Write:
        self._source = source
        return Write(frame, encode(frame), why, by.command.id if by is not None else "")

    def _open_mode(self, pending: Pending, now: float) -> Write | None:
        """Open a mode, from rest in mode 0 only: opening while driving leaves the motors as they were, blind."""
        assert isinstance(pending.command.what, SetMode)
        if not self.at_rest:
            self._begin(self._full(now), Why.STOP, now)
            return self._step(now)
        if now < self.pacing.open_at(now):
            return None
        return self._write(ModeOpen(pending.command.what.mode), Why.COMMAND, pending, pending)

    def _note_frame(self, frame: Frame, now: float) -> None:
        """What a written frame does to what we know of the car."""
        self.believed.wrote(frame, now)
        match frame:
            case ModeOpen(mode):
                self._mode_sent = None
                self.mode.ask(mode, now=now, block_s=self.profile.block_s(frame))
            case ModeClose():
                if self._mode_sent is not None and self._mode_sent[0].command.what != SetMode(Mode.MANUAL):
                    self._mode_sent = None
                self.mode.ask(Mode.MANUAL, now=now, block_s=self.profile.block_s(frame))
            case _:
                self.mode.wrote(self.profile.block_s(frame), now=now)
        if self.profile.stop_style is StopStyle.RASPBERRY_PI and self.mode.asked is None:
            self.mode.ask(Mode.MANUAL, now=now, block_s=0.0)

    # ------------------------------------------------------------------ stops

    def worst_stop_s(self, now: float) -> float:
        """The longest that a stop asked now takes until the motors are off (protocol.md, "Worst case of a stop")."""
        recipe, running = self._full(now), self._running
        if running is not None and running.recipe.rank >= recipe.rank:
            return running.worst_s(now)
        return stop.worst_s(recipe, self._for_stop(now), self.pacing, now)

    def shutdown(self, now: float) -> None:
        """The gateway ends: stop the car; nothing else is accepted."""
        if self._closing:
            return
        self._closing = True
        self._waiting.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, "the gateway is ending", now)
        if self._link_open:
            self._begin(self._full(now), Why.SHUTDOWN, now)
        else:
            self._not_stopped(now)

    @property
    def finished(self) -> bool:
        """After `shutdown`: the stop is complete, or its last frame is written and it need not be listened for."""
        if self._closing and self._running is not None:
            pi = self.profile.stop_style is StopStyle.RASPBERRY_PI  # it dies when we go: it must have obeyed
            return self._running.frames_sent and not pi and not self._listens(self._running)
        return self._closing and self._running is None

    def _listens(self, running: Running) -> bool:
        """Whether the end waits until the car was heard: of a recovery, and of a stop that leaves a mode."""
        return running.recipe.confirmed or self._left_at >= running.began_at

    def _not_stopped(self, now: float) -> None:
        self.unstopped = True
        why = "sent no reading after it" if self._link_open else f"cannot be reached ({self._link_reason})"
        words = f"ending without a stop, {self.car} {why}: look whether it drives"
        self._ledger.log(Level.ERROR, "not_stopped", words, now)

    def _halt(self, words: str, now: float, by: str = "") -> None:
        """Nothing that waits is sent, and who drives on and on is not obeyed before it has paused."""
        self._waiting.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self.safety.driven_no_more(now)
        self._senders.halt(now, by)

    def _soft(self, now: float) -> Recipe:
        return stop.soft(self._for_stop(now))

    def _full(self, now: float) -> Recipe:
        return stop.full(self._for_stop(now))

    def _recovery(self, now: float) -> Recipe:
        return stop.recovery(self._for_stop(now))

    def _for_stop(self, now: float) -> stop.Situation:
        contradicted = self.mode.verdict is Verdict.CONTRADICTED
        clear, blocked = self.pacing.clear_at(now), self.pacing.blocked_at(now)
        doubted = self.platform.doubted
        return stop.Situation(self.profile, self.known, self.mode.asked, contradicted, clear, blocked, doubted)

    def _begin(self, recipe: Recipe, why: Why, now: float, pending: Pending | None = None) -> None:
        """Carry out a recipe, or join the one that runs if that is no weaker."""
        self.believed.repeat = False
        joining = [pending] if pending is not None else []
        running = self._running
        worst_at = now + stop.worst_s(recipe, self._for_stop(now), self.pacing, now)
        if running is None:
            self._running = Running(recipe, why, now, joining, worst_at=worst_at)
        elif running.recipe.rank < recipe.rank:
            self._running = Running(recipe, why, now, running.commands + joining, worst_at=worst_at)
        else:
            running.commands.extend(joining)
            if why is Why.SHUTDOWN:
                running.why = why
            if running.first_at is not None and pending is not None:
                self._ledger.sent(pending, now, f"joined the {running.recipe.name} stop under way")

    def _recover(self, now: float) -> None:
        """Bring the car to a known state, whatever runs: whoever waits for that waits for this."""
        recipe, before = self._recovery(now), self._running
        worst_at = now + stop.worst_s(recipe, self._for_stop(now), self.pacing, now)
        why, commands = (before.why, before.commands) if before is not None else (Why.RECOVERY, [])
        self._running = Running(recipe, why, now, commands, worst_at=worst_at)

    def _awake(self, now: float) -> bool:
        """No block of ours runs in mode 0, and none that we know nothing of: so a frame is obeyed at once."""
        if self._for_stop(now).style is not StopStyle.MODE_FRAME or now < self.pacing.block_until:
            return False
        return self._manual if self.known else now >= self.pacing.written_at + recipes.SILENCE_S - 0.1

    def _step(self, now: float) -> Write | None:
        running = self._running
        assert running is not None
        if running.frames_sent:
            self._overdue(running, now)
            return None
        if now < running.due_at(self.pacing):
            return None
        return self._write(running.frame, running.why, running, running.commands[0] if running.commands else None)

    def _stepped(self, running: Running, now: float) -> None:
        if running.stepped(now):
            for pending in running.commands:
                self._ledger.sent(pending, now)
                if isinstance(pending.command.what, SetMode):
                    self._mode_sent = (pending, now)
        if running is self._running and running.frames_sent:
            self._overdue(running, now)

    def _finish(self, running: Running, now: float) -> None:
        """The stop is complete: the motors are off."""
        self._running = None
        if not self.known and not self.deaf:
            self._ledger.log(Level.INFO, "recovered", f"{self.car} is in a known state: stopped, mode manual", now)
        self.known = True
        self._gave_up = self._unsure = False
        self.believed.motors_on = False
        for pending in running.commands:
            if not isinstance(pending.command.what, SetMode):
                words = f"as far as it was sent: {self.car} has not shown that it hears" if self.deaf else ""
                self._ledger.record(pending, Phase.COMPLETE, now, words=words)

    def _overdue(self, running: Running, now: float) -> None:
        """No mode-0 reading since the last frame: a stop is over in time; a recovery tries again, three times."""
        listens_until = running.last_at + LISTEN_S if self._closing and self._listens(running) else float("-inf")
        if not running.recipe.confirmed:
            if self.mode.verdict is not Verdict.ASSUMED:
                listens_until = float("-inf")
            if now < max(running.obeyed_at, listens_until, self._obedience.doubt_until):
                return
            if self.mode.verdict is Verdict.CONTRADICTED and self._recovery(now).confirmed:
                self.known = False
                self._recover(now)
                return
            if not self._unheard:
                self._finish(running, now)
                return
        elif self._closing:
            if now < listens_until:
                return
            self._running = None
            self._not_stopped(now)
            for pending in running.commands:
                self._ledger.record(
                    pending, Phase.FAILED, now, reason=Reason.LINK_DOWN, words="no reading confirmed it"
                )
            return
        elif now < running.last_at + recipes.CONFIRM_S:
            return
        elif running.retries < recipes.RETRIES:
            self._running = running.again(now)
            return
        self._running = None
        self._gave_up = True
        words = (
            f"{self.car} sent no reading after {running.retries + 1} recoveries: whether its motors run is not known "
            "(off, out of reach, its fan on: toggle it, another platform, or avoiding without an echo)"
        )
        self._ledger.log(Level.ERROR, "no_answer", words, now)
        for pending in running.commands:
            self._ledger.record(pending, Phase.FAILED, now, reason=Reason.LINK_DOWN, words=words)
        self._waiting.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)

    # ------------------------------------------------------------------ time

    def _expire(self, now: float) -> None:
        held = self._waiting.held
        if held is not None and now >= self._waiting.held_until:
            if now < held.expires_at:
                self.safety.holder_there(held.sender.name, there=False)
                self._release(Phase.EXPIRED, Reason.EXPIRED, f"its sender {held.sender.name} is gone", now)
            elif held.pending.sent:
                words = "its time is over"
                if held.began_at is not None and held.began_at > held.pending.asked_at + LATE_S:
                    words += f", of which {self.car} was driven for {now - held.began_at:.2f} s: it was busy before"
                self._release(Phase.COMPLETE, None, words, now)
            else:
                self._release(Phase.EXPIRED, Reason.EXPIRED, f"{self.car} was busy until its time was over", now)
        self._waiting.give_up_old(now)

    def _release(self, phase: Phase, reason: Reason | None, words: str, now: float) -> None:
        """The held motion is over: a soft stop, unless the car stands and never got it."""
        self._waiting.close_held(phase, reason, words, now)
        if self._link_open and self._running is None and not self.at_rest:
            self._begin(self._soft(now), Why.STOP, now)

    @property
    def at_rest(self) -> bool:
        """Known to stand in mode 0 after a complete stop."""
        return self.known and self._manual and not self.believed.motors_on

    @property
    def _manual(self) -> bool:
        return self.mode.asked is Mode.MANUAL and self.mode.verdict is not Verdict.CONTRADICTED

    @property
    def _ready_at(self) -> float:
        """From when on a frame that is no stop's may be written."""
        return max(self.pacing.flight_until, self._left_until)

    def _free_at(self, now: float) -> float:
        """When the car can take a motion, as far as it is known."""
        running = self._running
        if running is None or running.recipe.rank == recipes.SOFT.rank:
            return self._ready_at
        return max(running.over_at(self.pacing, now), self._ready_at)

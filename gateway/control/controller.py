"""Control of one car: commands, readings and link events go in, frames to write and records come out.

No I/O, no threads, no clock: time comes in as an argument, in seconds of one monotonic clock. The loop around it calls
`poll`, writes what it returns, and says `wrote` or `write_failed` before it polls again: so there is never more than
one frame on its way.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

from gateway.control import arbiter, recipes, stop
from gateway.control.battery import Action, Battery, BatteryLevel, Policy
from gateway.control.believed import Believed
from gateway.control.ledger import Ledger, Pending
from gateway.control.mode import MANUAL_SILENCE_S, ModeTruth, Verdict
from gateway.control.outbox import FLIGHT_S, Pacing
from gateway.control.platform import PlatformTruth
from gateway.control.recipes import Recipe
from gateway.control.records import (
    Act,
    Answer,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    Fan,
    Find,
    Kind,
    Level,
    Phase,
    Reason,
    Record,
    Resume,
    Sender,
    SetMode,
    Stop,
    TakeLease,
    What,
    Why,
    Write,
)
from gateway.control.safety import LEASE_S, Estop, Hold, Kept, Safety
from gateway.control.senders import PAUSE_S, Senders
from gateway.control.stop import Running
from gateway.protocol.encode import ColorLed, Frame, General, ModeClose, ModeOpen, encode
from gateway.protocol.profile import Profile, StopStyle
from gateway.protocol.readings import Event, Sensors
from gateway.protocol.values import Mode, Motion

PATIENCE_S: Final = 10.0
"""How long a one-shot or a mode may wait for a busy car before it is too old to matter."""
STALL_S: Final = 0.5
"""A loop that slept longer than this with motion held stops the car first (design.md, "Processes and threads")."""
UNDER_WAY_S: Final = 0.06
"""A reading that came sooner after a frame was under way when the frame was sent."""
FAN_SETTLED_S: Final = 2.0
"""Readings this long after a toggle were sent with the fan as it is now."""


@dataclass(slots=True)
class _Held:
    """The motion that is held, for whom, and until when."""

    motion: Motion
    pending: Pending
    expires_at: float

    @property
    def sender(self) -> Sender:
        return self.pending.command.sender


class Controller:
    """One car's control. See the module's docstring for how it is driven."""

    def __init__(
        self,
        car: str,
        profile: Profile,
        *,
        auto: bool = False,
        kept: Kept | None = None,
        battery_policy: Policy | None = None,
    ) -> None:
        self.car = car
        self.profile = profile
        self.platform = PlatformTruth(profile, auto=auto)
        self.mode = ModeTruth(profile)
        self.battery = Battery(battery_policy or Policy())
        self.pacing = Pacing(profile)
        self.believed = Believed(profile)
        self.safety = Safety.restored(kept or Kept())
        self.known = False
        """The last recovery is complete and no write has failed since: what is sent will be read as it is meant."""
        self._link_open = False
        self._was_open = False
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
        self._held: _Held | None = None
        self._opening: Pending | None = None
        self._acts: deque[Pending] = deque()
        self._source: Running | _Held | Pending | None = None
        """Whose frame `poll` returned last; None for a repetition."""
        self._mode_sent: tuple[Pending, float] | None = None
        """A mode whose effect has not been seen yet, and when its frame went out."""
        self._senders = Senders()
        self._left_at = self._left_until = float("-inf")
        """When the frame was written that leaves a mode, and when the car has left it at the latest."""

    # ------------------------------------------------------------------ what is known

    @property
    def motors(self) -> str:
        """`off` only after a stop that is complete; `unknown` while the car's state is."""
        if not self.known or self._unsure or self.mode.verdict is Verdict.CONTRADICTED:
            return "unknown"
        return "on" if self.believed.motors_on else "off"

    @property
    def motion(self) -> Motion | None:
        """The motion that was sent last; None while the car's state is unknown, and where it moves of its own."""
        return self.believed.motion if self.known and self._manual else None

    @property
    def owner(self) -> str:
        """Who holds the motion; empty if nobody does."""
        return self._held.sender.name if self._held else ""

    def expires_in_s(self, now: float) -> float:
        """How long the held motion lasts; 0 if none is held."""
        return max(0.0, self._held.expires_at - now) if self._held else 0.0

    @property
    def asked(self) -> Mode | None:
        """The mode the car is in or about to be brought to, as far as we asked; None if unknown."""
        if self._opening is not None and isinstance(self._opening.command.what, SetMode):
            return self._opening.command.what.mode
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

    # ------------------------------------------------------------------ link, readings, senders, time

    def link_up(self, now: float) -> None:
        """The link is open: bring the car to a known state."""
        self._link_open = self._was_open = True
        self._gave_up = self._unheard = False
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
        self._drop(Phase.FAILED, cause, reason, now)
        self.mode.forget()
        self.believed.fan = None

    def heard(self, event: Event, now: float) -> None:
        """Take an event of the decoder as evidence."""
        for words in self.platform.heard(event):
            self._ledger.log(Level.WARNING, "platform_contradicted", f"{self.car}: {words}", now)
            self._unsure = self.platform.doubted
        if not isinstance(event, Sensors):
            return
        before = self.mode.verdict
        self.mode.heard(event)
        self._note_verdict(before, now)
        self._note_effect(event, now)
        if self._unheard:
            self._heard_again(now)
            return
        if event.signature is not Mode.MANUAL:
            return
        if event.at > self._left_at + UNDER_WAY_S:
            self._left_until = float("-inf")
        if event.range_cm is not None:
            self.pacing.heard(event.at)
        if event.voltage_v is not None and "battery" in self.profile.measured(event, self.mode.confirmed):
            self._weigh_battery(event.voltage_v, now)
        if now > self.believed.fan_at + FAN_SETTLED_S and self.profile.stop_style is not StopStyle.RASPBERRY_PI:
            self.believed.fan = False  # protocol.md: a car whose fan runs sends no readings
        running = self._running
        if running is None:
            if self._gave_up and self._link_open:
                self._gave_up = False
                self._ledger.log(Level.INFO, "answers_again", "a reading came: recovery begins again", now)
                self._begin(self._recovery(now), Why.RECOVERY, now)
        elif running.frames_sent and event.at > running.last_at + UNDER_WAY_S:
            self._finish(running, now)

    def _settle(self, now: float) -> None:
        """Treat the car as what its bytes have shown it to be; between stops only, each of which is one platform's."""
        if self.platform.profile is self.profile or not self.known or self._running is not None:
            return
        self._treat_as(self.platform.profile)
        words = f"{self.car} is treated as {self.profile.name} from now on: {self.platform.evidence[0]}"
        self._ledger.log(Level.INFO, "platform_settled", words, now)

    def _treat_as(self, profile: Profile) -> None:
        self.profile = self.mode.profile = self.pacing.profile = profile
        self.believed = replace(self.believed, profile=profile)

    def _weigh_battery(self, voltage_v: float, now: float) -> None:
        """Tell of a level that has changed, and stop the car if it should be stopped at that level."""
        if not self.battery.heard(voltage_v, loaded=self.motors != "off", now=now):
            return
        level, words = self.battery.level, f"{self.car}: {self.battery.words}"
        grave = {BatteryLevel.LOW: Level.WARNING, BatteryLevel.CRITICAL: Level.ERROR}
        self._ledger.log(grave.get(level or BatteryLevel.OK, Level.INFO), f"battery_{level}", words, now)
        if self.battery.action is Action.STOP and not self.at_rest:
            self._halt(words, now)
            if self._link_open and not self._closing:
                self._begin(self._full(now), Why.STOP, now)

    def tick(self, now: float) -> None:
        """Weigh silence; called a few times a second."""
        self._settle(now)
        before = self.mode.verdict
        if self._link_open and self.known and self._running is None:
            self._weigh_silence(now)
        self._note_verdict(before, now)

    def _weigh_silence(self, now: float) -> None:
        fan = bool(self.believed.fan)
        self.mode.silent(now=now, fan=fan)
        expected = self.mode.silence_limit(fan=fan) is not None
        silent_s = self.mode.unheard_s(now)
        if expected and not self._unheard and silent_s > MANUAL_SILENCE_S:
            self._unheard = True
            self.known = False
            words = (
                f"{self.car} was not heard for {silent_s:.1f} s: whether it moves is not known "
                "(off, out of reach, or its link stuck); it is stopped when it is heard again"
            )
            self._ledger.log(Level.WARNING, "unheard", words, now)

    def _heard_again(self, now: float) -> None:
        """A link that was stuck may deliver at once what was written meanwhile, of which a car obeys only the first."""
        self._unheard = self._gave_up = False
        words = f"{self.car} is heard again: it is stopped first"
        self._ledger.log(Level.INFO, "answers_again", words, now)
        self._drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        recipe, before = self._recovery(now), self._running  # whose frames may be among what was held up
        worst_at = now + stop.worst_s(recipe, self._for_stop(now), self.pacing, now)
        why, commands = (before.why, before.commands) if before is not None else (Why.RECOVERY, [])
        self._running = Running(recipe, why, now, commands, worst_at=worst_at)

    def sender_alive(self, name: str, *, alive: bool, now: float) -> None:
        """A sender's liveliness token appeared or went."""
        if alive:
            self._senders.appeared(name)
            return
        driving = self._held is not None and self._held.sender.name == name
        self._senders.vanished(name, now, driving=driving)
        lease = self.safety.lease
        if not driving and lease is not None and lease.holder.name == name:
            self.safety.release(lease.holder)  # a command line that is done: the next one need not wait

    def unite(self, estops: Iterable[Estop], ended: Iterable[str], shown_by: str, now: float) -> None:
        """Take over the fleet-wide e-stops, in force and ended, that another gateway of the fleet shows."""
        begun, over = self.safety.unite(estops, ended)
        for estop in over:
            self._ledger.log(Level.WARNING, "estop_ended", f"e-stop {estop.id} has ended, as {shown_by} shows", now)
        if not begun:
            return
        why = f": {begun[0].why}" if begun[0].why else ""
        words = f"e-stop {begun[0].id} by {begun[0].by} is in force in the fleet, as {shown_by} shows{why}"
        self._ledger.log(Level.ERROR, "estop_joined", words, now)
        self._halt(words, now)
        if self._link_open and not self._closing:
            self._begin(self._full(now), Why.STOP, now)

    def stalled(self, gap_s: float, now: float) -> None:
        """The loop slept for `gap_s`: with motion held the car is stopped first."""
        if gap_s > STALL_S and self._held is not None:
            words = f"the gateway stalled for {gap_s:.1f} s with motion held: stopping"
            self._ledger.log(Level.ERROR, "stalled", words, now)
            self._release(Phase.EXPIRED, Reason.EXPIRED, words, now)

    # ------------------------------------------------------------------ commands

    def command(self, command: Command, now: float) -> Answer:
        """Take a command: refuse it with a reason, or begin to carry it out. What becomes of it is recorded."""
        pending, what = Pending(command, now), command.what
        if self._ledger.known(command) and not isinstance(what, Stop | EmergencyStop):
            words = f"a command with id {command.id} came already"
            if not command.streamed:  # not under its id: that is the record of the first
                self._ledger.log(Level.WARNING, "duplicate", f"{command.verb} by {command.sender.name}: {words}", now)
                return Answer(Phase.REJECTED, Reason.DUPLICATE, words)
            return self._reject(pending, Reason.DUPLICATE, words, now)
        if not command.streamed:
            self._ledger.record(pending, Phase.ASKED, now)
        if isinstance(what, Stop | EmergencyStop):
            return self._stop(pending, now)
        # A drive is noted also while it is refused: a lease that lapses after a stop must not set it going.
        halted = isinstance(what, Drive) and not self._has_let_go(command, what, now)
        refusal = arbiter.refuse(command, self._situation(now))
        if refusal is not None:
            return self._reject(pending, *refusal, now)
        if halted:
            words = f"{self.car} was stopped: let go for {PAUSE_S:g} s (or send stop), then drive again"
            return self._reject(pending, Reason.HELD, words, now)
        busy = self._too_busy(what, now)
        if busy:  # what is refused takes no lease and ends no hold
            return self._reject(pending, Reason.EXPIRED, busy, now)
        self._ledger.accepted(command)
        if arbiter.needs(what).lease:
            self._lease(command, now)
        moves = isinstance(what, SetMode) or (isinstance(what, Drive) and what.motion is not Motion.STOP)
        if moves and command.sender.kind is not Kind.COORDINATOR:  # letting go hands the car to nobody
            self._end_hold(command.sender, now)
        match what:
            case Drive(Motion.STOP):
                return self._release_asked(pending, now)
            case Drive():
                return self._drive(pending, what, now)
            case SetMode(Mode.MANUAL):
                return self._close_mode(pending, now)
            case SetMode(mode):
                return self._set_mode(pending, mode, now)
            case Resume(ids):
                return self._resume(pending, ids, now)
            case TakeLease(release):
                return self._take_lease(pending, now, release=release)
            case Fan(bool() as on) if on == self.believed.fan:
                return self._done(pending, f"the fan is {'on' if on else 'off'} already", now)
            case Fan():
                pending.frames.append(General(Motion.STOP, fan=True))
            case Act(frame):
                pending.frames.append(frame)
            case ChangeSpeed(step):
                pending.frames.append(General(Motion.STOP, speed=step))
            case Find():
                whistle = General(Motion.STOP, whistle=True)
                blinks = (whistle, ColorLed(255, 255, 255), whistle, self.believed.led)
                pending.frames.extend(frame for frame in blinks if self.profile.refusal(frame) is None)
        self._acts.append(pending)
        return self._queued(pending, now)

    def refused(self, command: Command, reason: Reason, words: str, now: float) -> Answer:
        """Record a command that was no command, as its parser says."""
        pending = Pending(command, now)
        if not command.streamed:
            self._ledger.record(pending, Phase.ASKED, now)
        return self._reject(pending, reason, words, now)

    def shutdown(self, now: float) -> None:
        """The gateway ends: stop the car; nothing else is accepted."""
        if self._closing:
            return
        self._closing = True
        self._drop(Phase.SUPERSEDED, Reason.SUPERSEDED, "the gateway is ending", now)
        if self._link_open:
            self._begin(self._full(now), Why.SHUTDOWN, now)
        elif self._was_open:
            self._not_stopped(now)

    def _not_stopped(self, now: float) -> None:
        self.unstopped = True
        words = f"ending without a stop, {self.car} cannot be reached ({self._link_reason}): look whether it drives"
        self._ledger.log(Level.ERROR, "not_stopped", words, now)

    @property
    def finished(self) -> bool:
        """After `shutdown`: the last frame is written, and a Raspberry Pi, which dies when we go, has obeyed it."""
        if self._closing and self._running is not None and self.profile.stop_style is not StopStyle.RASPBERRY_PI:
            return self._running.frames_sent
        return self._closing and self._running is None

    # ------------------------------------------------------------------ frames out

    def poll(self, now: float) -> Write | None:
        """The frame to write now, if any."""
        if not self._link_open:
            return None
        self._expire(now)
        if self._running is not None:
            return self._step(now)
        if self._gave_up and self._acts and isinstance(self._acts[0].command.what, Fan):
            pending = self._acts[0]  # what silences it may be the fan: when that is off, a reading begins a recovery
            return self._write(pending.frames[0], Why.COMMAND, pending, pending) if now >= self._ready_at else None
        if not self.known or now < self._ready_at:
            return None
        held = self._held
        if held is not None and not held.pending.sent:
            return self._write(General(held.motion), Why.COMMAND, held, held.pending)
        if self._opening is not None and not (self._acts and self.at_rest):
            return self._open_mode(self._opening, now)
        if self._acts and now >= self.pacing.act_at(self._acts[0].frames[0]):
            pending = self._acts[0]  # asked before the mode, in which the car would ignore them
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
        self.pacing.wrote(write.frame, now)
        self._note_frame(write.frame, now)
        match source:
            case Running():
                self._stepped(source, now)
            case _Held():
                self._ledger.sent(source.pending, now)
            case Pending() if source is self._opening:
                self._opening = None
                self._mode_sent = (source, now)
                self._ledger.sent(source, now)
            case Pending():
                source.frames.popleft()
                if not source.frames:
                    self._ledger.sent(source, now)
                    if self._acts and self._acts[0] is source:
                        self._acts.popleft()
            case None:
                self.believed.repeat = False

    def write_failed(self, reason: str, now: float) -> None:
        """The frame that `poll` returned did not go out whole: the caller closes the link and opens it again."""
        self.link_down(reason, now, cause=Reason.WRITE_FAILED)

    def next_at(self, now: float) -> float:
        """When `poll` may have something to do, if nothing happens before; inf if never."""
        if not self._link_open:
            return float("inf")
        times = [act.asked_at + PATIENCE_S for act in self._acts]
        if self._held is not None:
            times.append(self._held_until(self._held))
        if self._opening is not None:
            times.append(self._opening.asked_at + PATIENCE_S)
        if self._running is not None:
            times.append(self._running.wake_at(self.pacing))
        elif self.known:
            if self._acts:
                times.append(max(self.pacing.act_at(self._acts[0].frames[0]), self._left_until))
            if self._held is not None and not self._held.pending.sent:
                times.append(self._ready_at)
            if self._opening is not None:
                times.append(max(self.pacing.open_at(now), self._left_until) if self.at_rest else self._ready_at)
            if self.believed.repeat:
                times.append(max(self.pacing.repeat_at, self._left_until))
        return max(now, min(times, default=float("inf")))

    # ------------------------------------------------------------------ how long a stop takes

    def worst_stop_s(self, now: float) -> float:
        """The longest that a stop asked now takes until the motors are off (protocol.md, "Worst case of a stop")."""
        recipe, running = self._full(now), self._running
        if running is not None and running.recipe.rank >= recipe.rank:
            return running.worst_s(now)
        return stop.worst_s(recipe, self._for_stop(now), self.pacing, now)

    # ------------------------------------------------------------------ commands, one by one

    def _stop(self, pending: Pending, now: float) -> Answer:
        command = pending.command
        sender, latched = command.sender, command.note
        if isinstance(command.what, EmergencyStop):
            estop = Estop(command.id, sender.name, command.what.why, command.asked_ns, command.what.fleet_wide)
            until = f"latched as {self.safety.latch(estop).id} until it is resumed"
            why = f": {estop.why}" if estop.why else ""
            self._ledger.log(Level.ERROR, "estop", f"{self.car}: e-stop by {sender.name}{why}; {until}", now)
            latched = f"{until}; {command.note}" if command.note else until
        elif sender.kind is not Kind.COORDINATOR:
            self.safety.held_by(sender.name, command.asked_ns)
        self._halt(f"{command.verb} by {sender.name}", now, by=sender.name)
        if not self._link_open or self._closing:
            why = "its gateway is ending" if self._closing else self._link_reason
            words = f"{self.car} cannot be reached: {why}; it is stopped first when its link is back"
            return self._reject(pending, Reason.LINK_DOWN, f"{words} ({latched})" if latched else words, now)
        if self._unheard:
            silent = f"{self.car} was not heard for {self.mode.unheard_s(now):.0f} s: it may not get this stop"
            latched = f"{silent}; {latched}" if latched else silent
        worst = self.worst_stop_s(now)
        self._ledger.record(pending, Phase.QUEUED, now, words=latched, worst_case_s=worst)
        self._begin(self._full(now), Why.STOP, now, pending)
        return Answer(Phase.QUEUED, words=latched, worst_case_s=worst)

    def _halt(self, words: str, now: float, by: str = "") -> None:
        """Nothing that waits is sent, and who drives on and on is not obeyed before it has paused."""
        self._drop(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self.safety.driven_no_more(now)
        self._senders.halt(now, by)

    def _has_let_go(self, command: Command, drive: Drive, now: float) -> bool:
        release = drive.motion is Motion.STOP
        return self._senders.drives(command.sender.name, now, streamed=command.streamed, release=release)

    def _resume(self, pending: Pending, ids: tuple[str, ...], now: float) -> Answer:
        sender = pending.command.sender.name
        if ids:
            over = " ".join(estop.id for estop in self.safety.end(ids))
            words = f"e-stop {over} was ended by {sender}" if over else "ended already"
            if over:
                self._ledger.log(Level.WARNING, "estop_ended", words, now)
        elif self.hold is not None:
            words = f"the hold by {self.hold.by} has ended"
            self._end_hold(pending.command.sender, now)
        else:
            words = f"{self.car} was not on hold"
        if self.safety.estops:
            words += f"; still in force: e-stop {' '.join(estop.id for estop in self.safety.estops)}"
        elif self.hold is not None:
            words += f"; on hold (by {self.hold.by}) until a person or script drives, sets a mode or resumes"
        return self._done(pending, words, now)

    def _lease(self, command: Command, now: float) -> None:
        """The car is the sender's while it drives; who had it is told by whom it was taken."""
        sender, before = command.sender, self.safety.leased(now)
        lasts_s = command.what.duration_s if isinstance(command.what, Drive) else 0.0
        self.safety.grant(sender, now + lasts_s)
        if before is None or before.holder == sender:
            return
        words = f"taken over by {sender.name} ({sender.kind}) from {before.holder.name} ({before.holder.kind})"
        self._ledger.log(Level.INFO, "lease_taken", f"{self.car}: {words}", now)
        if self._held is not None and self._held.sender != sender and not isinstance(command.what, Drive | SetMode):
            self._release(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)

    def _take_lease(self, pending: Pending, now: float, *, release: bool) -> Answer:
        sender = pending.command.sender
        if not release:
            return self._done(pending, f"{self.car} is {sender.name}'s for {LEASE_S:g} s, and while it drives", now)
        if not self.safety.release(sender):
            return self._done(pending, f"{sender.name} had no lease of {self.car}", now)
        if self._held is not None and self._held.sender == sender:
            self._release(Phase.COMPLETE, None, f"released by {sender.name}", now)
        return self._done(pending, f"{self.car} is free", now)

    def _too_busy(self, what: What, now: float) -> str:
        """Why a drive would be over before it could begin; empty if it would not."""
        free_at = self._free_at(now)
        if not isinstance(what, Drive) or what.motion is Motion.STOP or now + what.duration_s > free_at:
            return ""
        return f"{self.car} is busy for {free_at - now:.1f} s more, longer than this drive's {what.duration_s:g} s"

    def _drive(self, pending: Pending, drive: Drive, now: float) -> Answer:
        sender, held = pending.command.sender, self._held
        if held is not None and held.motion is drive.motion and held.sender == sender:
            return self._drive_on(held, pending, now + drive.duration_s, now)
        words = f"{drive.motion} by {sender.name}"
        self._close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._held = _Held(drive.motion, pending, now + drive.duration_s)
        if held is not None and held.motion is drive.motion and held.pending.sent:
            self._ledger.sent(pending, now, "the motion is held on")
            return Answer(Phase.SENT, words="the motion is held on")
        running = self._running
        if running is not None and running.recipe.rank == recipes.SOFT.rank:
            # The car is wanted to move again: the rest of a soft stop would only jerk it.
            self._running = None
            for other in running.commands:
                self._ledger.record(other, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words=words)
        return self._queued(pending, now)

    def _drive_on(self, held: _Held, pending: Pending, expires_at: float, now: float) -> Answer:
        """The same sender wants the same motion for longer: nothing is written again."""
        held.expires_at = expires_at
        held.pending.count += 1
        if pending.command.streamed:
            return Answer(Phase.SENT if held.pending.sent else Phase.QUEUED)
        if held.pending.sent:
            return self._done(pending, "the motion is held on", now)
        self._ledger.record(
            held.pending, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words="asked again before it was sent"
        )
        pending.count = held.pending.count
        held.pending = pending
        return self._queued(pending, now)

    def _release_asked(self, pending: Pending, now: float) -> Answer:
        sender = pending.command.sender.name
        self._close_held(Phase.COMPLETE, None, f"released by {sender}", now)
        self._close_opening(Phase.SUPERSEDED, Reason.SUPERSEDED, f"released by {sender}", now)
        if self._running is None and self.at_rest:
            return self._done(pending, f"{self.car} is at rest", now)
        worst = self.worst_stop_s(now)
        if not pending.command.streamed:
            self._ledger.record(pending, Phase.QUEUED, now, worst_case_s=worst)
        self._begin(self._soft(now), Why.STOP, now, None if pending.command.streamed else pending)
        return Answer(Phase.QUEUED, worst_case_s=worst)

    def _close_mode(self, pending: Pending, now: float) -> Answer:
        self._drop(Phase.SUPERSEDED, Reason.SUPERSEDED, f"mode manual by {pending.command.sender.name}", now)
        answer = self._queued(pending, now)
        self._begin(self._full(now), Why.COMMAND, now, pending)
        return answer

    def _set_mode(self, pending: Pending, mode: Mode, now: float) -> Answer:
        words = f"mode {mode} by {pending.command.sender.name}"
        self._close_opening(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        settled = self.known and self._running is None and self.mode.verdict is not Verdict.CONTRADICTED
        if settled and self.mode.asked is mode:
            return self._done(pending, f"{self.car} is in {mode} already ({self.mode.verdict})", now)
        self._opening = pending
        return self._queued(pending, now)

    def _done(self, pending: Pending, words: str, now: float) -> Answer:
        if not pending.command.streamed:
            self._ledger.sent(pending, now, words)
        return Answer(Phase.SENT, words=words)

    def _queued(self, pending: Pending, now: float) -> Answer:
        self._ledger.record(pending, Phase.QUEUED, now)
        return Answer(Phase.QUEUED)

    def _reject(self, pending: Pending, reason: Reason, words: str, now: float) -> Answer:
        self._ledger.refused(pending, reason, words, now)
        return Answer(Phase.REJECTED, reason, words)

    def _end_hold(self, sender: Sender, now: float) -> None:
        if self.hold is not None:
            words = f"the hold by {self.hold.by} was ended by {sender.name}"
            self._ledger.log(Level.INFO, "hold_ended", words, now)
            self.safety.hold = None

    def _situation(self, now: float) -> arbiter.Situation:
        return arbiter.Situation(
            car=self.car,
            profile=self.profile,
            now=now,
            link_open=self._link_open,
            link_reason=self._link_reason,
            answering=not (self._gave_up or self._unheard),
            closing=self._closing,
            asked=self.asked,
            contradicted=self.mode.verdict is Verdict.CONTRADICTED,
            held_by=self.hold.by if self.hold else None,
            estops=self.safety.estops,
            ended=self.safety.ended,
            lease=self.safety.leased(now),
            battery=self.battery.refusal,
            fan=self.believed.fan,
            queued=len(self._acts),
        )

    # ------------------------------------------------------------------ stops

    @property
    def _manual(self) -> bool:
        return self.mode.asked is Mode.MANUAL and self.mode.verdict is not Verdict.CONTRADICTED

    @property
    def at_rest(self) -> bool:
        """Known to stand in mode 0 after a complete stop."""
        return self.known and self._manual and not self.believed.motors_on

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
        if not self.known:
            self._ledger.log(Level.INFO, "recovered", f"{self.car} is in a known state: stopped, mode manual", now)
        self.known = True
        self._gave_up = self._unsure = False
        self.believed.motors_on = False
        for pending in running.commands:
            if not isinstance(pending.command.what, SetMode):
                self._ledger.record(pending, Phase.COMPLETE, now)

    def _overdue(self, running: Running, now: float) -> None:
        """No mode-0 reading since the last frame: a stop is over in time; a recovery tries again, three times."""
        if not running.recipe.confirmed:
            if now < running.obeyed_at:
                return
            if not self._unheard:
                self._finish(running, now)
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
        self._drop(Phase.FAILED, Reason.LINK_DOWN, words, now)

    # ------------------------------------------------------------------ frames, one by one

    def _write(self, frame: Frame, why: Why, source: Running | _Held | Pending | None, by: Pending | None) -> Write:
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

    # ------------------------------------------------------------------ time

    def _held_until(self, held: _Held) -> float:
        return min(held.expires_at, self._senders.lost_at(held.sender.name))

    def _expire(self, now: float) -> None:
        held = self._held
        if held is not None and now >= self._held_until(held):
            if now < held.expires_at:
                self._release(Phase.EXPIRED, Reason.EXPIRED, f"its sender {held.sender.name} is gone", now)
            elif held.pending.sent:
                self._release(Phase.COMPLETE, None, "its time is over", now)
            else:
                self._release(Phase.EXPIRED, Reason.EXPIRED, f"{self.car} was busy until its time was over", now)
        waited = f"waited {PATIENCE_S:g} s for a busy car"
        while self._acts and now >= self._acts[0].asked_at + PATIENCE_S:
            self._ledger.record(self._acts.popleft(), Phase.EXPIRED, now, reason=Reason.EXPIRED, words=waited)
        if self._opening is not None and now >= self._opening.asked_at + PATIENCE_S:
            self._close_opening(Phase.EXPIRED, Reason.EXPIRED, waited, now)

    def _release(self, phase: Phase, reason: Reason | None, words: str, now: float) -> None:
        """The held motion is over: a soft stop, unless the car stands and never got it."""
        self._close_held(phase, reason, words, now)
        if self._link_open and self._running is None and not self.at_rest:
            self._begin(self._soft(now), Why.STOP, now)

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

    # ------------------------------------------------------------------ what waits or is held ends

    def _drop(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        self._close_held(phase, reason, words, now)
        self._close_opening(phase, reason, words, now)
        while self._acts:
            self._ledger.record(self._acts.popleft(), phase, now, reason=reason, words=words)

    def _close_held(self, phase: Phase, reason: Reason | None, words: str, now: float) -> None:
        held, self._held = self._held, None
        if held is not None:
            if self._senders.forget(held.sender.name):
                self.safety.release(held.sender)
            if phase is not Phase.SUPERSEDED:
                self.safety.driven_no_more(now)
            self._ledger.record(held.pending, phase, now, reason=reason, words=words)

    def _close_opening(self, phase: Phase, reason: Reason, words: str, now: float) -> None:
        pending, self._opening = self._opening, None
        if pending is not None:
            self._ledger.record(pending, phase, now, reason=reason, words=words)

    def _note_verdict(self, before: Verdict, now: float) -> None:
        verdict = self.mode.verdict
        if verdict is before:
            return
        if verdict is Verdict.CONTRADICTED:
            words = f"asked for mode {self.mode.asked}, but: {self.mode.evidence}"
            self._ledger.log(Level.WARNING, "mode_contradicted", words, now)

    def _note_effect(self, event: Sensors, now: float) -> None:
        """A reading that began after the mode's frame, and has its shape, is the effect."""
        if self._mode_sent is None or self.mode.verdict is not Verdict.CONFIRMED:
            return
        pending, sent_at = self._mode_sent
        what = pending.command.what
        if isinstance(what, SetMode) and event.signature is what.mode and event.at > sent_at + UNDER_WAY_S:
            self._mode_sent = None
            self._ledger.record(pending, Phase.EFFECT_SEEN, now, evidence=(self.mode.evidence,))

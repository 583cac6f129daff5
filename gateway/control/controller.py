"""Control of one car: commands, readings and link events go in, frames to write and records come out.

No I/O, no threads, no clock: time comes in as an argument, in seconds of one monotonic clock. The loop around it calls
`poll`, writes what it returns, and says `wrote` or `write_failed` before it polls again: so there is never more than
one frame on its way.
"""

from collections.abc import Iterable

from gateway.control import arbiter
from gateway.control.car_model import CarModel
from gateway.control.car_monitor import CarMonitor
from gateway.control.command_log import CommandLog, Pending
from gateway.control.command_queue import HeldMotion
from gateway.control.commands import (
    Action,
    Answer,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    Fan,
    Find,
    OneShot,
    Phase,
    Reason,
    Resume,
    Sender,
    SenderKind,
    SetMode,
    Stop,
    TakeLease,
)
from gateway.control.estimate.battery import Battery, BatteryPolicy
from gateway.control.estimate.mode import ModeEstimator, Verdict
from gateway.control.estimate.outputs import StateEstimate
from gateway.control.estimate.platform import PlatformDetector
from gateway.control.estimate.trust import Basis, CarTrust
from gateway.control.events import FrameOrigin, Level, OutgoingFrame, Record
from gateway.control.executor import Executor
from gateway.control.pacing import Pacing
from gateway.control.safety import LEASE_S, Estop, Hold, PersistedSafety, Safety
from gateway.control.senders import PAUSE_S
from gateway.control.stops import sequences
from gateway.control.stops.stopping import StopInProgress
from gateway.protocol.enums import Mode, Motion
from gateway.protocol.events import Event
from gateway.protocol.frames import ColorLed, Frame, General, ModeOpen
from gateway.protocol.platforms import Profile


class Controller:
    """One car's control. See the module's docstring for how it is driven.

    It holds small objects that share one `CarModel`: `CarMonitor` takes readings, `Executor` sends, `CommandLog` keeps
    the records. The controller itself takes commands.
    """

    def __init__(
        self,
        car: str,
        profile: Profile,
        *,
        auto: bool = False,
        kept: PersistedSafety | None = None,
        battery_policy: BatteryPolicy | None = None,
        speed_max: float = 1.0,
    ) -> None:
        self.car = car
        self.safety = Safety.restored(kept or PersistedSafety())
        self._ledger = CommandLog()
        self.model = CarModel(car, profile, auto, self._ledger, battery_policy or BatteryPolicy())
        self._executor = Executor(self.model, self._ledger, self.safety)
        self._monitor = CarMonitor(self.model, self._executor, self._ledger)
        self._senders = self._executor.senders
        self._waiting = self._executor.waiting
        self._speed_max = speed_max
        self.was_open = False
        """The link was open at least once: the car may have been set going."""

    # ------------------------------------------------------------------ what is known

    @property
    def profile(self) -> Profile:
        """Return what the car is treated as."""
        return self.model.profile

    @property
    def platform(self) -> PlatformDetector:
        """Return what the car's bytes show of its platform."""
        return self.model.platform

    @property
    def mode(self) -> ModeEstimator:
        """Return what is known of the car's mode."""
        return self.model.mode

    @property
    def battery(self) -> Battery:
        """Return what is known of the car's battery."""
        return self.model.battery

    @property
    def pacing(self) -> Pacing:
        """Return when the next frame may be written."""
        return self.model.pacing

    @property
    def believed(self) -> StateEstimate:
        """Return what was written to the car, as a state."""
        return self.model.believed

    @property
    def known(self) -> bool:
        """Return True if the car reads what is sent as it is meant."""
        return self.model.known

    @property
    def running(self) -> StopInProgress | None:
        """Return the stop that goes on, if one does."""
        return self._executor.running

    @property
    def motors(self) -> str:
        """Return `off`, `on`, `stopping` or `unknown`."""
        return self.model.motors

    @property
    def basis(self) -> Basis | None:
        """Return what `off` rests on: `shown` or `sent`; None if the motors are not off."""
        return self.model.basis

    @property
    def motion(self) -> Motion | None:
        """Return the motion that was sent last; None if the state is unknown or the car moves by itself."""
        return self.model.motion

    @property
    def at_rest(self) -> bool:
        """Return True if the car stands in mode 0 after a stop, as shown or as sent."""
        return self.model.at_rest

    @property
    def is_heard(self) -> bool:
        """Return False if the car is silent for longer than it ever is."""
        return self.model.trust.state is not CarTrust.UNHEARD

    @property
    def lost_frames(self) -> int:
        """Return how often the car's reports have shown that a frame was lost."""
        return self._monitor.lost_frames

    @property
    def owner(self) -> str:
        """Return who holds the motion; empty if nobody does."""
        return self._waiting.held.sender.name if self._waiting.held else ""

    def expires_in_s(self, now: float) -> float | None:
        """Return how long the held motion lasts; None if none is held."""
        return max(0.0, self._waiting.held.expires_at - now) if self._waiting.held else None

    @property
    def asked(self) -> Mode | None:
        """Return the mode that the car is in or about to be brought to, as far as we asked; None if unknown."""
        opening = self._waiting.opening
        if opening is not None and isinstance(opening.command.what, SetMode):
            return opening.command.what.mode
        return self.mode.asked

    @property
    def hold(self) -> Hold | None:
        """Return who stopped the car, if it is on hold."""
        return self.safety.hold

    @property
    def has_records(self) -> bool:
        """Return True if there are records to take."""
        return self._ledger.waiting

    def take_records(self) -> list[Record]:
        """Return the records since the last call."""
        return self._ledger.take()

    # ------------------------------------------------------------------ link, frames, readings, time

    def link_up(self, now: float) -> None:
        """Bring the car to a known state: the link is open."""
        self.was_open = True
        self._monitor.link_up()
        self._executor.link_up(now)

    def link_down(self, reason: str, now: float) -> None:
        """Fail all that waits: the link is gone, and the car may do anything."""
        self._executor.link_down(reason, now, cause=Reason.LINK_DOWN)

    def write_failed(self, reason: str, now: float) -> None:
        """Take that the frame of `poll` did not go out whole: the caller closes the link and opens it again."""
        self._executor.link_down(reason, now, cause=Reason.WRITE_FAILED)

    def poll(self, now: float) -> OutgoingFrame | None:
        """Return the frame to write now, if any."""
        return self._executor.poll(now)

    def wrote(self, write: OutgoingFrame, now: float) -> None:
        """Take that the frame of `poll` was handed to the link."""
        self._executor.wrote(write, now)

    def next_at(self, now: float) -> float:
        """Return when `poll` may have something to do if nothing happens before; inf if never."""
        return self._executor.next_at(now)

    def heard(self, event: Event, now: float) -> None:
        """Take an event of the decoder as evidence."""
        self._monitor.heard(event, now)

    def tick(self, now: float) -> None:
        """Weigh silence; called a few times a second."""
        self._monitor.tick(now)

    def stalled(self, gap_s: float, now: float) -> None:
        """Take that the loop slept for `gap_s`."""
        self._monitor.stalled(gap_s, now)

    def shutdown(self, now: float) -> None:
        """Stop the car and accept nothing else: the gateway ends."""
        self._executor.shutdown(now)

    @property
    def finished(self) -> bool:
        """Return True after `shutdown` if the stop is over, or the car did not show it in time."""
        return self._executor.finished

    @property
    def not_stopped(self) -> str:
        """Return why the gateway ends without a stop of the car; empty if it does not."""
        return self._executor.not_stopped

    def worst_stop_s(self, now: float) -> float:
        """Return the longest that a stop asked now takes until the motors are off, if its frames arrive."""
        return self._executor.worst_stop_s(now)

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
        if moves and command.sender.kind is not SenderKind.COORDINATOR:  # letting go hands the car to nobody
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
            case OneShot(frame):
                pending.frames.append(frame)
            case ChangeSpeed(step):
                pending.frames.append(General(Motion.STOP, speed=step))
            case Find():
                pending.frames.extend(frame for frame in self._blinks() if self.profile.refusal(frame) is None)
        self._waiting.acts.append(pending)
        return self._queued(pending, now)

    def _blinks(self) -> tuple[Frame, ...]:
        """The frames of `find`: the LED is at last what it will be after all that waits, also another `find`."""
        waiting = [each for act in self._waiting.acts for each in act.frames if isinstance(each, ColorLed)]
        led = waiting[-1] if waiting else self.believed.led
        other = ColorLed(255, 255, 255) if led != ColorLed(255, 255, 255) else ColorLed(0, 0, 0)
        whistle = General(Motion.STOP, whistle=True)
        return whistle, other, whistle, led

    def refused(self, command: Command, reason: Reason, words: str, now: float) -> Answer:
        """Record a command that was no command, as its parser says."""
        pending = Pending(command, now)
        if not command.streamed:
            self._ledger.record(pending, Phase.ASKED, now)
        return self._reject(pending, reason, words, now)

    def sender_alive(self, name: str, *, alive: bool, now: float) -> None:
        """A sender's liveliness token appeared or went."""
        driving = self._waiting.held is not None and self._waiting.held.sender.name == name
        if alive:
            self._senders.appeared(name)
        else:
            self._senders.vanished(name, now, driving=driving)
        if not driving:
            self.safety.holder_there(name, there=alive)

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
        self._executor.halt(words, now)
        if self.model.link_open and not self._executor.closing:
            self._executor.begin(self._executor.full(now), FrameOrigin.STOP, now)

    # ------------------------------------------------------------------ one by one

    def _stop(self, pending: Pending, now: float) -> Answer:
        command = pending.command
        sender, latched = command.sender, command.note
        if isinstance(command.what, EmergencyStop):
            estop = Estop(command.id, sender.name, command.what.why, command.asked_ns, command.what.fleet_wide)
            until = f"latched as {self.safety.latch(estop).id} until it is resumed"
            why = f": {estop.why}" if estop.why else ""
            self._ledger.log(Level.ERROR, "estop", f"{self.car}: e-stop by {sender.name}{why}; {until}", now)
            latched = f"{until}; {command.note}" if command.note else until
        elif sender.kind is not SenderKind.COORDINATOR:
            self.safety.held_by(sender.name, command.asked_ns)
        self._executor.halt(f"{command.verb} by {sender.name}", now, by=sender.name)
        if not self.model.link_open or self._executor.closing:
            why = "its gateway is ending" if self._executor.closing else self.model.link_reason
            words = f"{self.car} cannot be reached: {why}; it is stopped first when its link is back"
            return self._reject(pending, Reason.LINK_DOWN, f"{words} ({latched})" if latched else words, now)
        if not self.is_heard:
            silent = f"{self.car} was not heard for {self.mode.unheard_s(now):.0f} s: it may not get this stop"
            latched = f"{silent}; {latched}" if latched else silent
        worst = self.worst_stop_s(now)
        self._ledger.record(pending, Phase.QUEUED, now, words=latched, worst_case_s=worst)
        self._executor.begin(self._executor.full(now), FrameOrigin.STOP, now, pending)
        return Answer(Phase.QUEUED, words=latched, worst_case_s=worst)

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
        match command.what:
            case Drive(duration_s=lasts_s):
                pass
            case SetMode(mode):  # until it is in force: sooner nobody can tell whether it is wanted
                opening_s = 0.0 if mode is Mode.MANUAL else self.profile.block_s(ModeOpen(mode))
                lasts_s = max(self._executor.free_at(now) - now, 0.0) + opening_s
            case _:  # what is asked on the way does not shorten it
                lasts_s = (self.expires_in_s(now) or 0.0) if self.owner == sender.name else 0.0
        self.safety.grant(sender, now + lasts_s)
        if before is None or before.holder == sender:
            return
        words = f"taken over by {sender.name} ({sender.kind}) from {before.holder.name} ({before.holder.kind})"
        self._ledger.log(Level.INFO, "lease_taken", f"{self.car}: {words}", now)
        if (
            self._waiting.held is not None
            and self._waiting.held.sender != sender
            and not isinstance(command.what, Drive | SetMode)
        ):
            self._executor.release(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)

    def _take_lease(self, pending: Pending, now: float, *, release: bool) -> Answer:
        sender = pending.command.sender
        if not release:
            return self._done(pending, f"{self.car} is {sender.name}'s for {LEASE_S:g} s, and while it drives", now)
        if not self.safety.release(sender):
            return self._done(pending, f"{sender.name} had no lease of {self.car}", now)
        if self._waiting.held is not None and self._waiting.held.sender == sender:
            self._executor.release(Phase.COMPLETE, None, f"released by {sender.name}", now)
        return self._done(pending, f"{self.car} is free", now)

    def _too_busy(self, what: Action, now: float) -> str:
        """Why a drive would be over before it could begin; empty if it would not."""
        free_at = self._executor.free_at(now)
        if not isinstance(what, Drive) or what.motion is Motion.STOP or now + what.duration_s > free_at:
            return ""
        return f"{self.car} is busy for {free_at - now:.1f} s more, longer than this drive's {what.duration_s:g} s"

    def _drive(self, pending: Pending, drive: Drive, now: float) -> Answer:
        sender, held = pending.command.sender, self._waiting.held
        if held is not None and held.motion is drive.motion and held.sender == sender:
            return self._drive_on(held, pending, now + drive.duration_s, now)
        words = f"{drive.motion} by {sender.name}"
        self._waiting.close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._waiting.held = HeldMotion(drive.motion, pending, now + drive.duration_s)
        if held is not None and held.motion is drive.motion and held.pending.sent:
            self._ledger.sent(pending, now, "the motion is held on")
            return Answer(Phase.SENT, words="the motion is held on")
        running = self._executor.running
        if running is not None and running.recipe.rank == sequences.SOFT.rank:
            # The car is wanted to move again: the rest of a soft stop would only jerk it.
            self._executor.running = None
            for other in running.commands:
                self._ledger.record(other, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words=words)
        return self._queued(pending, now)

    def _drive_on(self, held: HeldMotion, pending: Pending, expires_at: float, now: float) -> Answer:
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
        self._waiting.close_held(Phase.COMPLETE, None, f"released by {sender}", now)
        self._waiting.close_opening(Phase.SUPERSEDED, Reason.SUPERSEDED, f"released by {sender}", now)
        if self._executor.running is None and self.at_rest:
            return self._done(pending, f"{self.car} is at rest", now)
        worst = self.worst_stop_s(now)
        if not pending.command.streamed:
            self._ledger.record(pending, Phase.QUEUED, now, worst_case_s=worst)
        self._executor.begin(
            self._executor.soft(now), FrameOrigin.STOP, now, None if pending.command.streamed else pending
        )
        return Answer(Phase.QUEUED, worst_case_s=worst)

    def _close_mode(self, pending: Pending, now: float) -> Answer:
        self._waiting.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, f"mode manual by {pending.command.sender.name}", now)
        answer = self._queued(pending, now)
        self._executor.begin(self._executor.full(now), FrameOrigin.COMMAND, now, pending)
        return answer

    def _set_mode(self, pending: Pending, mode: Mode, now: float) -> Answer:
        words = f"mode {mode} by {pending.command.sender.name}"
        self._waiting.close_opening(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._waiting.close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        settled = self.known and self._executor.running is None and self.mode.verdict is not Verdict.CONTRADICTED
        if settled and self.mode.asked is mode:
            return self._done(pending, f"{self.car} is in {mode} already ({self.mode.verdict})", now)
        self._waiting.opening = pending
        return self._queued(pending, now)

    # ------------------------------------------------------------------ answers

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

    def _situation(self, now: float) -> arbiter.CommandContext:
        return arbiter.CommandContext(
            car=self.car,
            profile=self.profile,
            now=now,
            link_open=self.model.link_open,
            link_reason=self.model.link_reason,
            answering=self.is_heard,
            closing=self._executor.closing,
            asked=self.asked,
            contradicted=self.mode.verdict is Verdict.CONTRADICTED,
            held_by=self.hold.by if self.hold else None,
            estops=self.safety.estops,
            ended=self.safety.ended,
            lease=self.safety.leased(now),
            battery=self.battery.refusal,
            fan=self.believed.fan,
            queued=len(self._waiting.acts),
            speed=self.believed.speed,
            speed_max=self._speed_max,
        )

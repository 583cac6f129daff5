"""Sends frames to one car: paces them, carries out stops until the car shows them, keeps what is queued. Pure.

`CarModel` holds what is believed of the car; `CarMonitor` tells the executor what readings show.
"""

from typing import Final

from gateway.control.car_model import CarModel
from gateway.control.command_log import CommandLog, Pending
from gateway.control.command_queue import CommandQueue, HeldMotion
from gateway.control.commands import Fan, Phase, Reason, SetMode
from gateway.control.estimate.trust import STOP_GOES_ON, Basis, CarTrust, TrustEvent
from gateway.control.events import FrameOrigin, Level, OutgoingFrame
from gateway.control.pacing import FLIGHT_S
from gateway.control.safety import Safety
from gateway.control.senders import Senders
from gateway.control.stops import sequences, stopping
from gateway.control.stops.evidence import CLOSED_S, EVIDENCE, Finding, StopCase
from gateway.control.stops.sequences import Gate, StopSequence
from gateway.control.stops.stopping import StopInProgress
from gateway.protocol.enums import Mode, Motion
from gateway.protocol.frames import Frame, General, ModeClose, ModeOpen, encode
from gateway.protocol.platforms import StopStyle

LATE_S: Final = 0.1
"""Report a drive as shortened if its frame goes out later than this; its duration counts from the request."""
SHUTDOWN_S: Final = 16.0
"""Maximum time that a gateway that ends waits for its car to show the stop."""
RENEW_S: Final = (2.2, 4.0, 6.0)
"""Intervals at which a rest that nothing has shown is sent again, by how often it was. A lost stop is made up for."""
UNKNOWN_PROBES: Final = 2
"""Maximum probes of a car of an unknown platform: a Raspberry Pi shows nothing of them."""
RESETTING_STEPS: Final = 1
"""Index of recovery's first `MODE00`, which is written before anything may take the place of the rest."""
GAP_S: Final = 1.5
"""Minimum time to the next try of a stop in which other frames may go out."""
CLEARING_RENEWALS: Final = 4
"""Maximum renewals by `MODE00` after a stop that an arduino could not show. A general stop does nothing to a car that
keeps half a named frame (docs/reference/protocol.md#hazards). `MODE00` beeps, so there are no more."""
_STOP: Final = General(Motion.STOP)


class Executor:
    """What waits for the car and how it gets there: one frame in flight, a stop ahead of everything."""

    def __init__(self, model: CarModel, ledger: CommandLog, safety: Safety) -> None:
        self.model = model
        self.safety = safety
        self.senders = Senders()
        self.waiting = CommandQueue(ledger, self.senders, safety)
        self.running: StopInProgress | None = None
        self.mode_sent: tuple[Pending, float] | None = None
        """A mode whose effect has not been seen yet, and when its frame went out."""
        self.left_at = self.left_until = float("-inf")
        """When the frame was written that leaves a mode, and when the car has left it at the latest."""
        self.not_stopped = ""
        """Why the gateway ends without a stop of the car; empty if it does not."""
        self.closing = False
        self._ledger = ledger
        self._source: StopInProgress | HeldMotion | Pending | None = None
        """Whose frame `poll` returned last; None for a repetition."""
        self._closing_until = float("inf")
        self._renewals = 0
        self._renew_at = float("inf")
        self._general_stop_follows = False
        """The last renewal was a `MODE00`, which a Raspberry Pi ignores: a general stop follows, alone."""
        self._left_mode = False
        """The last stop left a mode, in which a general stop is ignored."""

    # ------------------------------------------------------------------ the link

    def link_up(self, now: float) -> None:
        """Bring the car to a known state: the link is open."""
        model = self.model
        model.link_open = True
        model.evidence.begin_link()
        model.pacing.reset()
        model.learn(TrustEvent.LINK_OPENED, now)
        self._begin_recovery(FrameOrigin.RECOVERY, now, [])

    def link_down(self, reason: str, now: float, *, cause: Reason) -> None:
        """Fail all that waits: the link is gone, and the car may do anything."""
        model = self.model
        model.link_open = False
        model.link_reason = reason
        model.believed.repeat = False
        model.learn(TrustEvent.LINK_LOST, now, reason)
        self.mode_sent = self._source = None
        self._renew_at = float("inf")
        running, self.running = self.running, None
        for pending in running.commands if running else ():
            self._ledger.record(pending, Phase.FAILED, now, reason=cause, words=reason)
        if self.closing and running is not None:
            self._end_unstopped(f"cannot be reached ({reason})", now)
        self.waiting.drop(Phase.FAILED, cause, reason, now)
        model.mode.forget()
        model.believed.fan = None

    # ------------------------------------------------------------------ frames out

    @property
    def accepts(self) -> bool:
        """Return True if the car may be sent what is no stop, as far as its state goes."""
        state = self.model.trust.state
        if state is CarTrust.STOPPING:
            return self.running is None  # a drive took the place of a soft stop
        return state in (CarTrust.STOPPED, CarTrust.DRIVING, CarTrust.IN_MODE, CarTrust.UNPROVEN)

    def poll(self, now: float) -> OutgoingFrame | None:
        """Return the frame to write now, if any."""
        if not self.model.link_open:
            return None
        self._expire(now)
        running = self.running
        if running is not None and self.closing and now >= self._closing_until:
            self._give_up(running, now)
            return None
        if running is not None:
            self._fail_late(running, now)
            write = self._step(running, now)
            if write is not None or (self.running is not None and not self._leaves_gap(self.running, now)):
                return write
        if not self.accepts:
            return self._toggle_fan(now)
        return self._next_command(now)

    def _leaves_gap(self, running: StopInProgress, now: float) -> bool:
        """Return True if other frames may go out between two tries of a stop that the car does not show."""
        return running.overdue and running.frames_sent and running.next_try_at > now + GAP_S

    def _toggle_fan(self, now: float) -> OutgoingFrame | None:
        """Send the fan's toggle to a car that is silent: the fan may be why."""
        acts = self.waiting.acts
        if self.model.trust.state is not CarTrust.UNHEARD or not acts or not isinstance(acts[0].command.what, Fan):
            return None
        running = self.running
        if now < self.ready_at or (running is not None and not running.frames_sent):
            return None
        return self._write(acts[0].frames[0], FrameOrigin.COMMAND, acts[0], acts[0])

    def _next_command(self, now: float) -> OutgoingFrame | None:
        model, waiting = self.model, self.waiting
        if now < self.ready_at:
            return None
        held = waiting.held
        if held is not None and not held.pending.sent:
            self._give_way(now)
            return self._write(General(held.motion), FrameOrigin.COMMAND, held, held.pending)
        if waiting.opening is not None and not (waiting.acts and model.at_rest) and self.running is None:
            return self._open_mode(waiting.opening, now)
        if waiting.acts and now >= model.pacing.act_at(waiting.acts[0].frames[0]):
            pending = waiting.acts[0]  # asked before the mode, in which the car would ignore it
            return self._write(model.believed.with_motion(pending.frames[0]), FrameOrigin.COMMAND, pending, pending)
        if model.believed.repeat and now >= model.pacing.repeat_at:
            return self._write(General(model.believed.motion), FrameOrigin.REPEAT, None, held.pending if held else None)
        return self._renew(now)

    def _give_way(self, now: float) -> None:
        """End the tries of a stop that the car does not show: somebody drives it all the same."""
        running, self.running = self.running, None
        words = f"{self.model.name} was driven before it showed that it stopped"
        for pending in running.commands if running is not None else ():
            self._ledger.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=words)

    def _renew(self, now: float) -> OutgoingFrame | None:
        """Send the stop of a car at rest again if nothing has shown it: the frames may have been lost."""
        model = self.model
        if now < self._renewal_at or not model.at_rest or model.trust.shown or self.running is not None:
            return None
        if self._general_stop_follows:
            self._general_stop_follows = False
            return self._write(_STOP, FrameOrigin.REPEAT, None, None)
        if model.rest is StopCase.FAN and self._left_mode:
            self._schedule_renewal(now)
            return self._begin_now(self.full(now), FrameOrigin.REPEAT, now)
        clears = self._renewal_clears()
        self._schedule_renewal(now)
        self._general_stop_follows = clears
        return self._write(ModeClose() if clears else _STOP, FrameOrigin.REPEAT, None, None)

    @property
    def _renewal_at(self) -> float:
        """Return when the next frame of a renewal is due."""
        if self._general_stop_follows:
            return self.model.pacing.written_at + sequences.REPEAT_S
        # In one string behind a servo frame `MODE00` would open a mode: its digits are read out of that frame.
        return max(self._renew_at, self.model.pacing.ready_at(Gate.ALONE)) if self._renewal_clears() else self._renew_at

    def _renewal_clears(self) -> bool:
        """Return True if the next renewal is a `MODE00`."""
        return self.model.rest in (StopCase.NO_ECHO, StopCase.UNKNOWN_PLATFORM) and self._renewals <= CLEARING_RENEWALS

    def _schedule_renewal(self, now: float) -> None:
        self._renew_at = now + RENEW_S[min(self._renewals, len(RENEW_S) - 1)]
        self._renewals += 1

    def wrote(self, write: OutgoingFrame, now: float) -> None:
        """Note that the frame that `poll` returned was handed to the link."""
        source, self._source = self._source, None
        model, frame = self.model, write.frame
        if isinstance(frame, ModeClose):
            if not model.manual:
                # A turn of the mode that is left may be deaf for longer than the closing takes.
                deaf_until = max(now, model.pacing.block_until) + model.for_stop(now).turn_s
                self.left_at, self.left_until = now, deaf_until + model.profile.block_s(frame) + FLIGHT_S
            model.evidence.closed(now, awake=model.is_awake(now))
        model.pacing.wrote(frame, now)
        self._note_frame(frame, now)
        match source:
            case StopInProgress():
                self._stepped(source, now)
            case HeldMotion():
                source.began_at = now
                self._ledger.sent(source.pending, now)
            case Pending() if source is self.waiting.opening:
                self.waiting.opening = None
                self.mode_sent = (source, now)
                self._ledger.sent(source, now)
            case Pending():
                source.frames.popleft()
                if not source.frames:
                    self._ledger.sent(source, now)
                    if self.waiting.acts and self.waiting.acts[0] is source:
                        self.waiting.acts.popleft()
            case None:
                model.believed.repeat = False

    def next_at(self, now: float) -> float:
        """Return when `poll` may have something to do if nothing happens before; inf if never."""
        model = self.model
        if not model.link_open:
            return float("inf")
        times = self.waiting.deadlines()
        running = self.running
        if running is not None:
            times.extend(self._running_times(running, now))
        if self.accepts and (running is None or self._leaves_gap(running, now)):
            times.extend(self._command_times(now))
        elif self.waiting.acts and model.trust.state is CarTrust.UNHEARD:
            times.append(max(self.ready_at, now + FLIGHT_S))
        return max(now, min(times, default=float("inf")))

    def _running_times(self, running: StopInProgress, now: float) -> list[float]:
        times = [running.due_at(self.model.pacing)] if not running.frames_sent else self._waiting_times(running, now)
        times += [pending.asked_at + running.patience_s for pending in running.commands]
        if not running.overdue:
            times.append(running.gives_up_at)
        if self.closing:
            times.append(self._closing_until)
        return times

    def _waiting_times(self, running: StopInProgress, now: float) -> list[float]:
        times = [max(running.next_try_at, self.model.pacing.flight_until)]
        if running.obeyed_at > now:
            times.append(running.obeyed_at)
        return times

    def _command_times(self, now: float) -> list[float]:
        model, waiting, times = self.model, self.waiting, []
        if waiting.acts:
            times.append(max(model.pacing.act_at(waiting.acts[0].frames[0]), self.left_until))
        if waiting.held is not None and not waiting.held.pending.sent:
            times.append(self.ready_at)
        if waiting.opening is not None and self.running is None:
            times.append(max(model.pacing.open_at(now), self.left_until) if model.rest_is_sure else self.ready_at)
        if model.believed.repeat:
            times.append(max(model.pacing.repeat_at, self.left_until))
        if model.at_rest and not model.trust.shown and self.running is None and waiting.opening is None:
            times.append(max(self._renewal_at, self.ready_at))
        return times

    def _write(
        self, frame: Frame, why: FrameOrigin, source: StopInProgress | HeldMotion | Pending | None, by: Pending | None
    ) -> OutgoingFrame:
        self._source = source
        return OutgoingFrame(frame, encode(frame), why, by.command.id if by is not None else "")

    def _open_mode(self, pending: Pending, now: float) -> OutgoingFrame | None:
        """Open a mode, from a sure rest only: opening while driving leaves the motors as they were, blind."""
        assert isinstance(pending.command.what, SetMode)
        if not self.model.rest_is_sure:
            return self._begin_now(self.full(now), FrameOrigin.STOP, now)
        if now < self.model.pacing.open_at(now):
            return None
        return self._write(ModeOpen(pending.command.what.mode), FrameOrigin.COMMAND, pending, pending)

    def _note_frame(self, frame: Frame, now: float) -> None:
        """Note what a written frame does to what is believed of the car."""
        model = self.model
        shown = model.trust.shown
        model.believed.wrote(frame, now)
        block_s = model.profile.block_s(frame)
        match frame:
            case ModeOpen(mode):
                self.mode_sent = None
                model.mode.ask(mode, now=now, block_s=block_s)
                model.evidence.opened(mode, now, silent=mode in model.profile.silent_modes, shown=shown)
                self._moves(TrustEvent.MODE_SENT, now)
            case ModeClose():
                if self.mode_sent is not None and self.mode_sent[0].command.what != SetMode(Mode.MANUAL):
                    self.mode_sent = None
                model.mode.ask(Mode.MANUAL, now=now, block_s=block_s)
            case _:
                model.mode.wrote(block_s, now=now)
                if isinstance(frame, General) and frame.motion is not Motion.STOP:
                    model.evidence.sent_motion()
                    self._moves(TrustEvent.MOTION_SENT, now)
                else:
                    model.evidence.sent_other()
                if shown and frame != _STOP and model.trust.shown:
                    self._doubt_rest(now)
        if model.profile.stop_style is StopStyle.RASPBERRY_PI and model.mode.asked is None:
            model.mode.ask(Mode.MANUAL, now=now, block_s=block_s)

    def _doubt_rest(self, now: float) -> None:
        """Rest on what was sent from now on: half of a named frame is read as a motion.

        See docs/reference/protocol.md#hazards.
        """
        self.model.rest = StopCase.ACTED
        words = EVIDENCE[StopCase.ACTED].words.format(car=self.model.name)
        self.model.learn(TrustEvent.STOP_SENT, now, words)
        self._schedule_renewal(now)

    def _moves(self, event: TrustEvent, now: float) -> None:
        self._renewals, self._renew_at = 0, float("inf")
        self.model.learn(event, now)

    # ------------------------------------------------------------------ stops

    def worst_stop_s(self, now: float) -> float:
        """Return the longest that a stop asked now takes until the motors are off, if its frames arrive."""
        recipe, running = self.full(now), self.running
        if running is not None and running.recipe.rank >= recipe.rank:
            return running.worst_s(now)
        return stopping.worst_s(recipe, self.model.for_stop(now), self.model.pacing, now)

    def shutdown(self, now: float) -> None:
        """Stop the car and accept nothing else: the gateway ends."""
        if self.closing:
            return
        self.closing = True
        self._closing_until = now + SHUTDOWN_S
        self.waiting.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, "the gateway is ending", now)
        if not self.model.link_open:
            self._end_unstopped(f"cannot be reached ({self.model.link_reason})", now)
        elif not (self.model.at_rest and self.model.trust.shown) or self.running is not None:
            self.begin(self.full(now), FrameOrigin.SHUTDOWN, now)

    @property
    def finished(self) -> bool:
        """Return True after `shutdown` if the stop is over, or the car did not show it in time."""
        return self.closing and self.running is None

    def _end_unstopped(self, why: str, now: float) -> None:
        """Say that the gateway ends and the car may drive on."""
        car = self.model.name
        self.not_stopped = why
        self._ledger.log(Level.ERROR, "not_stopped", f"{car} may still be moving: {car} {why}. Look at it.", now)

    def _give_up(self, running: StopInProgress, now: float) -> None:
        """End without a stop that the car showed."""
        self.running = None
        self._end_unstopped("did not show that it stopped", now)
        for pending in running.commands:
            self._ledger.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=self.not_stopped)

    def halt(self, words: str, now: float, by: str = "") -> None:
        """Drop all queued commands. Ignore a continuous drive stream until its sender pauses."""
        self.waiting.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self.safety.driven_no_more(now)
        self.senders.halt(now, by)

    def soft(self, now: float) -> StopSequence:
        """Return the stop of a drive's end."""
        return stopping.soft(self.model.for_stop(now))

    def full(self, now: float) -> StopSequence:
        """Return the stop that `stop`, `estop` and a shutdown send."""
        return stopping.full(self.model.for_stop(now))

    def begin(self, recipe: StopSequence, why: FrameOrigin, now: float, pending: Pending | None = None) -> None:
        """Carry out a stop, or join the one that runs if that is no weaker."""
        model = self.model
        model.believed.repeat = False
        joining = [pending] if pending is not None else []
        running = self.running
        if running is None or running.recipe.rank < recipe.rank or running.at_rest:
            self._start(recipe, why, now, [*(running.commands if running is not None else ()), *joining])
            return
        running.commands.extend(joining)
        if why is FrameOrigin.SHUTDOWN:
            running.why = why
        # Whoever asks for a stop need not wait for the next try, but silence makes that certain.
        if pending is not None and running.frames_sent and now >= running.closed_at + sequences.SILENCE_S:
            running.again(self.full(now), now)
        if running.first_at is not None and pending is not None:
            self._ledger.sent(pending, now, f"joined the {running.recipe.name} stop under way")

    def stop_again(self, now: float) -> None:
        """Send general stops to a car that had shown that it stands, and is silent now."""
        self._start(self.soft(now), FrameOrigin.RECOVERY, now, [])
        assert self.running is not None
        self.running.at_rest = True

    def _begin_now(self, recipe: StopSequence, why: FrameOrigin, now: float) -> OutgoingFrame | None:
        """Begin a stop. Return its first frame, if that may be written now."""
        self.begin(recipe, why, now)
        assert self.running is not None
        return self._step(self.running, now)

    def heard_again(self, now: float, words: str) -> None:
        """Stop a car that is heard again: what was written meanwhile may be lost, or come all at once."""
        running = self.running
        if running is not None and running.at_rest:
            self.recover(now, words)
        elif running is not None:
            self._try_again(running, now)

    def recover(self, now: float, words: str) -> None:
        """Bring the car to a known state, whatever runs. Commands that wait for a stop wait for this one."""
        before = self.running
        why, commands = (before.why, before.commands) if before is not None else (FrameOrigin.RECOVERY, [])
        self.model.learn(TrustEvent.DOUBTED, now, words)
        self._begin_recovery(why, now, commands)

    def _begin_recovery(self, why: FrameOrigin, now: float, commands: list[Pending]) -> None:
        self._start(stopping.recovery(self.model.for_stop(now)), why, now, commands)

    def _start(self, recipe: StopSequence, why: FrameOrigin, now: float, commands: list[Pending]) -> None:
        model = self.model
        worst_s = stopping.worst_s(recipe, model.for_stop(now), model.pacing, now)
        patience_s = min(worst_s, stopping.LONGEST_WORST_S) + stopping.SHOW_S
        self.running = StopInProgress(
            recipe, why, now, now, commands, worst_at=now + worst_s, patience_s=patience_s, case=self._case(recipe)
        )
        model.learn(TrustEvent.STOP_BEGUN, now, f"{recipe.name} stop ({why})")

    def _case(self, recipe: StopSequence) -> StopCase:
        """Return what this stop rests on if nothing shows it."""
        model = self.model
        if model.for_stop_style is StopStyle.RASPBERRY_PI:
            return StopCase.RASPBERRY_PI
        if recipe.rank == sequences.SOFT.rank:
            return StopCase.SOFT
        if model.for_stop_style is StopStyle.UNKNOWN:
            return StopCase.UNKNOWN_PLATFORM
        return StopCase.MANUAL

    def _step(self, running: StopInProgress, now: float) -> OutgoingFrame | None:
        if running.frames_sent:
            self._await(running, now)
            if self.running is not running or running.frames_sent:
                return None
        if now < running.due_at(self.model.pacing):
            return None
        return self._write(running.frame, running.why, running, running.commands[0] if running.commands else None)

    def _stepped(self, running: StopInProgress, now: float) -> None:
        if running.stepped(now):
            for pending in running.commands:
                self._ledger.sent(pending, now)
                if isinstance(pending.command.what, SetMode):
                    self.mode_sent = (pending, now)

    def found(self, finding: Finding, at: float, now: float) -> None:
        """Take what a reading of mode 0 showed of the stop that runs."""
        running = self.running
        if running is None or running.first_at is None:
            return
        if finding is not Finding.NOTHING and at > running.closed_at + FLIGHT_S and at > running.first_at + FLIGHT_S:
            running.report_at = at
        match finding:
            case Finding.SHOWN:
                self._finish(running, Basis.SHOWN, self.model.evidence.words, now)
            case Finding.NO_ECHO if at > running.closed_at + CLOSED_S:
                running.without_echo += 1
                if max(running.without_echo, self.model.evidence.without_echo) >= 2:
                    running.no_echo_at = at
            case Finding.LOST:
                self._lost(running, now)
            case _:
                pass
        if self.running is running and running.frames_sent:
            self._await(running, now)
        if self.running is running and finding in (Finding.REPORT, Finding.PAUSE) and self._may_probe(running):
            running.probes += 1
            running.again(sequences.PROBE, now)

    def _may_probe(self, running: StopInProgress) -> bool:
        """Return True if a `MODE00` now would show something: not to a car that may not know that frame."""
        if running.case is StopCase.SOFT or running.case is StopCase.RASPBERRY_PI:
            return False
        if running.case is StopCase.UNKNOWN_PLATFORM:
            return running.frames_sent and running.probes < UNKNOWN_PROBES
        # First the `#` that ends half a frame: `MODE00` behind one would open a mode.
        return running.recipe is not sequences.RECOVERY or running.index > RESETTING_STEPS

    def _lost(self, running: StopInProgress, now: float) -> None:
        """Send the stop again: the reports came on as before. A Raspberry Pi does the same."""
        running.probes += 1
        unknown = running.case is StopCase.UNKNOWN_PLATFORM
        if not unknown and running.tries == 1 and (running.frames_sent or running.recipe is sequences.PROBE):
            self._try_again(running, now)

    def _try_again(self, running: StopInProgress, now: float) -> None:
        running.tries += 1
        situation = self.model.for_stop(now)
        running.again(stopping.soft(situation) if running.at_rest else stopping.recovery(situation), now)
        self.model.evidence.tried_again()

    def _await(self, running: StopInProgress, now: float) -> None:
        """Wait for evidence: end a stop that can show nothing, send one again that could have."""
        case = self._ends_as_sent(running, now)
        if case is not None:
            self._finish(running, Basis.SENT, EVIDENCE[case].words.format(car=self.model.name), now, case)
            return
        if now >= max(running.next_try_at, self.model.pacing.flight_until):
            self._try_again(running, now)

    def _ends_as_sent(self, running: StopInProgress, now: float) -> StopCase | None:
        """Return why the stop ends without evidence; None if the car may still show it."""
        model = self.model
        if running.at_rest or model.trust.state is CarTrust.UNHEARD:
            return None
        reported = running.report_at > running.last_at
        over = now >= running.obeyed_at
        if not running.frames_sent or not (over or reported):
            return None
        if running.case is StopCase.SOFT:
            return StopCase.SOFT if over else None
        if running.case is StopCase.RASPBERRY_PI:
            heard = running.report_at > running.try_at or running.recipe.rank == sequences.SOFT.rank
            return StopCase.RASPBERRY_PI if over and heard else None
        if over and model.believed.fan and model.profile.fan_silences:
            return StopCase.FAN
        if running.no_echo_at > running.closed_at:
            return StopCase.NO_ECHO
        if running.case is StopCase.UNKNOWN_PLATFORM and reported and running.probes >= UNKNOWN_PROBES:
            return StopCase.UNKNOWN_PLATFORM
        return None

    def _fail_late(self, running: StopInProgress, now: float) -> None:
        """Fail the commands that have waited too long for evidence. The stop goes on."""
        car = self.model.name
        words = f"{car} has not shown that it stopped. The gateway goes on stopping it. Look whether it moves."
        waiting: list[Pending] = []
        for pending in running.commands:
            if now < pending.asked_at + running.patience_s:
                waiting.append(pending)
            else:
                self._ledger.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=words)
        running.commands[:] = waiting
        if now >= running.gives_up_at and not running.overdue:
            running.overdue = True
            if self.model.mode.heard_at > running.began_at:
                self.model.learn(TrustEvent.NOT_SHOWN, now)
                self._ledger.log(Level.ERROR, "not_shown", words, now)
            elif self.model.trust.state is not CarTrust.UNHEARD:
                words = f"{car} was not heard since the stop began. The gateway goes on stopping it."
                self.model.learn(TrustEvent.SILENT, now, words)
                self._ledger.log(Level.WARNING, "unheard", words, now)

    def _finish(
        self, running: StopInProgress, basis: Basis, words: str, now: float, case: StopCase = StopCase.MANUAL
    ) -> None:
        """End the stop: the car showed it, or can show nothing."""
        model = self.model
        self.running = None
        recovered = model.trust.state in STOP_GOES_ON and not model.known
        model.rest = case
        self._left_mode = self.left_at >= running.began_at
        model.learn(TrustEvent.STOP_SHOWN if basis is Basis.SHOWN else TrustEvent.STOP_SENT, now, words)
        if recovered:
            how = "shown" if basis is Basis.SHOWN else f"sent: {words}"
            known = f"{model.name} is in a known state: stopped ({how}), mode manual"
            self._ledger.log(Level.INFO, "recovered", known, now)
        if basis is Basis.SENT:
            self._renewals, self._general_stop_follows = 0, False
            self._schedule_renewal(now)
        phase = Phase.COMPLETE if basis is Basis.SHOWN else Phase.SENT
        evidence = (words,) if basis is Basis.SHOWN else ()
        for pending in running.commands:
            if not isinstance(pending.command.what, SetMode):
                said = "" if basis is Basis.SHOWN else words
                self._ledger.record(pending, phase, now, words=said, evidence=evidence, basis=basis)

    # ------------------------------------------------------------------ time

    def _expire(self, now: float) -> None:
        held = self.waiting.held
        if held is not None and now >= self.waiting.held_until:
            if now < held.expires_at:
                self.safety.holder_there(held.sender.name, there=False)
                self.release(Phase.EXPIRED, Reason.EXPIRED, f"its sender {held.sender.name} is gone", now)
            elif held.pending.sent:
                words = "its time is over"
                if held.began_at is not None and held.began_at > held.pending.asked_at + LATE_S:
                    words += (
                        f", of which {self.model.name} was driven for {now - held.began_at:.2f} s: it was busy before"
                    )
                self.release(Phase.COMPLETE, None, words, now)
            else:
                self.release(Phase.EXPIRED, Reason.EXPIRED, f"{self.model.name} was busy until its time was over", now)
        self.waiting.give_up_old(now)

    def release(self, phase: Phase, reason: Reason | None, words: str, now: float) -> None:
        """End the held motion with a soft stop, unless the car stands and never got it."""
        evidence = self.model.evidence
        deaf = self.model.can_show and evidence.obeyed_at is None and not evidence.without_echo
        if phase is Phase.COMPLETE and deaf:
            words += f"; nothing shows that {self.model.name} moved: it has not reacted to any frame on this link"
            self.waiting.close_held(Phase.SENT, reason, words, now, Basis.SENT)
        else:
            self.waiting.close_held(phase, reason, words, now)
        if self.model.link_open and self.running is None and not self.model.at_rest:
            self.begin(self.soft(now), FrameOrigin.STOP, now)

    @property
    def ready_at(self) -> float:
        """Return from when on a frame that is no stop's may be written."""
        return max(self.model.pacing.flight_until, self.left_until)

    def free_at(self, now: float) -> float:
        """Return when the car can take a motion, as far as that is known."""
        running = self.running
        if running is None or running.overdue or running.recipe.rank == sequences.SOFT.rank:
            return self.ready_at
        return max(running.over_at(self.model.pacing, now), self.ready_at)

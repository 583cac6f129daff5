"""Chooses the next frame for one car: `Executor.poll` is asked whenever something could be written. Pure.

Three others are asked: `StopExecutor` knows which frames a stop needs, `CommandQueue` has the commands that wait, and
`Pacing` knows when the car can take a frame. What is left for this module is the order, and that is the difficult part,
because the car does one thing at a time and loses what comes too early.

*Stops.* The first frames of a stop go before everything else, because people stand beside the car. If the car then has
to show that it stands, the stop goes on for seconds: it waits for reports, and is sent again. A person who has stopped
a car and wants to drive it must not wait for all that. So from `accepts_commands` on, a command that is newer than the
stop takes the place of its further tries (`_may_overtake`). The end of a drive (a soft stop) gives way even earlier,
because the frame of any command ends the old motion, too.

*Commands.* Of the commands that wait, a drive goes first, then a mode, then the actions on parts of the car, such as
colors. There is one exception: if the car is at rest, actions that were queued before a mode go before it, because a
car in a mode ignores them. Only if no command waits, a motion is repeated, or a stop that nothing has shown is renewed.

*Actions that wait.* One action is usually written at once, even during a stop. But a program that sends a color every
0.3 s would put off the repeats of a lost stop for ever. Its blocks would also excuse the silence of a car that is gone,
and would change the times of the reports that show a stop. So `_actions_wait` holds actions back. After `FREE_ACTIONS`
of them, the next ones wait for a stop (`_stop_goes_first`), and for the report that shows that the car is still there
(`_is_listening`). If they have held up the renewal of a stop, they wait for it (`_renewal_goes_first`). And even a
single color waits for the end of a drive (`_soft_stop_goes_first`), because a car that reads it in one string with the
stop ignores the stop.

*Steps of the speed.* A car that may be too fast for `speed_max` first gets steps of its speed, and each of them must be
read alone: a lost step would let the car drive too fast. So the drive waits for them (`_drive_at`).

`next_at` tells the loop when `poll` may have something to do. It follows the same order, and a change of one is a
change of both.
"""

from collections import deque
from typing import Final

from gateway.control.command_queue import HeldMotion
from gateway.control.command_records import Pending
from gateway.control.commands import ChangeSpeed, Fan, SetMode
from gateway.control.control_output import OutgoingFrame
from gateway.control.driver import TICK_S, Desk, Driver
from gateway.control.trust import TrustEvent
from gateway.drivers.yahboom.car_model import CarModel
from gateway.drivers.yahboom.estimate.learned import blocking_kind
from gateway.drivers.yahboom.estimate.outputs import Speeds, share_of, stepped
from gateway.drivers.yahboom.pacing import AWAKE_WAIT_S, FLIGHT_S, Gate
from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, General, ModeClose, ModeOpen
from gateway.drivers.yahboom.protocol.platforms import StopStyle
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stop_executor import StopExecutor
from gateway.drivers.yahboom.stops import cases
from gateway.drivers.yahboom.stops.sequences import SOFT, STOP_FRAME, StopSequence
from gateway.drivers.yahboom.stops.stop_in_progress import StopInProgress
from schemas.words import FrameOrigin, Mode, Motion, Phase, Platform, Reason, SpeedStep, Verdict

FREE_ACTIONS: Final = 3
"""Number of actions on parts of the car that are written at once. In a stream of more, the next ones may have to
wait."""
LISTEN_LIMITS: Final = 2.0
"""A stream of actions waits for a report if none has come for this many times the silence that contradicts the mode."""
NOTICE_S: Final = 2 * TICK_S
"""Maximum time until a silence is noticed: two ticks, because the ticks of a busy gateway come late."""
STEPS_KEPT: Final = 20
"""Number of steps of the speed that are remembered. From any speed to any other, no car needs more."""
NO_REPEAT_S: Final = 2 * FLIGHT_S
"""Time before the end of a drive in which its motion is not repeated. An stm32 car needs 43 ms to send a
report. If the repeated motion and the stop after it arrive in that time, the car loses the stop."""


class Executor(Driver):
    """The queued commands, the stop in progress, and the one frame in flight."""

    def __init__(self, desk: Desk, model: CarModel) -> None:
        super().__init__(desk)
        self._model = model
        self.stops = StopExecutor(model, desk.log)
        self.mode_sent: tuple[Pending, float] | None = None
        """A mode command whose effect was not seen yet, and the time of its frame."""
        self._source: StopInProgress | HeldMotion | Pending | None = None
        """The stop, motion or command of the frame that `poll` last returned. None for a repetition."""
        self._action_times: deque[float] = deque(maxlen=FREE_ACTIONS)
        """When the first frames of the last actions on parts of the car were written."""
        self._must_not_join_at = float("-inf")
        """When a frame was last written that the next action must not join in the car's buffer: another action, a
        repeated motion, or a renewed stop."""
        self._steps_written: deque[tuple[float, Speeds]] = deque(maxlen=STEPS_KEPT)
        """When the last steps of the speed were written, and the speeds before them."""
        self._in_write: Frame | None = None
        """The frame that `poll` last returned, until `on_written`."""

    @property
    def model(self) -> CarModel:
        """The claims about the car."""
        return self._model

    # ------------------------------------------------------------------ the link

    def link_up(self, now: float) -> None:
        """Begin to bring the car to a known state, because the link is open."""
        model = self.model
        model.link_open = True
        model.missed_stop = False
        model.link_since = now
        model.believed.allow_restart()
        model.evidence.begin_link()
        model.pacing.reset()
        self.senders.halt_streams(now)
        model.update_trust(TrustEvent.LINK_OPENED, now)
        self.stops.begin_recovery(FrameOrigin.RECOVERY, now, [])

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail all commands, because the link is down and the state of the car is unknown."""
        model = self.model
        model.link_open = False
        model.link_reason = reason
        model.believed.repeat = False
        model.update_trust(TrustEvent.LINK_LOST, now, reason)
        self.allow_for_lost_steps(model.mode.heard_at)
        self.mode_sent = self._source = None
        self.senders.halt_streams(now)  # a press from before the loss must not drive the car after it
        self.stops.link_down(reason, now, cause=cause)
        self.queue.drop(Phase.FAILED, cause, reason, now)
        model.mode.forget()
        model.believed.fan, model.believed.fan_toggled = None, False

    # ------------------------------------------------------------------ frames out

    def accepts_commands(self, now: float) -> bool:
        """Return True if a command's frame may be written: no stop is in progress, or a new command may replace it.

        A single command waits only for the first frames of a stop, until their worst case is over. It does not wait for
        evidence. `_stop_goes_first` says for what a stream of actions waits.
        """
        running = self.stops.running
        if running is None:
            return True
        if self.stops.shutting_down:
            return False
        # A soft stop (at the end of a drive) may be replaced after its first frame, because the frame of any command
        # ends the old motion just as the second frame would.
        is_soft = running.sequence.rank == SOFT.rank and running.index > 0
        return is_soft or now >= running.gives_way_at

    def poll(self, now: float) -> OutgoingFrame | None:
        """Return the frame to write now, if any."""
        if not self.model.link_open:
            return None
        self.expire(now)
        stops = self.stops
        running = stops.running
        if running is not None and stops.is_shutdown_timed_out(now):
            stops.give_up(running, now)
            return None
        if running is not None:
            stops.settle(running, now)
            if stops.running is running:
                stops.fail_late(running, now)
            if stops.running is not running:
                return None
            # A new command goes before the repeats of a stop, but never before its first frames. While the command
            # waits for the car, do not begin a repeat, which would block the car again.
            if not (self._has_new_command(now) and self.accepts_commands(now)):
                return self._next_step(running, now)
        return self._next_command(now)

    def _next_step(self, running: StopInProgress, now: float) -> OutgoingFrame | None:
        """Return the next frame of a stop if it is due. This may end the stop instead, or begin its next try."""
        self.stops.check_evidence(running, now)
        if self.stops.running is not running or running.try_sent or now < running.due_at(self.model.pacing):
            return None
        # The color frame that clears a string uses the last color, even if somebody has set it during this stop.
        frame = self.model.believed.led if isinstance(running.frame, ColorLed) else running.frame
        return self._prepare(frame, running.why, running, running.commands[0] if running.commands else None)

    def _next_command(self, now: float) -> OutgoingFrame | None:
        """Return the next frame that belongs to no stop in progress: of a command, or a repeat."""
        model, queue = self.model, self.queue
        if now < model.ready_at:
            return None
        held = queue.held
        if held is not None and not held.pending.sent and self._may_overtake(held.pending):
            return self._next_of_drive(held, now)
        if (change := self._next_mode) is not None:
            return self._open_mode(change, now)
        pending = None if self._actions_wait(now) else queue.next_part_action(now)
        if pending is not None and now >= self._act_at(pending) and self._may_overtake(pending):
            what = pending.command.what  # a drive may have lowered the speed since a step was accepted
            if isinstance(what, ChangeSpeed) and (words := self.too_fast(what.step, model.believed.speeds)):
                queue.reject_part_action(pending, Reason.UNSUPPORTED, words, now)
                return None
            frame = model.believed.with_motion(pending.next_frame)
            return self._prepare(frame, FrameOrigin.COMMAND, pending, pending)
        if self.stops.running is not None:
            return None
        if self._repeats(now) and now >= model.pacing.repeat_at:
            return self._prepare(
                General(model.believed.motion), FrameOrigin.REPEAT, None, held.pending if held else None
            )
        return self._renew_stop(now)

    def too_fast(self, step: SpeedStep, speeds: Speeds) -> str | None:
        """Return why this step would make a car with one of these speeds too fast, or None if it would not."""
        car, kind, maximum = self.desk.car, self.model.profile.kind, self.desk.speed_max
        share = share_of(stepped(speeds, step), kind)
        if share <= max(maximum, share_of(speeds, kind)):
            return None
        return f"{car} would drive at about {share:.0%} of full speed. Its maximum is {maximum:.0%} (speed_max)."

    def _next_of_drive(self, held: HeldMotion, now: float) -> OutgoingFrame | None:
        """Return the next step of the speed that the drive needs, or the motion, if that may be written now."""
        if now < self._drive_at:
            return None
        frame = General(held.motion)
        if self._is_too_fast:
            steps = self.steps_before_drive
            if not steps:  # the platform was detected since the drive was accepted
                self.release(Phase.REJECTED, Reason.UNSUPPORTED, self.refusal(held.pending.command.what) or "", now)
                return None
            frame = General(Motion.STOP, speed=steps[0])
        self.stops.give_way(now)
        return self._prepare(frame, FrameOrigin.COMMAND, held, held.pending)

    @property
    def _is_too_fast(self) -> bool:
        """Return True if the car may be faster than it is allowed to drive. So steps of the speed go before a drive."""
        return self.model.believed.share > self.desk.speed_max

    @property
    def _drive_at(self) -> float:
        """Return the earliest time for the next frame of the waiting drive.

        A step of the speed before a drive, and the frame after it, wait until the car has read the frame before it. Of
        two frames in its buffer, the car may ignore one, and a lost step would let it drive too fast.
        """
        ready_at, buffer_until = self.model.ready_at, self.model.pacing.buffer_until
        return max(ready_at, buffer_until) if self._is_too_fast or self._must_not_lose_step else ready_at

    @property
    def _speeds_before_step(self) -> Speeds | None:
        """The speeds before the last frame, if that was a step of the speed."""
        if not self._steps_written or self._steps_written[-1][0] != self.model.pacing.written_at:
            return None
        return self._steps_written[-1][1]

    @property
    def _must_not_lose_step(self) -> bool:
        """Return True if the last frame was a step of the speed without which the car may be too fast."""
        # Any other step may be lost. If a drive waited for it, a driver that has just changed the speed could not turn.
        before = self._speeds_before_step
        return before is not None and share_of(before, self.model.profile.kind) > self.desk.speed_max

    def _drive_waits(self, now: float) -> bool:
        """Return True if a drive waits until the car has read a step of its speed. No other command goes before it."""
        held = self.queue.held
        waits = held is not None and not held.pending.sent and self._may_overtake(held.pending)
        return waits and now < self._drive_at

    def _act_at(self, pending: Pending) -> float:
        """Return the earliest time for the next frame of an action on a part of the car."""
        # Without a sonar echo, the car reads its buffer only once in each ranging (measurement of the distance), which
        # then takes long. If it reads while this frame arrives behind an unread one, it takes the rest of this frame
        # for the next string, and a digit in it may start the motors.
        pacing = self.model.pacing
        may_join = self._must_not_join_at == pacing.written_at and self.model.is_without_echo
        return pacing.act_at(pending.next_frame, alone=may_join)

    @property
    def _next_mode(self) -> Pending | None:
        """Return the waiting mode if it goes before the actions on parts of the car, else None."""
        change = self.queue.mode_change
        if change is None or not self._may_overtake(change):
            return None
        # Queued actions go before the mode, because the car would ignore them in the mode.
        stands = self.model.at_rest or self._full_stop_runs
        return None if self.queue.has_undelayed_part_action and stands else change

    def _open_mode(self, pending: Pending, now: float) -> OutgoingFrame | None:
        """Open a mode, but stop the car first, because a mode that is opened during a drive leaves the motors on."""
        assert isinstance(pending.command.what, SetMode)
        model = self.model
        # A full stop that is still running here has sent its frames, and gives way. Do not wait for its evidence.
        if not (model.rest_is_sure or self._full_stop_runs):
            return self._begin_stop(self.stops.full(now), FrameOrigin.STOP, now, pending)
        if now < model.pacing.open_at(now, can_show=model.can_show):
            return None
        self.stops.give_way(now)
        return self._prepare(ModeOpen(pending.command.what.mode), FrameOrigin.COMMAND, pending, pending)

    @property
    def steps_before_drive(self) -> list[SpeedStep]:
        """Return the steps of the speed that must go before a drive. Empty also if none make the car slow enough."""
        return self.model.believed.steps_to(self.desk.speed_max) or []

    def drive_wait_s(self, busy_s: float, now: float) -> float:
        """Return the longest wait, in s, of a drive until its frame is written."""
        if steps := len(self.steps_before_drive):
            return busy_s + (steps + 1) * REPEAT_INTERVAL_S
        return max(busy_s, self._drive_at - now)

    def mode_wait_s(self, busy_s: float, now: float) -> float:
        """Return the longest wait, in s, of a mode until its frame is written. `busy_s` is the same for a motion."""
        model = self.model
        if model.rest_is_sure and self.stops.running is None:
            return max(busy_s, model.pacing.open_at(now, can_show=model.can_show) - now)
        running, begin_s = self.stops.running, max(model.pacing.ready_at(Gate.FLIGHT) - now, 0.0)
        if running is None or not self._full_stop_runs:
            busy_s = max(busy_s, self.stops.worst_s(now), begin_s + self.stops.full(now).length_s)
        # The last frame of the stop must have left the buffer of the car.
        return busy_s + REPEAT_INTERVAL_S + (AWAKE_WAIT_S if model.can_show else 0.0)

    @property
    def _full_stop_runs(self) -> bool:
        """Return True if a full stop is running (not just the end of a drive) that does not give way at once.

        A stop that repeats an earlier one counts only after all its frames are sent.
        """
        running = self.stops.running
        if running is None or running.sequence.rank <= SOFT.rank:
            return False
        return running.sent_once or not running.repeats

    def _has_new_command(self, now: float) -> bool:
        """Return True if a command waits that may go before the repeats of the running stop."""
        held, change = self.queue.held, self.queue.mode_change
        waiting = [self._next_mode] if self._actions_wait(now) else [change, self.queue.next_part_action(now)]
        if held is not None and not held.pending.sent:
            waiting.append(held.pending)
        return any(pending is not None and self._may_overtake(pending) for pending in waiting)

    def _actions_wait(self, now: float) -> bool:
        """Return True if actions on parts of the car wait, because they are in the way of something else."""
        if not self.queue.part_actions:
            return False
        stops = self._soft_stop_goes_first(now) or self._stop_goes_first(now) or self._renewal_goes_first(now)
        return stops or self._is_listening(now)

    def _soft_stop_goes_first(self, now: float) -> bool:
        """Return True if an action waits for a soft stop: the car may have lost its first frame, or not read the last.

        The general frame of an action ends the motion just as well. But a color or an angle leaves the motors on, and
        a car that reads it in one string with a stop ignores the stop.
        """
        running = self.stops.running
        if running is None or not running.is_soft or running.index == 0:
            return False
        if not (running.may_be_lost and not running.try_sent) and now >= self._soft_stop_read_at:
            return False
        pending = self.queue.next_part_action(now)
        return pending is not None and not isinstance(pending.next_frame, General)

    @property
    def _soft_stop_read_at(self) -> float:
        """Return when the car has read the last frame of the running soft stop, or -inf if another frame followed."""
        running, pacing = self.stops.running, self.model.pacing
        is_last = running is not None and running.is_soft and running.last_at == pacing.written_at
        return pacing.buffer_until if is_last else float("-inf")

    def _renewal_goes_first(self, now: float) -> bool:
        """Return True if a stream of actions has held up the renewal (repeat) of a stop that the car has not shown."""
        return self._renews and now >= self.stops.renewal.goes_first_at

    @property
    def _renews(self) -> bool:
        """Return True if the car is at rest, and its stop is repeated because nothing has shown it."""
        model = self.model
        return model.at_rest and not model.trust.shown and self.stops.running is None

    def _is_listening(self, now: float) -> bool:
        """Return True if a stream of actions has blocked the car for too long: it must first send a report again.

        While our frames block a car, its silence counts as normal. So during an endless stream nobody would notice a
        car that lost its stop and drives.
        """
        mode = self.model.mode
        if not self._has_stream_since(mode.heard_at):
            return False
        limit_s = mode.silence_limit(fan=self.model.believed.fan_may_run)
        if limit_s is None:
            return False
        is_due = now - mode.heard_at > LISTEN_LIMITS * limit_s
        return is_due and mode.unheard_s(now) <= limit_s + NOTICE_S

    def _has_stream_since(self, at: float) -> bool:
        """Return True if so many actions were written since then that the next ones may have to wait."""
        return len(self._action_times) == FREE_ACTIONS and self._action_times[0] > at

    def _stop_goes_first(self, now: float) -> bool:
        """Return True if a stream of actions on parts of the car waits for the running stop.

        The stream waits for the repeats. Otherwise a color every 0.3 s would put off the repeats of a lost stop for
        ever, and the car would drive on. It also waits for evidence, because each action changes the times of the
        reports that would show the stop. But if a mode waits behind the actions, they wait only while the next
        report may complete the evidence.
        """
        running = self.stops.running
        if running is None or not self._has_stream_since(running.began_at):
            return False
        may_show = self.model.can_show and not (running.is_soft or running.repeats or running.overdue)
        is_short = self.queue.mode_change is None or self.model.evidence.is_awaited
        return now >= running.goes_first_at or (may_show and is_short)

    def _may_overtake(self, pending: Pending) -> bool:
        """Return True if a command may go before the rest of the running stop: it is newer, or waits for that stop."""
        running = self.stops.running
        if running is None or not self._full_stop_runs:
            return True
        # A mode waits for the commands that were queued before it. So if a mode may go before the rest of the stop,
        # these commands may, too. Such a mode is the one for which the stop is sent, or a newer one.
        change = self.queue.mode_change
        newer = change if change is not None and change.received_at >= running.began_at else None
        modes = (running.mode_command, newer)
        waits = any(mode is not None and pending.received_at <= mode.received_at for mode in modes)
        return pending.received_at >= running.began_at or waits

    def _repeats(self, at: float) -> bool:
        """Return True if the motion is to be repeated at this time: it has changed, and its drive does not end soon."""
        held = self.queue.held
        return self.model.believed.repeat and (held is None or held.ends_at - at > NO_REPEAT_S)

    def _renew_stop(self, now: float) -> OutgoingFrame | None:
        """Repeat the stop of a car at rest that has not shown it, because its frames may have been lost."""
        renewal = self.stops.renewal
        if now < renewal.due_at or not self._renews:
            return None
        if renewal.is_full_stop:
            renewal.schedule(now)
            return self._begin_stop(self.stops.full(now), FrameOrigin.REPEAT, now)
        return self._prepare(renewal.next_frame(now), FrameOrigin.REPEAT, None, None)

    def _begin_stop(
        self, sequence: StopSequence, why: FrameOrigin, now: float, mode_command: Pending | None = None
    ) -> OutgoingFrame | None:
        """Begin a stop, which may be for a mode command. Return its first frame if that may be written now."""
        self.stops.begin(sequence, why, now)
        assert self.stops.running is not None
        self.stops.running.mode_command = mode_command
        self.stops.running.repeats = why is FrameOrigin.REPEAT
        return self._next_step(self.stops.running, now)

    def _prepare(
        self, frame: Frame, why: FrameOrigin, source: StopInProgress | HeldMotion | Pending | None, by: Pending | None
    ) -> OutgoingFrame:
        """Return a frame for the caller of `poll`, who writes it. Remember what it is for, until `on_written`."""
        self._source = source
        # A general frame also sets the fan. Except for the command to switch the fan, leave it as it is.
        if not (isinstance(source, Pending) and isinstance(source.command.what, Fan)):
            frame = self.model.believed.with_fan(frame)
        self._in_write = frame
        return OutgoingFrame(frame, self.model.profile.encode(frame), why, by.command.id if by is not None else "")

    # ------------------------------------------------------------------ frames written

    def on_written(self, write: OutgoingFrame, now: float) -> None:
        """Update model and queue, because the frame that `poll` returned is written."""
        source, self._source, self._in_write = self._source, None, None
        model, frame = self.model, write.frame
        if isinstance(frame, ModeClose):
            if not model.manual:
                # One turn of the mode may ignore frames for longer than it takes to close the mode.
                deaf_until = max(now, model.pacing.block_until) + model.for_stop(now).turn_s
                model.mode_closed_at, model.mode_left_by = now, deaf_until + model.profile.block_s(frame) + FLIGHT_S
            model.evidence.on_mode_00(now, awake=model.is_awake(now))
        is_step = isinstance(frame, General) and frame.speed is not None
        speeds, may_be_unread = model.believed.speeds, now < model.pacing.buffer_until
        # A car that reads this frame together with the one before it may ignore one of them.
        lost = (speeds if is_step else self._speeds_before_step) if may_be_unread else None
        model.pacing.on_written(frame, now)
        self._update_model(frame, now)
        if lost is not None:
            model.believed.allow(lost)
        if is_step:
            self._steps_written.append((now, speeds))
        match source:
            case StopInProgress():
                source.may_be_lost = may_be_unread
                self._step_written(source, now)
            case HeldMotion() if is_step:
                source.waited_for = f"its speed was lowered to {model.believed.share:.0%} first (speed_max)"
            case HeldMotion():
                source.begin(now, model.range_cm)
                self._log.record_sent(source.pending, now, source.waited_for)
            case Pending() if source is self.queue.mode_change:
                self.queue.mode_change = None
                self.mode_sent = (source, now)
                self._log.record_sent(source, now)
                self.queue.end_lasting(f"a mode by {source.command.sender.text_name}", now)
            case Pending():
                if self.stops.running is not None:
                    self.stops.running.on_other_written(now)
                if not source.frames_written:  # a command is one action: one that has begun does not wait for a stop
                    self._action_times.append(now)
                self._must_not_join_at = now
                self.queue.on_part_action_written(source, now)
            case None:
                self._must_not_join_at = now
                model.believed.repeat = False

    def allow_for_lost_steps(self, since: float) -> None:
        """Allow for a car that did not get the last steps of the speed: the link may have lost everything since then.

        If the write of a step has failed, allow also for a car that got it.
        """
        believed, frame, self._in_write = self.model.believed, self._in_write, None
        if isinstance(frame, General) and frame.speed is not None:
            believed.allow(stepped(believed.speeds, frame.speed))
        for at, speeds in self._steps_written:
            if at >= since:
                believed.allow(speeds)
        self._steps_written.clear()

    def _step_written(self, running: StopInProgress, now: float) -> None:
        if running.on_step_written(now):
            for pending in running.commands:
                self._log.record_sent(pending, now)
                if isinstance(pending.command.what, SetMode):
                    self.mode_sent = (pending, now)

    def _update_model(self, frame: Frame, now: float) -> None:
        """Apply the effect of a written frame to the model of the car."""
        model = self.model
        shown = model.trust.shown
        model.believed.on_written(frame, now)
        block_s = model.pacing.longest_block_s(frame)
        match frame:
            case ModeOpen(mode):
                self.mode_sent = None
                if model.auto:
                    model.learned.opened_as = model.profile.name
                model.mode.on_mode_sent(mode, now=now, block_s=block_s)
                model.evidence.on_mode_opened(mode, now, silent=mode in model.profile.silent_modes, shown=shown)
                self._end_rest(TrustEvent.MODE_SENT, now)
            case ModeClose():
                if self.mode_sent is not None and self.mode_sent[0].command.what != SetMode(Mode.MANUAL):
                    self.mode_sent = None
                model.mode.on_mode_sent(Mode.MANUAL, now=now, block_s=block_s)
            case _:
                model.mode.on_written(block_s, now=now)
                model.evidence.on_block(blocking_kind(frame), block_s, now)
                if isinstance(frame, General) and frame.motion is not Motion.STOP:
                    model.evidence.on_motion()
                    self._end_rest(TrustEvent.MOTION_SENT, now)
                else:
                    model.evidence.on_other_frame()
                if shown and frame != model.believed.with_fan(STOP_FRAME) and model.trust.shown:
                    self._doubt_rest(now)
        if model.stop_style is StopStyle.GENERAL and (model.mode.asked is None or model.mode.is_over):
            model.mode.on_mode_sent(Mode.MANUAL, now=now, block_s=block_s)

    def _doubt_rest(self, now: float) -> None:
        """Claim no longer that the car has shown its stop, because it got another frame after it.

        A link that loses bytes can turn that frame into a motion (docs/reference/protocol.md#hazards).
        """
        self.model.rest_case = cases.ACTED
        words = cases.ACTED.why(self.model.name)
        self.model.update_trust(TrustEvent.STOP_SENT, now, words)
        self.stops.renewal.schedule(now)

    def _end_rest(self, event: TrustEvent, now: float) -> None:
        self.stops.renewal.reset()
        self.model.update_trust(event, now)

    # ------------------------------------------------------------------ stops

    def shut_down(self, now: float) -> None:
        """Drop all commands and stop the car, unless it has shown that it stands still. The gateway ends."""
        if self.stops.shutting_down:
            return
        self.queue.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, "the gateway is ending", now)
        self.stops.shut_down(now)

    @property
    def is_stopping(self) -> bool:
        """Return True if a stop is in progress."""
        return self.stops.running is not None

    @property
    def shutting_down(self) -> bool:
        """Return True after `shut_down`."""
        return self.stops.shutting_down

    @property
    def not_stopped(self) -> str:
        """Return why the car was not stopped at the end of the gateway. Empty if it was stopped."""
        return self.stops.not_stopped

    def stop(self, why: FrameOrigin, now: float, pending: Pending | None = None) -> None:
        """Stop the car, also if it is in a mode."""
        self.stops.begin(self.stops.full(now), why, now, pending)

    def end_motion(self, now: float, pending: Pending | None = None) -> None:
        """Stop the car at the end of a drive."""
        self.stops.begin(self.stops.soft(now), FrameOrigin.STOP, now, pending)

    def resume_motion(self, words: str, now: float) -> None:
        """End a soft stop, because the car moves again and the rest of the stop would make it jerk."""
        running = self.stops.running
        if running is None or running.sequence.rank != SOFT.rank:
            return
        self.stops.running = None
        for other in running.commands:
            self._log.record(other, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words=words)

    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if a stop is requested now and its frames arrive."""
        return self.stops.worst_s(now)

    def free_at(self, now: float) -> float:
        """Return when a motion can be sent to the car, as far as that is known."""
        return self.stops.free_at(now)

    @property
    def doubt_of_drive(self) -> str:
        """Return why the car may have ignored a drive. Empty if there is no such reason."""
        model = self.model
        if model.is_deaf and model.missed_stop:
            return "it has not reacted to the last stop"
        if model.profile.kind is Platform.UNKNOWN and model.mode.verdict is not Verdict.CONFIRMED:
            return "no reading shows its mode, and in some modes it ignores drives. Name its platform to end such modes"
        return ""

    # ------------------------------------------------------------------ time

    def next_at(self, now: float) -> float:
        """Return when `poll` may have something to do if nothing happens earlier, or inf if never."""
        if not self.model.link_open:
            return float("inf")
        times = self.queue.deadlines()
        running = self.stops.running
        if running is not None:
            waits = self._has_new_command(now) and self.accepts_commands(now)
            times.extend(self.stops.timeouts(running) if waits else self.stops.deadlines(running, now))
            if waits and now < running.goes_first_at and self._has_stream_since(running.began_at):
                times.append(running.goes_first_at)
        times.extend(self._command_times(now))
        return max(now, min(times, default=float("inf")))

    def _command_times(self, now: float) -> list[float]:
        """Return when `_next_command` may have a frame."""
        model, queue, running = self.model, self.queue, self.stops.running
        if running is not None and self.stops.shutting_down:
            return []
        if self._drive_waits(now):
            return [self._drive_at]
        times = self._waiting_times(now) if queue.has_commands else []
        if running is None and self._repeats(max(now, model.pacing.repeat_at)):
            times.append(max(model.pacing.repeat_at, model.mode_left_by))
        if self._renews and queue.mode_change is None:
            times.append(max(self.stops.renewal.due_at, model.ready_at))
        return times

    def _waiting_times(self, now: float) -> list[float]:
        """Return when the commands of the queue may have their next frames written."""
        model, queue, running = self.model, self.queue, self.stops.running
        times: list[float] = []
        free_at = float("-inf") if self.accepts_commands(now) or running is None else running.gives_way_at
        actions_wait = self._actions_wait(now)
        if queue.part_actions and self._next_mode is None and not actions_wait:
            times.extend(
                max(each.due_at, self._act_at(each), model.mode_left_by, free_at)
                for each in queue.turns
                if self._may_overtake(each)
            )
        if queue.held is not None and not queue.held.pending.sent and self._may_overtake(queue.held.pending):
            times.append(max(self._drive_at, free_at))
        if actions_wait and self._soft_stop_read_at > now:
            times.append(self._soft_stop_read_at)
        change = self._next_mode
        if change is not None:
            opens = model.rest_is_sure or self._full_stop_runs
            open_at = model.pacing.open_at(now, can_show=model.can_show) if opens else float("-inf")
            times.append(max(open_at, model.ready_at, free_at))
        return times

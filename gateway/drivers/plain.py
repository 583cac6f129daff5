"""The base class of simple drivers, for families of cars whose state need not be estimated. Pure.

Such a car continues a motion until it gets another one, or until its dead-man timer stops it. Its stop is one sequence
of frames. It has no modes. A family defines its frames, and what its readings show, with class attributes and a few
methods. Waiting, repeating, failing and recording are done here (docs/how-to/write-a-driver.md).

*Claims.* A stop ends as `sent` when its frames are written and a car that received them has had time to stop. A car
that sends readings must have sent one on this link. A family whose readings show more calls `show_rest`; then the stop
ends as `shown`. If its cars could show a stop (`can_show`) but do not in time, the stop counts as not confirmed, and
the driver continues to send it.

*Safe motions.* If a car has a dead-man timer, a held motion is sent again well before that time is over. So one lost
frame does not stop the car, but a lost link does. If a car has no such timer, a stop that no reading shows is sent
again every few seconds, because its frames may have been lost.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Final

from msgspec import Struct, field

from gateway.control.battery import Battery
from gateway.control.command_queue import HeldMotion
from gateway.control.command_records import Pending
from gateway.control.commands import Action, ChangeSpeed, Find, PartAction, SetMode
from gateway.control.control_output import Later, OutgoingFrame
from gateway.control.driver import (
    Desk,
    Driver,
    Echo,
    Event,
    Findings,
    Outputs,
    Rejected,
    TextLine,
    describe_distance_change,
    log_unstopped,
    update_trust,
)
from gateway.control.trust import KNOWN, TrustEvent, TrustState
from schemas.car_profile import CarProfile
from schemas.limits import SHUTDOWN_S
from schemas.words import (
    Basis,
    CarTrust,
    FrameOrigin,
    FrameVerdict,
    Level,
    Mode,
    Motion,
    Motors,
    Phase,
    Reason,
    Shows,
    SpeedStep,
    Verdict,
)

RENEWAL_S: Final = 6.0
"""Interval at which a stop that no reading shows is repeated, if the car has no dead-man timer. The yahboom family has
the same interval."""
SPEED_STEP: Final = 0.1
"""One step of the speed, a share of full speed."""
UNASKED_REPORTS: Final = 3
UNASKED_S: Final = 0.3
"""Number of readings in a row with turning wheels, and their time, that count as a motion which nobody here commanded.
A car that was just stopped may roll for a moment."""
UNASKED_LOG_S: Final = 30.0
"""Minimum time between two log records about a motion that nobody commanded. The car is stopped each time."""
_STEPS: Final[Mapping[SpeedStep, float]] = {SpeedStep.UP: SPEED_STEP, SpeedStep.DOWN: -SPEED_STEP}


# ---------------------------------------------------------------------- the claims


class PlainMode(Struct):
    """The claims about the mode of a car that has only one."""

    asked: Mode | None = Mode.MANUAL
    inferred: Mode | None = None
    verdict: Verdict = Verdict.ASSUMED
    evidence: str = "this car has one mode"
    evidence_at: float | None = None
    since: float | None = None
    candidates: tuple[Mode, ...] = ()
    is_over: bool = False


class PlainModel(Struct):
    """The claims about a car. Times: s, monotonic."""

    name: str
    profile: CarProfile
    battery: Battery
    silence_limit_s: float | None
    trust: TrustState = field(default_factory=TrustState)
    mode: PlainMode = field(default_factory=PlainMode)
    link_open: bool = False
    link_reason: str = "not connected yet"
    range_cm: float | None = None
    range_at: float = float("-inf")
    turned_at: float = float("-inf")
    """When a reading last showed that the wheels turned. Stays -inf if wheels are not measured. The driver of a family
    sets it. Then the record of a drive says that the wheels turned, and a car that moves at rest is stopped."""
    sent_motion: Motion = Motion.STOP
    """The motion whose frame was written last."""
    speed: float = 0.5
    """Share of full speed, 0..1."""
    heard_at: float | None = None
    """When the last reading arrived."""
    link_since: float = float("-inf")
    shows: Shows = Shows.NO
    shows_words: str = "the readings of such a car do not show a stop"
    findings: Findings = field(default_factory=Findings)
    doubted: bool = False
    why_quiet: str = ""

    @property
    def known(self) -> bool:
        """True if the first stop is over, and no write has failed since."""
        return self.trust.state in KNOWN

    @property
    def at_rest(self) -> bool:
        """True if a stop is over, which the readings may show or not (see `basis`)."""
        return self.trust.state is CarTrust.STOPPED

    @property
    def is_heard(self) -> bool:
        """False if the car is silent for longer than any normal silence."""
        return self.trust.state is not CarTrust.UNHEARD

    @property
    def motors(self) -> Motors:
        """The claim about the motors."""
        return self.trust.motors

    @property
    def basis(self) -> Basis | None:
        """The evidence for the claim that the motors are off."""
        return self.trust.basis

    @property
    def motion(self) -> Motion | None:
        """The last motion sent, or None if the state is unknown."""
        return self.sent_motion if self.known else None

    @property
    def outputs(self) -> Outputs:
        """The estimated state of speed, fan and servo."""
        return Outputs(self.speed)

    @property
    def shows_stops(self) -> tuple[Shows, str]:
        """Says if the readings of the car show that a stop arrived, with the reason."""
        return self.shows, self.shows_words

    def unheard_s(self, now: float) -> float:
        """Return how long the car has sent no reading on this link, s."""
        return now - max(self.link_since, self.link_since if self.heard_at is None else self.heard_at)

    def silent_s(self, now: float) -> float:
        """Return the same: no silence of such a car is excused."""
        return self.unheard_s(now)

    def moved_since(self, range_cm: float | None, since: float) -> str:
        """Describe the reading since `since` that shows that a drive moved the car. Empty if none does."""
        if self.turned_at > since:
            return "its wheels turned"
        return "" if self.range_at < since else describe_distance_change(range_cm, self.range_cm)


# ---------------------------------------------------------------------- the driver


class PlainStop(Struct):
    """A stop in progress. Its frames are sent in one try after another until it is over. Times: s, monotonic."""

    why: FrameOrigin
    began_at: float
    next_at: float
    """When the next frame of the stop, or its next try, is due."""
    commands: list[Pending]
    is_soft: bool
    """True for the stop at the end of a drive: a new drive may replace it at once, an action after its first frame."""
    index: int = 0
    """Number of this try's frames that are written."""
    last_at: float = float("-inf")
    """When the first try's last frame was written, or -inf before. A stop that is repeated begins with a first try."""
    is_late: bool = False
    """True if the car did not show the stop in time. The driver continues to send it."""


class PlainDriver(Driver):
    """One car of a plain family. The family's subclass sets the class attributes and defines the abstract methods."""

    STOP_FRAMES: ClassVar[int] = 1
    """Number of frames of a stop. Each try of a stop sends all of them."""
    STOP_GAP_S: ClassVar[float] = 0.1
    """Time between two frames of a stop."""
    PART_GAP_S: ClassVar[float] = 0.25
    """Time between the frames of one action, such as a blink."""
    STOPS_WITHIN_S: ClassVar[float]
    """Time after the last frame of a stop within which a car that received it has stopped."""
    RETRY_S: ClassVar[float] = 2.0
    """Time from the last frame of a try to the next try, while the stop is not over."""
    EVIDENCE_S: ClassVar[float] = 5.0
    """Time after the last frame within which a car that can show its stop shows it."""
    RESEND_S: ClassVar[float | None] = None
    """Interval at which a held motion is sent again. It must be well under the dead-man time. None: send it once."""
    SILENCE_S: ClassVar[float | None] = None
    """The longest normal silence, or None if every silence is normal."""
    MOVES_UNASKED: ClassVar[str] = ""
    """Names other programs that may drive such a car, and says what to do about them, in whole sentences."""

    def __init__(self, desk: Desk, profile: CarProfile) -> None:
        super().__init__(desk)
        battery = Battery(desk.battery_policy.of_cells(profile.cells), profile.cells)
        self._model = PlainModel(desk.car, profile, battery, self.SILENCE_S)
        self._model.speed = min(self._model.speed, desk.speed_max)
        self._stop: PlainStop | None = None
        self._source: PlainStop | HeldMotion | Pending | None = None
        self._part_action_at = float("-inf")
        """When the next frame of an action on a part of the car may be written."""
        self._resend_at = float("inf")
        """When the held motion is sent again."""
        self._renew_at = float("inf")
        self._shutting_down = False
        self._ends_at = float("inf")
        self._not_stopped = ""
        self._unasked, self._unasked_since = 0, float("-inf")
        """Number of readings in a row that show turning wheels at rest, and the time of the first."""
        self._unasked_log_at = float("-inf")

    # ------------------------------------------------------------------ for a family to define

    @abstractmethod
    def motion_frame(self, motion: Motion) -> bytes:
        """Return the frame of a motion at `self.model.speed`, which `speed_max` of the fleet file limits.

        LEFT is a curve, SPIN_LEFT turns on the spot.
        """

    def stop_frame(self, index: int) -> bytes:
        """Return the frame number `index` of a stop, from 0. The last one is also sent alone, to repeat the stop."""
        del index
        return self.motion_frame(Motion.STOP)

    @abstractmethod
    def part_frames(self, what: Action) -> tuple[bytes | Later, ...] | None:
        """Return the frames of an action on a part of the car; `Later` delays one. None if the car cannot do it.

        `Find` is such an action, too: some lights or sounds that show which car it is.
        """

    @property
    def can_show(self) -> bool:
        """Return True if the readings of this car would show a stop now."""
        return False

    @property
    def hears(self) -> bool:
        """Return False while the car cannot receive frames, as during its boot. Then no stop ends as `sent`."""
        return True

    def setup_frame(self, now: float) -> bytes | None:
        """Return the next frame that sets the car up, queries it, or keeps its link alive, if one is due."""
        del now
        return None

    def setup_at(self) -> float:
        """Return when `setup_frame` may have something to do, or inf if never."""
        return float("inf")

    def on_reading(self, event: Event, now: float) -> None:
        """Handle a reading: any event but `Rejected`, `TextLine` and `Echo`. It shows that the car is alive."""

    def on_stop_written(self, data: bytes, now: float) -> None:
        """Handle that a frame of a stop was written."""

    # ------------------------------------------------------------------ the interface of `Driver`

    @property
    def model(self) -> PlainModel:
        """The claims about the car."""
        return self._model

    def verdict(self, event: Event) -> str:
        """Return the kind of an event's bytes."""
        match event:
            case Echo():
                return FrameVerdict.ECHO
            case TextLine():
                return FrameVerdict.TEXT
            case Rejected(cause=cause):
                return str(cause)
            case _:
                return FrameVerdict.SENSORS

    def on_event(self, event: Event, now: float) -> None:
        """Update the state with an event."""
        model = self._model
        if isinstance(event, Echo | Rejected | TextLine):
            return
        model.heard_at = event.at
        if model.trust.state is CarTrust.UNHEARD:
            words = f"{model.name} sends readings again. The gateway stops it first."
            self._log.log(Level.INFO, "answers_again", words, now)
            self._begin_again(words, TrustEvent.HEARD, now)
        self.on_reading(event, now)
        if not (model.at_rest and model.turned_at >= event.at):
            self._unasked = 0
            return
        self._unasked_since = event.at if self._unasked == 0 else self._unasked_since
        self._unasked += 1
        if self._unasked >= UNASKED_REPORTS and event.at >= self._unasked_since + UNASKED_S:
            told = (f"{model.name} moves, and nobody here drives it.", self.MOVES_UNASKED, "The gateway stops it.")
            words = " ".join(filter(None, told))
            if self.may_log_unasked(now):
                self._log.log(Level.WARNING, "moves_unasked", words, now)
            self.recover(words, now)

    def may_log_unasked(self, now: float) -> bool:
        """Return True if a motion that nobody commanded, or its cause, was not logged a short time ago."""
        if now < self._unasked_log_at + UNASKED_LOG_S:
            return False
        self._unasked_log_at = now
        return True

    # ------------------------------------------------------------------ the link, and time

    def link_up(self, now: float) -> None:
        """Begin to stop the car, because its link is open."""
        model = self._model
        model.link_open, model.link_since, model.heard_at = True, now, None
        self.senders.halt_streams(now)
        self._update_trust(TrustEvent.LINK_OPENED, now)
        self._begin(FrameOrigin.RECOVERY, now, [], is_soft=False)

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail all commands, because the link is down."""
        model = self._model
        model.link_open, model.link_reason, self._renew_at = False, reason, float("inf")
        self._update_trust(TrustEvent.LINK_LOST, now, reason)
        self._source = None
        stop, self._stop = self._stop, None
        words = f"NOT CONFIRMED: {model.name} became unreachable during the stop ({reason}). {self._when_cut}"
        for pending in stop.commands if stop is not None else ():
            self._log.record(pending, Phase.FAILED, now, reason=cause, words=words)
        if self._shutting_down and stop is not None:
            self._end_unstopped(f"is unreachable ({reason})", now)
        self.queue.drop(Phase.FAILED, cause, reason, now)
        self.senders.halt_streams(now)

    @property
    def _when_cut(self) -> str:
        dead_man_s = self._model.profile.dead_man_s
        if dead_man_s is None:
            later = "" if self._shutting_down else " The gateway stops it as soon as the link is back."
            return f"Look at the car.{later}"
        return f"Its dead-man stops it within {dead_man_s:g} s, unless something else drives it. Look at the car."

    def tick(self, now: float) -> None:
        """Stop a car that is silent for too long."""
        model, limit_s = self._model, self.SILENCE_S
        if not model.link_open or limit_s is None or not model.is_heard or model.unheard_s(now) <= limit_s:
            return
        words = f"{model.name} may be moving: no reading for {model.unheard_s(now):.1f} s. Is it on, and in range?"
        self._log.log(Level.WARNING, "unheard", words, now)
        self._begin_again(words, TrustEvent.SILENT, now)

    def _begin_again(self, words: str, event: TrustEvent, now: float) -> None:
        """Drop all commands, and bring the car to a known state."""
        self.queue.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        self.senders.halt_streams(now)
        self._update_trust(event, now, words)
        if self._stop is None or self._stop.is_soft:
            self._begin(FrameOrigin.RECOVERY, now, [], is_soft=False)
        else:  # the frames of the running stop may be lost
            self.repeat_stop(now)

    def repeat_stop(self, now: float) -> None:
        """Send the running stop again at once, if there is one."""
        if self._stop is not None:
            self._stop.index, self._stop.next_at, self._stop.last_at = 0, now, float("-inf")

    def recover(self, words: str, now: float) -> None:
        """Bring the car to a known state, because it does something that nobody commanded."""
        self._begin_again(words, TrustEvent.DOUBTED, now)

    # ------------------------------------------------------------------ frames out

    def poll(self, now: float) -> OutgoingFrame | None:
        """Return the frame to write now, if any."""
        if not self._model.link_open:
            return None
        self.expire(now)
        if (stop := self._stop) is not None:
            write = self._next_of_stop(stop, now)
            if write is not None or self._stop is stop:
                return write
        if (data := self.setup_frame(now)) is not None:
            return self._write(data, FrameOrigin.SETUP, None)
        return None if self.wait_words(now) else self._next_command(now)

    def _next_of_stop(self, stop: PlainStop, now: float) -> OutgoingFrame | None:
        if self._shutting_down and now >= self._ends_at:
            self._stop = None
            self._end_unstopped("has not shown the stop", now)
            for pending in stop.commands:
                self._log.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=self._not_stopped)
            return None
        if stop.index < self.STOP_FRAMES:
            return self._write(self.stop_frame(stop.index), stop.why, stop) if now >= stop.next_at else None
        if self._has_new_motion(stop) and self.accepts_commands(now):
            self._give_way(stop, now)
            return None
        if self.accepts_commands(now) and (write := self._next_part(now)) is not None:
            return write
        model = self._model
        answers = model.is_heard and (model.heard_at is not None or not model.profile.has_readings)
        if not self.can_show and answers and self.hears:
            if now >= stop.last_at + self.STOPS_WITHIN_S:
                self._finish(stop, Basis.SENT, model.shows_words, now)
                return None
        elif now >= stop.last_at + self.EVIDENCE_S and not stop.is_late:
            self._fail_late(stop, now)
        if now >= stop.next_at:
            stop.index = 0
            return self._write(self.stop_frame(0), stop.why, stop)
        data = self.setup_frame(now)
        return None if data is None else self._write(data, FrameOrigin.SETUP, None)

    def _next_command(self, now: float) -> OutgoingFrame | None:
        model, held = self._model, self.queue.held
        if held is not None and not held.pending.sent:
            return self._write(self.motion_frame(held.motion), FrameOrigin.COMMAND, held)
        if (write := self._next_part(now)) is not None:
            return write
        if held is not None and now >= self._resend_at:
            return self._write(self.motion_frame(held.motion), FrameOrigin.REPEAT, held)
        if now >= self._renew_at and model.at_rest and not model.trust.shown:
            self._renew_at = now + RENEWAL_S
            return self._write(self.stop_frame(self.STOP_FRAMES - 1), FrameOrigin.REPEAT, None)
        return None

    def _next_part(self, now: float) -> OutgoingFrame | None:
        """Return the next frame of an action on a part of the car, if one is due."""
        if now < self._part_action_at or (pending := self.queue.next_part_action(now)) is None:
            return None
        data, held = pending.next_frame, self.queue.held
        if isinstance(pending.command.what, ChangeSpeed):  # a frame for a speed repeats the present motion
            is_driven = held is not None and held.pending.sent and self._stop is None
            data = self.motion_frame(held.motion if held is not None and is_driven else Motion.STOP)
        return self._write(data, FrameOrigin.COMMAND, pending)

    def _write(self, data: bytes, why: FrameOrigin, source: PlainStop | HeldMotion | Pending | None) -> OutgoingFrame:
        self._source = source
        match source:
            case PlainStop(commands=[first, *_]):
                by = first.command.id
            case HeldMotion(pending=pending) | (Pending() as pending):
                by = pending.command.id
            case _:
                by = ""
        return OutgoingFrame(data, data, why, by)

    def on_written(self, write: OutgoingFrame, now: float) -> None:
        """Update the state, because the frame is written."""
        source, self._source = self._source, None
        match source:
            case PlainStop():
                self._on_stop_frame(source, write.data, now)
            case HeldMotion() as held:
                self._resend_at = float("inf") if self.RESEND_S is None else now + self.RESEND_S
                self._renew_at = float("inf")
                self._model.sent_motion = held.motion
                self._update_trust(TrustEvent.MOTION_SENT, now)
                if not held.pending.sent:
                    held.begin(now, self._model.range_cm)
                    self._log.record_sent(held.pending, now)
            case Pending():
                self.queue.on_part_action_written(source, now)
                self._part_action_at = now + (self.PART_GAP_S if source.frames and not source.is_delayed else 0.0)
                self._apply(source.command.what, now)
            case None:
                pass

    def _on_stop_frame(self, stop: PlainStop, data: bytes, now: float) -> None:
        self._model.sent_motion = Motion.STOP
        for pending in stop.commands:
            self._log.record_sent(pending, now)
        stop.index += 1
        is_last = stop.index >= self.STOP_FRAMES
        stop.next_at = now + (self.RETRY_S if is_last else self.STOP_GAP_S)
        if is_last and stop.last_at == float("-inf"):
            stop.last_at = now
        self.on_stop_written(data, now)

    def next_at(self, now: float) -> float:
        """Return when `poll` may have something to do if nothing happens earlier, or inf if never."""
        if not self._model.link_open:
            return float("inf")
        times = self.queue.deadlines()
        stop, held = self._stop, self.queue.held
        if stop is not None:
            later = [self._ends_at]  # only times to come: `poll` has handled the others
            times.append(stop.next_at)
            if stop.index >= self.STOP_FRAMES:  # before, `poll` writes no other frame between those of the stop
                later += [stop.last_at + self.STOPS_WITHIN_S, stop.last_at + self.EVIDENCE_S]
                times.append(self.setup_at())
                if not self.wait_words(now):
                    part_action_at = (
                        now if self._has_new_motion(stop) else max(self._part_action_at, self.queue.part_action_at)
                    )
                    times.append(max(self.free_at(now), part_action_at))
            times += [each for each in later if each > now]
            return max(now, min(times))
        times.append(self.setup_at())
        if not self.wait_words(now):
            if held is not None and not held.pending.sent:
                times.append(now)
            times.append(max(self._part_action_at, self.queue.part_action_at))
            if held is not None:
                times.append(self._resend_at)
            if self._model.at_rest and not self._model.trust.shown:
                times.append(self._renew_at)
        return max(now, min(times, default=float("inf")))

    # ------------------------------------------------------------------ commands

    def refusal(self, what: Action) -> str | None:
        """Return why this car cannot do this at all, or None if it can."""
        car, model = self.desk.car, self._model
        match what:
            case SetMode(mode) if mode not in model.profile.modes:
                return f"{car} ({model.profile.name}) has no mode {mode}. It has: manual."
            case ChangeSpeed(step):
                maximum = self.desk.speed_max
                if step is SpeedStep.DOWN or model.speed < maximum - 1e-9:  # the last step up is shorter if needed
                    return None
                limit = " (speed_max)" if maximum < 1 else ""
                return f"{car} drives at {maximum:.0%} of full speed already. That is its maximum{limit}."
            case PartAction() | Find() if not self.part_frames(what):
                has = ", ".join(sorted(model.profile.capabilities))
                return f"{car} ({model.profile.name}) cannot do that. It has: {has}."
            case _:
                return None

    def frames(self, what: Action) -> tuple[bytes | Later, ...]:
        """Return the frames of an action on a part of the car."""
        if isinstance(what, ChangeSpeed):
            return (self.motion_frame(Motion.STOP),)  # a placeholder: `poll` sends the present motion instead
        return self.part_frames(what) or ()

    def _apply(self, what: Action, now: float) -> None:
        """Record the effect of a written action. Send the held motion again at once with a new speed."""
        if isinstance(what, ChangeSpeed):
            self._model.speed = min(self.desk.speed_max, max(SPEED_STEP, self._model.speed + _STEPS[what.step]))
            self._resend_at = now

    def accepts_commands(self, now: float) -> bool:
        """Return True if a command's frame may be written."""
        stop = self._stop
        if self._shutting_down or self.wait_words(now):
            return False
        return stop is None or (stop.is_soft and stop.index > 0) or now >= self._gives_way_at(stop)

    def _gives_way_at(self, stop: PlainStop) -> float:
        """Return when a newer command may replace a stop: its frames are written, and the car has had time to stop."""
        return stop.last_at + self.STOPS_WITHIN_S if stop.last_at > float("-inf") else float("inf")

    def _has_new_motion(self, stop: PlainStop) -> bool:
        held = self.queue.held
        is_new = held is not None and not held.pending.sent
        return is_new and held is not None and (held.pending.received_at >= stop.began_at or stop.is_soft)

    def free_at(self, now: float) -> float:
        """Return when a motion can be sent to the car, as far as that is known."""
        stop = self._stop
        if stop is None or (stop.is_soft and stop.index > 0):
            return now
        if stop.last_at > float("-inf"):
            return max(now, self._gives_way_at(stop))
        return now + self._length_s(stop.index) + self.STOPS_WITHIN_S

    def _length_s(self, index: int = 0) -> float:
        return max(0, self.STOP_FRAMES - 1 - index) * self.STOP_GAP_S

    # ------------------------------------------------------------------ stops

    @property
    def is_stopping(self) -> bool:
        """Return True if a stop is in progress."""
        return self._stop is not None

    @property
    def shutting_down(self) -> bool:
        """Return True after `shut_down`."""
        return self._shutting_down

    @property
    def not_stopped(self) -> str:
        """Return why the car was not stopped at the end of the gateway. Empty if it was stopped."""
        return self._not_stopped

    def stop(self, why: FrameOrigin, now: float, pending: Pending | None = None) -> None:
        """Stop the car, also if it is in a mode."""
        self._begin(why, now, [pending] if pending is not None else [], is_soft=False)

    def end_motion(self, now: float, pending: Pending | None = None) -> None:
        """Stop the car at the end of a drive."""
        self._begin(FrameOrigin.STOP, now, [pending] if pending is not None else [], is_soft=True)

    def resume_motion(self, words: str, now: float) -> None:
        """End a stop that follows the end of a drive, because the car is driven again."""
        if self._stop is not None and self._stop.is_soft:
            self._give_way(self._stop, now, words)

    def _give_way(self, stop: PlainStop, now: float, words: str = "") -> None:
        self._stop = None
        words = words or f"the stop was sent, and {self._model.name} was commanded again before it was over"
        for pending in stop.commands:
            if not isinstance(pending.command.what, SetMode):
                self._log.record(pending, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words=words)

    def _begin(self, why: FrameOrigin, now: float, commands: list[Pending], *, is_soft: bool) -> None:
        running = self._stop
        if running is not None and (is_soft or not running.is_soft):
            running.commands.extend(commands)
            running.why = why if why is FrameOrigin.SHUTDOWN else running.why
            if running.last_at > float("-inf") and commands:  # all its frames are written: repeat them for this command
                running.index, running.next_at, running.last_at = 0, now, float("-inf")
                running.began_at, running.is_late = now, False
            return
        self._stop = PlainStop(why, now, now, [*(running.commands if running is not None else ()), *commands], is_soft)
        self._update_trust(TrustEvent.STOP_BEGUN, now, f"stop ({why})")

    def show_rest(self, words: str, now: float) -> None:
        """End the running stop if its frames are all written, because readings have shown that the car stands still.

        Without a running stop, the last stop counts as shown.
        """
        if self._model.shows is not Shows.YES:
            self._model.shows, self._model.shows_words = Shows.YES, f"{self._model.name} has shown a stop: {words}"
        if self._stop is not None and self._stop.last_at > float("-inf"):
            self._finish(self._stop, Basis.SHOWN, words, now)
        elif self._model.at_rest and not self._model.trust.shown:
            self._update_trust(TrustEvent.STOP_SHOWN, now, words)

    def _finish(self, stop: PlainStop, basis: Basis, words: str, now: float) -> None:
        model, shown = self._model, basis is Basis.SHOWN
        recovered, self._stop = not model.known, None
        self._update_trust(TrustEvent.STOP_SHOWN if shown else TrustEvent.STOP_SENT, now, words)
        if recovered:
            how = "is stopped (confirmed)" if shown else f"got its stop (not confirmed: {words})"
            self._log.log(Level.INFO, "recovered", f"{model.name} {how}, mode manual", now)
        self._renew_at = float("inf") if shown or model.profile.dead_man_s is not None else now + RENEWAL_S
        phase, told, evidence = (Phase.COMPLETE, "", (words,)) if shown else (Phase.SENT, words, ())
        for pending in stop.commands:
            if not isinstance(pending.command.what, SetMode):
                self._log.record(pending, phase, now, words=told, evidence=evidence, basis=basis)

    def _fail_late(self, stop: PlainStop, now: float) -> None:
        """Fail the commands of a stop that the car could have shown. Continue the stop."""
        model = self._model
        stop.is_late = True
        words = f"NOT CONFIRMED: {model.name} has not shown the stop. Look at the car. The gateway keeps stopping it."
        for pending in stop.commands:
            self._log.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=words)
        stop.commands.clear()
        self._update_trust(TrustEvent.NOT_SHOWN, now)
        self._log.log(Level.ERROR, "not_shown", words, now)

    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if a stop is requested now and its frames arrive."""
        del now
        stop = self._stop
        goes_on = stop is not None and stop.last_at == float("-inf")  # a stop whose frames are all written is repeated
        return self._length_s(stop.index if stop is not None and goes_on else 0) + self.STOPS_WITHIN_S

    def shut_down(self, now: float) -> None:
        """Stop the car for the last time."""
        if self._shutting_down:
            return
        self.queue.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, "the gateway is ending", now)
        self._shutting_down, self._ends_at = True, now + SHUTDOWN_S
        model = self._model
        if not model.link_open:
            self._end_unstopped(f"is unreachable ({model.link_reason})", now)
        elif self._stop is not None or not (model.at_rest and model.trust.shown):
            self.stop(FrameOrigin.SHUTDOWN, now)

    def _end_unstopped(self, why: str, now: float) -> None:
        self._not_stopped = why
        log_unstopped(self._log, self._model.name, why, now)

    def _update_trust(self, event: TrustEvent, now: float, evidence: str = "") -> None:
        update_trust(self._model, self._log, event, now, evidence)

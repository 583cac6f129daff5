"""The interface between a gateway and a family of cars, which every driver implements. Pure: time is an argument.

A gateway has one driver for its car. The driver turns bytes into events and readings, and actions into frames or a
refusal. It decides when a frame may be written, how the car is stopped, and what may be claimed about it afterwards.
Everything else is the task of the gateway: who may command the car, the queue, the records, the link, the bus.

Gateway and driver meet in three places. `Desk` is what the gateway shares with its driver: the queue of commands and
the log. `DriverClaims` is what the gateway publishes about the car. `Driver` is what the gateway calls. The loop calls
`poll`, writes the returned frame, and calls `on_written` or `link_down` before the next `poll`. So there is never more
than one frame in flight.

Times: s of one monotonic clock. `docs/how-to/write-a-driver.md` explains a whole driver step by step.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from typing import Any, Final, Protocol

from msgspec import Struct, field

from gateway.control.battery import Battery, BatteryPolicy
from gateway.control.command_queue import CommandQueue
from gateway.control.command_records import CommandLog, Pending
from gateway.control.commands import Action, Signal
from gateway.control.control_output import OutgoingFrame
from gateway.control.trust import TrustEvent, TrustState
from schemas.car_profile import CarProfile
from schemas.words import (
    Basis,
    BatteryAction,
    BatteryLevel,
    Cause,
    FrameOrigin,
    Level,
    Mode,
    Motion,
    Motors,
    Phase,
    Reason,
    Shows,
    Verdict,
)

TICK_S: Final = 0.2
"""Interval at which a gateway calls `Driver.tick`."""
STALL_S: Final = 0.5
"""Maximum gap of the loop (a time in which it does not run) during a held motion. After a longer one the gateway stops
the car (docs/explanation/how-it-works.md#processes-and-threads)."""
LATE_DRIVE_S: Final = 0.1
"""A drive may begin this long after its request. If it begins later, its sender is told how long it waited."""
MOVED_CM: Final = 5.0
"""Minimum change of the measured distance that counts as a movement. While a car stands, its readings differ by up to a
centimeter."""


# ---------------------------------------------------------------------- bytes of a car


class Event(Protocol):
    """An item that a decoder found in the bytes: a reading, an `Echo` of our own frame, or bytes that are neither."""

    @property
    def raw(self) -> bytes:
        """The bytes of the item."""

    @property
    def at(self) -> float:
        """When the last byte arrived, s, monotonic."""


class Echo(Struct, frozen=True):
    """Bytes that equal a frame which we sent shortly before. `at` is the time of the last byte."""

    raw: bytes
    at: float


class Rejected(Struct, frozen=True):
    """Bytes that are not a reading, with the cause. `detail` is for a person; `at` is the time of the last byte."""

    raw: bytes
    at: float
    cause: Cause
    detail: str = ""


class TextLine(Struct, frozen=True):
    """A text between frames, such as the line of a debug print. It does not count as damage.

    The text may be in a longer run of unreadable bytes. `at` is the time of the last byte of that run.
    """

    raw: bytes
    at: float


Fields = Mapping[str, Any]
"""Values by field of a message, in the field's unit. A tuple fills a repeated field."""


# ---------------------------------------------------------------------- claims about a car


class ModeClaims(Protocol):
    """The mode that was commanded, and the mode that the readings show."""

    @property
    def asked(self) -> Mode | None:
        """The last commanded mode, or None if unknown."""

    @property
    def inferred(self) -> Mode | None:
        """The mode that the readings show, or None if they show none."""

    @property
    def verdict(self) -> Verdict:
        """The confidence in `asked`."""

    @property
    def evidence(self) -> str:
        """The evidence for the verdict, as a text for a person."""

    @property
    def evidence_at(self) -> float | None:
        """The time of the evidence."""

    @property
    def since(self) -> float | None:
        """When `asked` or `verdict` last changed."""

    @property
    def candidates(self) -> tuple[Mode, ...]:
        """The modes in which the car could have sent the last reading."""

    @property
    def is_over(self) -> bool:
        """True if the readings show that the car is no longer in the commanded mode."""


class Outputs(Struct, frozen=True):
    """The estimated state of the parts that the gateway sets. None if unknown, or if the car has no such part."""

    speed: float = 0.0
    """Share of full speed, 0..1."""
    fan: bool | None = None
    servo_deg: float | None = None


class Findings(Struct, frozen=True):
    """The findings about the car itself, for `state/health`."""

    platform_evidence: tuple[str, ...] = ()
    platform_contradictions: tuple[str, ...] = ()
    numbers: Fields = field(default_factory=dict)
    """Other fields of fleet.v1.Health."""


class DriverClaims(Protocol):
    """The current claims about the car. The gateway publishes them, and refuses or delays commands because of them."""

    name: str
    link_open: bool
    link_reason: str
    """Why the link is down."""
    trust: TrustState
    battery: Battery

    @property
    def profile(self) -> CarProfile:
        """The profile of the car, which may change while the driver finds out the platform."""

    @property
    def mode(self) -> ModeClaims:
        """The claims about the mode of the car."""

    @property
    def known(self) -> bool:
        """True if the first stop is over, and no doubt has arisen since, so that the car reads frames as meant."""

    @property
    def at_rest(self) -> bool:
        """True if the car stands still in mode 0 after a stop, which its readings may show or not (see `basis`)."""

    @property
    def is_heard(self) -> bool:
        """False if the car is silent for longer than any normal silence."""

    @property
    def motors(self) -> Motors:
        """The claim about the motors."""

    @property
    def basis(self) -> Basis | None:
        """The evidence for the claim that the motors are off, or None if there is no such claim."""

    @property
    def motion(self) -> Motion | None:
        """The last motion sent, or None if the state is unknown or the car drives by itself."""

    @property
    def outputs(self) -> Outputs:
        """The estimated state of speed, fan and servo."""

    @property
    def range_cm(self) -> float | None:
        """The last measured distance, or None if none was measured."""

    @property
    def shows(self) -> Shows:
        """Says if the reports of the car show that a stop arrived."""

    @property
    def shows_stops(self) -> tuple[Shows, str]:
        """The value of `shows`, with the reason in words."""

    @property
    def doubted(self) -> bool:
        """True if the car has shown its stops before, and did not show the last one."""

    @property
    def findings(self) -> Findings:
        """The findings about the car."""

    @property
    def silence_limit_s(self) -> float | None:
        """The longest normal silence now, or None if every silence is normal."""

    @property
    def why_quiet(self) -> str:
        """Why a silence is normal now, as a text for a person."""

    def unheard_s(self, now: float) -> float:
        """Return how long the car has been silent, s, without times in which it is normally silent."""

    def silent_s(self, now: float) -> float:
        """Return how long ago the last reading of this link arrived, or how long the link is open without one, s."""

    def moved_since(self, range_cm: float | None, since: float) -> str:
        """Describe the reading that shows that a drive moved the car. Empty if none does.

        `range_cm` is the distance before the drive, which began at `since`.
        """


def describe_distance_change(before_cm: float | None, now_cm: float | None) -> str:
    """Describe how the distance has changed during a drive. Empty if it shows no movement."""
    if before_cm is None or now_cm is None or abs(now_cm - before_cm) < MOVED_CM:
        return ""
    return f"its distance changed from {before_cm / 100:.2f} m to {now_cm / 100:.2f} m"


def update_trust(model: DriverClaims, log: CommandLog, event: TrustEvent, now: float, evidence: str = "") -> None:
    """Update the trust state of a car, and log each change."""
    trust = model.trust
    if trust.apply(event, now, evidence):
        basis = f" ({trust.basis})" if trust.basis is not None else ""
        words = f"{model.name} is {trust.state.replace('_', ' ')}{basis}: {trust.evidence}"
        log.log(Level.DEBUG, "trust", words, now)


def log_unstopped(log: CommandLog, car: str, why: str, now: float) -> None:
    """Log that the gateway ends although its car may not be stopped."""
    log.log(Level.ERROR, "not_stopped", f"{car} may still be moving: {car} {why}. Look at the car.", now)


# ---------------------------------------------------------------------- the driver


class Desk(Struct, frozen=True):
    """The objects that a gateway shares with its driver. Commands wait in `queue` until the driver can send them."""

    car: str
    log: CommandLog
    queue: CommandQueue
    battery_policy: BatteryPolicy = field(default_factory=BatteryPolicy)
    speed_max: float = 1.0
    """Maximum share of full speed, 0..1."""


class Driver(ABC):
    """One car of one family. See the docstring of the module for the order of the calls."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.queue = desk.queue
        self.safety = desk.queue.safety
        self.senders = desk.queue.senders
        self._log = desk.log

    @property
    @abstractmethod
    def model(self) -> DriverClaims:
        """The claims about the car."""

    @property
    def lost_frames(self) -> int:
        """Return the number of stop frames that did not arrive, as the car's reports show."""
        return 0

    # ------------------------------------------------------------------ bytes in

    @abstractmethod
    def feed(self, data: bytes, now: float) -> list[Event]:
        """Return the events in the bytes."""

    def flush(self, now: float) -> list[Event]:
        """Return the events whose frame was ended by a silence. There are none if only bytes can end a frame."""
        del now
        return []

    def flush_at(self) -> float:
        """Return when `flush` has something to do if no byte arrives earlier, or inf if never."""
        return float("inf")

    @abstractmethod
    def drop_bytes(self) -> list[Event]:
        """Forget the unfinished frame, because the link is lost or bytes were discarded.

        Return the events in the bytes of the frame.
        """

    def sends(self, data: bytes, now: float) -> None:
        """Remember the bytes of a frame that is about to be written, if the link or the car may echo them."""
        del data, now

    @abstractmethod
    def measured(self, event: Event) -> Mapping[str, Fields]:
        """Return the measured values of an event by topic. Leave out fields that were not measured."""

    @abstractmethod
    def verdict(self, event: Event) -> str:
        """Return the kind of an event's bytes, for `frame/rx`."""

    @abstractmethod
    def on_event(self, event: Event, now: float) -> None:
        """Update the state with an event. Its measurements are published already."""

    # ------------------------------------------------------------------ the link, and time

    @abstractmethod
    def link_up(self, now: float) -> None:
        """Begin to bring the car to a known state, because the link is open."""

    @abstractmethod
    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail all commands, because the link is down. After WRITE_FAILED the car may have got a part of a frame."""

    @abstractmethod
    def tick(self, now: float) -> None:
        """Check for silence. The gateway calls it every `TICK_S`."""

    def on_stall(self, gap_s: float, now: float) -> None:
        """Stop a driven car after a gap of the loop."""
        if gap_s > STALL_S and self.queue.held is not None:
            words = f"{self.desk.car} is stopped: its gateway stalled for {gap_s:.1f} s during a drive"
            self._log.log(Level.ERROR, "stalled", words, now)
            self.release(Phase.EXPIRED, Reason.EXPIRED, words, now)

    def on_sleep(self, slept_s: float, now: float) -> None:
        """Drop all commands after a sleep of the computer. Stop the car, unless it has shown that it stands still."""
        model, car = self.model, self.desk.car
        stands = model.at_rest and model.trust.shown and not self.is_stopping
        then = f"{car} stood still before, and still does" if stands else f"{car} is stopped first"
        words = f"the computer slept for {slept_s:.1f} s: {then if model.link_open else 'all commands have ended'}"
        self._log.log(Level.WARNING, "slept", words, now)
        self.queue.drop(Phase.EXPIRED, Reason.EXPIRED, words, now)
        self.senders.halt(now)  # a joystick that is still held must not restart the car
        if model.link_open and not stands:
            self.stop_after_sleep(now)

    def stop_after_sleep(self, now: float) -> None:
        """Stop the car. A stop that began before the sleep continues."""
        if not self.shutting_down or self.is_stopping:  # after its last stop, a gateway that ends sends nothing
            self.stop(FrameOrigin.STOP, now)

    # ------------------------------------------------------------------ frames out

    @abstractmethod
    def poll(self, now: float) -> OutgoingFrame | None:
        """Return the frame to write now, if any."""

    @abstractmethod
    def on_written(self, write: OutgoingFrame, now: float) -> None:
        """Update the state, because the frame that `poll` returned is written."""

    @abstractmethod
    def next_at(self, now: float) -> float:
        """Return when `poll` may have something to do if nothing happens earlier, or inf if never."""

    # ------------------------------------------------------------------ commands

    @abstractmethod
    def refusal(self, what: Action) -> str | None:
        """Return why this car cannot do this at all, or None if it can."""

    @abstractmethod
    def frames(self, what: Action) -> tuple[Any, ...]:
        """Return the frames of an action on a part of the car. `poll` returns them later, one at a time.

        A frame that is a `Later` is due after its delay. Other commands can be sent meanwhile.
        """

    def part(self, what: Action) -> Hashable:
        """Return the part of the car on which an action acts. A new action ends a delayed one on the same part."""
        return (type(what), what.verb if isinstance(what, Signal) else "")

    @abstractmethod
    def accepts_commands(self, now: float) -> bool:
        """Return True if a command's frame may be written: no stop is in progress, or a command may replace it."""

    @abstractmethod
    def free_at(self, now: float) -> float:
        """Return when a motion can be sent to the car, as far as that is known."""

    def wait_words(self, now: float) -> str:
        """Name what must happen before the car may be driven, such as `its set-up`. Empty if at most a stop must."""
        del now
        return ""

    def drive_wait_words(self, now: float) -> str:
        """Name what a drive waits for, if it waits for more than other commands do. Empty if at most for a stop."""
        return self.wait_words(now)

    def drive_wait_s(self, busy_s: float, now: float) -> float:
        """Return the longest wait, in s, of a drive until its frame is written. `busy_s` is the wait for the car."""
        del now
        return busy_s

    def mode_wait_s(self, busy_s: float, now: float) -> float:
        """Return the longest wait, in s, of a mode until its frame is written. `busy_s` is the same for a motion."""
        del now
        return busy_s

    def opening_s(self, mode: Mode) -> float:
        """Return the maximum time, in s, for which the car is busy when it begins a mode."""
        del mode
        return 0.0

    # ------------------------------------------------------------------ stops

    @property
    @abstractmethod
    def shutting_down(self) -> bool:
        """Return True after `shut_down`."""

    @property
    @abstractmethod
    def not_stopped(self) -> str:
        """Return why the car was not stopped at the end of the gateway. Empty if it was stopped."""

    @property
    @abstractmethod
    def is_stopping(self) -> bool:
        """Return True if a stop is in progress."""

    @property
    def finished(self) -> bool:
        """Return True after `shut_down` if the stop is over or was given up: not shown in time, or the link is down."""
        return self.shutting_down and not self.is_stopping

    @abstractmethod
    def stop(self, why: FrameOrigin, now: float, pending: Pending | None = None) -> None:
        """Stop the car, also if it is in a mode. Join a stop in progress that is as strong.

        `pending` is the command that asked for the stop, if any.
        """

    @abstractmethod
    def end_motion(self, now: float, pending: Pending | None = None) -> None:
        """Stop the car at the end of a drive."""

    @abstractmethod
    def resume_motion(self, words: str, now: float) -> None:
        """End a stop that follows the end of a drive, because the car is driven again."""

    @abstractmethod
    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if a stop is requested now and its frames arrive."""

    @abstractmethod
    def shut_down(self, now: float) -> None:
        """Stop the car for the last time, and send no later commands, because the gateway ends."""

    def stop_if_open(self, now: float) -> None:
        """Stop the car, unless the link is down or the gateway shuts down."""
        if self.model.link_open and not self.shutting_down:
            self.stop(FrameOrigin.STOP, now)

    def end_doubt(self, now: float) -> None:
        """End the doubt about a car that did not show its last stop, because a person says that it is fine."""
        del now

    # ------------------------------------------------------------------ what outlives the gateway

    def kept(self) -> Mapping[str, Any]:
        """Return what was learned about the car, for its next gateway, as values of JSON."""
        return {}

    @property
    def opened_as(self) -> str:
        """Return what the next gateway must know to end a mode, such as the platform. A change is saved at once."""
        return ""

    # ------------------------------------------------------------------ the same for every family

    def on_voltage(self, voltage_v: float, now: float) -> None:
        """Update the battery, and stop the car if the policy requires it. A driver calls it with each voltage."""
        model = self.model
        changed = model.battery.on_voltage(voltage_v, loaded=model.motors is not Motors.OFF, now=now)
        if refusal := model.battery.refusal:
            self._reject_waiting(refusal, now)
        if not changed:
            return
        level, words = model.battery.level, f"{model.name}: {model.battery.words}"
        severity = {BatteryLevel.LOW: Level.WARNING, BatteryLevel.CRITICAL: Level.ERROR}
        self._log.log(severity.get(level or BatteryLevel.OK, Level.INFO), f"battery_{level}", words, now)
        if model.battery.action is BatteryAction.STOP and not model.at_rest:
            self.halt(words, now)
            self.stop_if_open(now)

    def _reject_waiting(self, words: str, now: float) -> None:
        """Reject the drive and the mode that were accepted but still wait: the battery is too low to begin them."""
        held = self.queue.held
        if held is not None and held.began_at is None:
            self.release(Phase.REJECTED, Reason.BATTERY_LOW, words, now)
        self.queue.close_mode_change(Phase.REJECTED, Reason.BATTERY_LOW, words, now)

    def halt(self, words: str, now: float, by: str = "") -> None:
        """Drop all commands, and shorten the lease. Refuse the drives of each sender that has just driven.

        Such a sender is refused until it has sent no drive for some time. `by` is the sender of the stop. It is refused
        only if it streams: a script may stop and drive again.
        """
        self.queue.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self.safety.shorten_lease(now)
        self.senders.halt(now, by)

    def end_drive(self, words: str, now: float) -> None:
        """End a held motion whose time is over. If its frame was written, record it as sent.

        If a reading shows a movement, add that to the record. A changed distance is no proof that the car really drove:
        something in front may have moved.
        """
        held, model = self.queue.held, self.model
        if held is None or held.began_at is None:  # the frame of the drive was not written
            self.queue.close_held(Phase.COMPLETE, None, words, now)
            return
        sent = f"sent for {now - held.began_at:.1f} s"
        moved = model.moved_since(held.range_cm, held.began_at)
        doubt = f"{model.name} may not have moved: {self.doubt_of_drive}" if self.doubt_of_drive else ""
        words = "; ".join(filter(None, (words, sent, moved or doubt)))
        evidence = (moved,) if moved else ()
        self.queue.close_held(Phase.SENT, None, words, now, basis=Basis.SENT, evidence=evidence)

    @property
    def doubt_of_drive(self) -> str:
        """Return why the car may have ignored a drive. Empty if there is no such reason."""
        return ""

    def release(self, phase: Phase, reason: Reason | None, words: str, now: float) -> None:
        """End the held motion, and stop the car as at the end of a drive, unless it is at rest."""
        if phase is Phase.COMPLETE:
            self.end_drive(words, now)
        else:
            self.queue.close_held(phase, reason, words, now)
        if self.model.link_open and not self.is_stopping and not self.model.at_rest:
            self.end_motion(now)

    def expire(self, now: float) -> None:
        """End the commands whose time is over."""
        held, car = self.queue.held, self.desk.car
        if held is not None and now >= self.queue.held_until:
            if now < held.expires_at:  # the drive has time left, but its sender is gone
                self.safety.mark_holder(held.sender.name, connected=False)
                self.release(Phase.EXPIRED, Reason.EXPIRED, f"its sender {held.sender.text_name} disconnected", now)
            elif held.pending.sent:
                words = ""
                if held.began_at is not None and held.began_at > held.pending.received_at + LATE_DRIVE_S:
                    waited_s = held.began_at - held.pending.received_at
                    words = f"began after {waited_s:.1f} s: {held.waited_for or f'{car} was busy'}"
                self.release(Phase.COMPLETE, None, words, now)
            else:  # the frame of the drive could not be written in all that time
                waited_s, waits = now - held.pending.received_at, self.drive_wait_words(now)
                words = f"{car} waits for {waits}" if waits else f"{car} was busy for {waited_s:.1f} s"
                self.release(Phase.EXPIRED, Reason.EXPIRED, words, now)
        self.queue.expire(now)

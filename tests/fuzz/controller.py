"""Random events for a controller, and the rules that always hold.

No car is at the other end, so any bytes may come: readings of every mode, half frames, noise. From every state, a stop
must write only stop frames, and must end. `driven.py` judges what a stop does to a car's motors.
"""

import copy
import random
from collections.abc import Callable
from typing import Any

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    Led,
    Lend,
    MoveArm,
    MoveServo,
    Pause,
    Resume,
    SetLight,
    SetMode,
    Signal,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.control_output import CommandRecord, OutgoingFrame
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.frames import Frame, General, LoneHash, ModeClose, ModeOpen
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.commands import Verb
from schemas.rights import NO_PEOPLE, Estop, FleetPause, People, Sender
from schemas.words import Basis, FrameOrigin, Light, Mode, Motion, Phase, Platform, Rank, Reason, ServoAction, SpeedStep
from tests.support.controls import Control, control

PLATFORMS = ("arduino", "stm32", "raspberry_pi", "unknown", "arduino+arm", "raspberry_pi+arm+imu")
SENDERS = [Sender(f"{kind}-{number}", kind) for kind in Rank for number in range(3)]
TABLES = [
    NO_PEOPLE,
    People.parse(["lead-0:lead", "lead-1:lead", "lead-2", "person-0", "script-0", "person-1:other"]),
    People.parse(["person-0", "script-0", "person-1:other"]),
]
MANUAL = b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#"
PI = b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#"
READINGS = (
    MANUAL,
    b"$4WD,CSB0.00,PV7.91,GS5,LF0000,HW00,GM00#",
    b"$4WD,CSB57,PV8.4,GS0,LF0000,HW00,GM00#",
    b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#",
    b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM11#",
    b"$4WD,CSB120,PV8.3,GS000,LF0000,HW10,GM00",
    b"$4WD,CSB1300,PV13,GS214,LF1011,HW01,GM10#",
    b"$4WD,J11,J22,J33,J44,J55,J66#",
    b"$4WD,MODE00#",
)
GAPS_S = (0.0, 0.001, 0.01, 0.05, 0.06, 0.2, 0.3, 0.7, 1.1, 1.1, 2.5, 4.6, 30.0)
JUMPS_S = (600.0, 86_400.0, 1e8)
ALL = ("all",)
"""Placeholder. `_command` puts the ids of the active e-stops in its place."""
SMALL = 300
"""Maximum number of items in any container of a controller or decoder."""
STOP_WITHIN_S = 45.0
"""Maximum time of a stop on a link that loses nothing."""


def anything(moments: random.Random) -> Action:
    """Return a random command, most often a drive."""
    match moments.randrange(16):
        case 0:
            return SetMode(moments.choice(list(Mode)))
        case 1:
            return Signal(Verb.WHISTLE)
        case 2:
            return SetLight(moments.choice(list(Light)))
        case 3:
            return MoveServo(moments.choice(list(ServoAction)))
        case 4:
            named: list[Action] = [AimServo(moments.randrange(181)), Led(255, 0, 7), MoveArm((90,) * 6)]
            return moments.choice(named)
        case 5:
            return ChangeSpeed(moments.choice(list(SpeedStep)))
        case 6:
            return Fan(moments.choice([None, True, False]))
        case 7:
            return moments.choice([Find(), TakeLease(), TakeLease(release=True)])  # type: ignore[return-value]  # joined to object
        case 11 if moments.random() < 0.5:
            borrower = moments.choice(SENDERS).name
            lent = [Lend(borrower, 5.0), Lend(borrower, 1e4)]
            return moments.choice([Pause(), Unpause(), Unpause(), *lent, EndLoan()])  # type: ignore[return-value]  # joined to object
        case 8:
            return Stop()
        case 9:
            return EmergencyStop(fleet_wide=moments.random() < 0.5) if moments.random() < 0.1 else Drive(Motion.STOP)
        case 10:
            return moments.choice([Resume(), Resume(("id7",)), Resume(ALL), Resume(all=True)])
        case _:
            return Drive(moments.choice(list(Motion)), moments.choice([0.01, 0.5, 0.5, 2.0, 10.0]))


def noise(moments: random.Random) -> bytes:
    """Return bytes that a car or a link may send."""
    match moments.randrange(6):
        case 0:
            return moments.randbytes(moments.randrange(64))
        case 1:
            reading = moments.choice(READINGS)
            return reading[: moments.randrange(len(reading))]
        case _:
            return moments.choice(READINGS)


class Wild:
    """A controller with random events. `step` does one random thing and checks the rules."""

    control: Control

    def __init__(self, seed: int) -> None:
        self.moments = random.Random(seed)
        self.now = 0.0
        self.writes = 0
        self.stops = 0
        self._restart()

    def _restart(self) -> None:
        kept = self.control.safety.persisted if hasattr(self, "control") else None
        self.control = control(
            parse_platform(self.moments.choice(PLATFORMS)),
            persisted=kept,
            people=self.moments.choice(TABLES),
            now=self.now,
            now_ns=int(self.now * 1e9),
        )
        self.decoder = FrameSplitter()
        self.linked = False
        self.ending = False
        self.doubted = False
        """True if readings have ever contradicted the platform. Control may then send the frames that stop any car."""
        self.free_at = float("-inf")
        self.owed = {"whistle": 0, "fan": 0, "speed": 0, "servo": 0, "named": 0}

    # ------------------------------------------------------------------ random events

    def step(self) -> None:
        """Do one random thing."""
        moments = self.moments
        chance = moments.random()
        if chance < 0.45:
            self._ask(anything(moments))
        elif chance < 0.70:
            self._pass(moments.choice(GAPS_S))
        elif chance < 0.90:
            self._hear(noise(moments))
        elif chance < 0.94:
            if not self.linked or moments.random() < 0.1:
                self._turn_link()
        elif chance < 0.97:
            name = moments.choice(SENDERS).name if moments.random() < 0.9 else f"n{moments.random()}"
            self.control.on_sender_token(name, alive=moments.random() < 0.5, now=self.now)
        elif chance < 0.98:
            self.control.driver.on_stall(moments.random(), self.now)
        elif chance < 0.99:
            estops = [Estop(f"id{moments.randrange(40)}", "ann", "", 1, moments.random() < 0.9)]
            shown = estops if moments.random() < 0.1 else []
            self.control.merge_estops(shown, [f"id{moments.randrange(40)}"], "blue", self.now)
            pauses = [FleetPause(f"id{moments.randrange(40)}", "ann", "", 1, moments.choice(list(Rank)))]
            shown_pauses = pauses if moments.random() < 0.1 else []
            self.control.merge_pauses(shown_pauses, [f"id{moments.randrange(40)}"], "blue", self.now)
        elif chance < 0.9995:
            self.control.record_rejection(self._command(Stop()), Reason.BAD_VALUE, "no", self.now)
        elif chance < 0.9998:
            self._pass(moments.choice(JUMPS_S))
        else:
            self.control.driver.shut_down(self.now)
            self.ending = True
        self._pump()
        if self.ending and (self.control.driver.finished or moments.random() < 0.01):
            self._restart()

    def _command(self, what: Action) -> Command:
        moments = self.moments
        if isinstance(what, EmergencyStop | Pause):
            identity = f"id{moments.randrange(40)}"
        else:
            identity = f"c{moments.randrange(10**9 if moments.random() < 0.9 else 50)}"
        if what == Resume(ALL):
            what = Resume(tuple(estop.id for estop in self.control.safety.estops))
        sender = moments.choice(SENDERS) if moments.random() < 0.95 else Sender(f"s{moments.random()}")
        return Command(
            identity,
            type(what).__name__,
            sender,
            what,
            age_s=moments.choice([None, None, 0.0, 0.1, 9.0]),
            take=moments.random() < 0.1,
            asked_ns=int(self.now * 1e9),
            streamed=isinstance(what, Drive) and moments.random() < 0.5,
        )

    def _ask(self, what: Action) -> None:
        answer = self.control.command(self._command(what), self.now)
        assert answer.status in (Phase.SENT, Phase.QUEUED, Phase.REJECTED)
        # Control carries out a resume that ends only some e-stops or holds. Its reason says that others remain.
        half = isinstance(what, Resume) and answer.reason in (Reason.ESTOPPED, Reason.HELD)
        assert half or (answer.reason is not None) == (answer.status is Phase.REJECTED)
        if answer.status is Phase.QUEUED:
            self._owe(what)

    def _owe(self, what: Action) -> None:
        match what:
            case Signal():
                self.owed["whistle"] += 1
            case MoveServo():
                self.owed["servo"] += 1
            case AimServo() | Led() | MoveArm():
                self.owed["named"] += 1
            case ChangeSpeed():
                self.owed["speed"] += 1
            case Fan():
                self.owed["fan"] += 1
            case Find():
                self.owed["whistle"] += 2
                self.owed["named"] += 2
            case _:
                pass

    def _pass(self, gap_s: float) -> None:
        self.now += gap_s
        for event in self.decoder.flush(self.now):
            self.control.driver.on_event(event, self.now)
        self.control.tick(self.now)

    def _hear(self, data: bytes) -> None:
        if self.linked:
            for event in self.decoder.feed(data, self.now):
                self.control.driver.on_event(event, self.now)

    def _turn_link(self) -> None:
        if self.linked:
            self.control.driver.link_down("unplugged", self.now)
        else:
            self.decoder = FrameSplitter()
            self.control.link_up(self.now)
            self.free_at = self.now
        self.linked = not self.linked

    def _pump(self) -> None:
        """Turn as the gateway's loop does when it wakes: at most three times before it sleeps."""
        for _ in range(3):
            self._turn()
            if self.control.driver.next_at(self.now) > self.now:
                return
        raise AssertionError("a loop that never sleeps")

    def _turn(self) -> None:
        write = self.control.driver.poll(self.now)
        if write is not None:
            self._check_write(write)
            self.writes += 1
            if self.moments.random() < 0.02:
                self.control.driver.link_down("cut", self.now, cause=Reason.WRITE_FAILED)
                self.linked = False
            else:
                self.control.driver.on_written(write, self.now)
                self.decoder.sends(write.data, self.now)
                self.free_at = self.now + self.control.driver.model.profile.block_s(write.frame)
            assert self.control.driver.poll(self.now) is None, "one frame in flight"
        self.control.take_records()

    # ------------------------------------------------------------------ rules

    def _check_write(self, write: OutgoingFrame) -> None:
        frame, control = write.frame, self.control
        assert self.linked, "nothing is written without a link"
        self.doubted = self.doubted or control.driver.model.platform.doubted or control.driver.model.platform.open_mode
        known = control.driver.model.profile.refusal(frame) is None
        assert known or (self.doubted and isinstance(frame, ModeClose)), "only what the platform knows"
        if write.why in (FrameOrigin.COMMAND, FrameOrigin.REPEAT) and not isinstance(frame, ModeClose):
            stopping = isinstance(frame, LoneHash) or frame == General(Motion.STOP)
            assert self.now >= self.free_at - 1e-9 or stopping, "not into a block of ours"
        self._check_motion(write)
        self._check_once(frame, write.why)

    def _check_motion(self, write: OutgoingFrame) -> None:
        """Require that control starts no car that is e-stopped or held, or whose gateway shuts down."""
        frame = write.frame
        if isinstance(frame, ModeOpen) or (isinstance(frame, General) and frame.motion is not Motion.STOP):
            assert not self.control.safety.estops
            assert self.control.safety.hold is None
            assert not self.ending
            self._check_mover(write)
            # What the car has not shown forbids nothing. But the first frames of a stop always go out before.
            running = self.control.driver.stops.running
            assert running is None or running.sent_once

    def _check_mover(self, write: OutgoingFrame) -> None:
        """Require that only a lead starts a paused car, and only the borrower or a lead starts a lent car."""
        queue, people, safety = self.control._queue, self.control.people, self.control.safety
        pending = queue.mode_change if isinstance(write.frame, ModeOpen) else queue.held and queue.held.pending
        assert pending is not None, "nobody moves it"
        mover, loan = pending.command.sender, safety.loan_at(self.now)
        if mover.kind is not Rank.LEAD:
            assert not safety.pauses
            assert loan is None or mover.person == loan.to or mover.person in people.leads
            borrowed = loan is not None and mover.person == loan.to
            assert borrowed or mover.kind is Rank.COORDINATOR or people.may_drive(mover.person)

    def _check_once(self, frame: Frame, why: FrameOrigin) -> None:
        """Require that control writes a one-time action at most once for each accepted command, never as a repeat."""
        acts: dict[str, bool] = {}
        if isinstance(frame, General):
            acts = {
                "whistle": frame.whistle,
                "fan": frame.fan,
                "speed": frame.speed is not None,
                "servo": frame.servo is not None,
            }
        elif not isinstance(frame, ModeOpen | ModeClose | LoneHash):
            clears = why is not FrameOrigin.COMMAND and frame == self.control.driver.model.believed.led
            acts = {"named": not clears}  # a stop may send the color that the car has
        for name, done in acts.items():
            if done:
                assert why is FrameOrigin.COMMAND
                self.owed[name] -= 1
                assert self.owed[name] >= 0, f"{name} was doubled"

    def check_memory(self) -> None:
        """Require that no container of the controller or the decoder has grown too large."""
        for name, size in sizes(self.control):
            assert size <= SMALL, f"{name} holds {size}"
        for name, size in sizes(self.decoder):
            assert size <= SMALL, f"{name} holds {size}"

    def check_stop(self) -> None:
        """Require that a stop from the current state writes only stop frames, and ends. The stop runs on a copy."""
        control = copy.deepcopy(self.control)
        now, linked = self.now, self.linked
        command = Command("the-stop", "stop", SENDERS[0], Stop())
        if not linked or self.ending:
            assert control.command(command, now).reason is Reason.LINK_DOWN
            if self.ending:
                return
            control.link_up(now)
        answer = control.command(command, now)
        assert answer.status is Phase.QUEUED
        assert 0 < answer.worst_case_s < 20.0
        self.stops += 1
        last = until_off(control, now)
        assert last is not None, "it has no end"
        # A command may fail if it joined a stop that got no answer for long. The stop itself goes on until it ends.
        assert last.phase is Phase.FAILED or last.basis == control.driver.model.basis, last
        assert last.phase is not Phase.FAILED or last.reason is Reason.NOT_SHOWN, last
        assert (last.phase is Phase.COMPLETE) == (last.basis == Basis.SHOWN), last
        assert control.driver.model.motors == "off"


def until_off(control: Control, now: float) -> CommandRecord | None:
    """Return the record that ends the stop. None if the stop does not end in time.

    The link loses nothing, and the car reports once a second while it is not blocked.
    """
    end, report_at, last = now + STOP_WITHIN_S, now + 1.0, None
    pi = control.driver.model.profile.kind is Platform.RASPBERRY_PI
    while now < end and (last is None or control.driver.model.motors != "off"):
        while (write := control.driver.poll(now)) is not None:
            frame = write.frame
            # The color clears a string that begins with `4WD,`. It is the one that the car has.
            clears = frame == control.driver.model.believed.led
            assert isinstance(frame, LoneHash | ModeClose) or frame == General(Motion.STOP) or clears, frame
            control.driver.on_written(write, now)
            report_at += 1.0 if isinstance(frame, ModeClose) and not pi else 0.0
        for record in control.take_records():
            if isinstance(record, CommandRecord) and record.command.id == "the-stop" and is_end(record):
                assert last is None, "it ends once"
                last = record
        now = min(control.driver.next_at(now), report_at)
        if now >= report_at:
            report_at = now + 1.0
            for event in FrameSplitter().feed(PI if pi else MANUAL, now):
                control.driver.on_event(event, now)
            control.tick(now)
    return last


def is_end(record: CommandRecord) -> bool:
    """Return True if the record ends a stop: as shown, as sent or as failed."""
    return record.phase in (Phase.COMPLETE, Phase.FAILED) or (record.phase is Phase.SENT and record.basis != "")


def sizes(thing: object, name: str = "", depth: int = 4) -> list[tuple[str, int]]:
    """Return the name and size of each container in an object."""
    if isinstance(thing, dict | list | set | tuple | bytearray) or hasattr(thing, "popleft"):
        return [(name, len(thing))]  # type: ignore[arg-type]  # a deque
    if depth == 0:
        return []
    found: list[tuple[str, int]] = []
    names: list[str] = [*getattr(thing, "__dict__", ()), *getattr(type(thing), "__slots__", ())]
    for each in names:
        value: Any = getattr(thing, each, None)
        if not isinstance(value, str | int | float | Callable | None):
            found += sizes(value, f"{name}.{each}", depth - 1)
    return found


def run(seed: int, steps: int, *, stop_every: int = 500) -> tuple[int, int]:
    """Do `steps` steps. Return the number of written frames and the number of checked stops."""
    wild = Wild(seed)
    for number in range(steps):
        try:
            wild.step()
            if number % stop_every == 0:
                wild.check_stop()
                wild.check_memory()
        except Exception as error:
            error.add_note(f"seed {seed}, step {number}, {wild.control.driver.model.profile.name}")
            raise
    return wild.writes, wild.stops

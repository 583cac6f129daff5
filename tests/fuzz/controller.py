"""Anything that can happen to a controller, at random, and what must hold whatever happens.

No car is at the other end here, so nothing limits what is heard: readings of every mode, halves, noise. What a stop
does to a car's motors is `driven.py`'s part; here: from every state a stop is all that is written, and it completes.
"""

import copy
import random
from collections.abc import Callable
from typing import Any

from gateway.control.commands import (
    Action,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    Lend,
    OneShot,
    Pause,
    Phase,
    Reason,
    Resume,
    Sender,
    SenderKind,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.controller import Controller
from gateway.control.estimate.trust import Basis, CarTrust
from gateway.control.events import CommandRecord, FrameOrigin, OutgoingFrame
from gateway.control.people import NO_PEOPLE, People
from gateway.control.safety import Estop, FleetPause
from gateway.protocol.decoder import Decoder
from gateway.protocol.enums import Light, Mode, Motion, ServoAction, SpeedStep
from gateway.protocol.frames import ArmSet, ColorLed, Frame, General, ModeClose, ModeOpen, Ptz, Reset
from gateway.protocol.platforms import Platform, parse_platform

PLATFORMS = ("arduino", "stm32", "raspberry_pi", "unknown", "arduino+arm", "raspberry_pi+arm+imu")
SENDERS = [Sender(f"{kind}-{number}", kind) for kind in SenderKind for number in range(3)]
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
"""To be replaced by those in force."""
SMALL = 300
"""No container of a controller holds more than this."""
STOP_WITHIN_S = 45.0
"""The longest a stop may go on once the link carries everything."""


def anything(moments: random.Random) -> Action:
    """One command, most of them drives."""
    match moments.randrange(16):
        case 0:
            return SetMode(moments.choice(list(Mode)))
        case 1:
            return OneShot(General(Motion.STOP, whistle=True))
        case 2:
            return OneShot(General(Motion.STOP, light=moments.choice(list(Light))))
        case 3:
            return OneShot(General(Motion.STOP, servo=moments.choice(list(ServoAction))))
        case 4:
            return OneShot(moments.choice([Ptz(moments.randrange(181)), ColorLed(255, 0, 7), ArmSet((90,) * 6)]))  # type: ignore[arg-type]  # joined to object
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
    """What a car, or a link, may send."""
    match moments.randrange(6):
        case 0:
            return moments.randbytes(moments.randrange(64))
        case 1:
            reading = moments.choice(READINGS)
            return reading[: moments.randrange(len(reading))]
        case _:
            return moments.choice(READINGS)


class Wild:
    """A controller to which anything happens. `step` does one thing and checks what must hold."""

    control: Controller

    def __init__(self, seed: int) -> None:
        self.moments = random.Random(seed)
        self.now = 0.0
        self.writes = 0
        self.stops = 0
        self._restart()

    def _restart(self) -> None:
        kept = self.control.safety.persisted if hasattr(self, "control") else None
        self.control = Controller(
            "red",
            parse_platform(self.moments.choice(PLATFORMS)),
            persisted=kept,
            people=self.moments.choice(TABLES),
            now=self.now,
            now_ns=int(self.now * 1e9),
        )
        self.decoder = Decoder()
        self.linked = False
        self.ending = False
        self.doubted = False
        """What is heard has ever spoken against the platform: what stops any car may be sent."""
        self.free_at = float("-inf")
        self.owed = {"whistle": 0, "fan": 0, "speed": 0, "servo": 0, "named": 0}

    # ------------------------------------------------------------------ what happens

    def step(self) -> None:
        """One thing happens."""
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
            self.control.on_stall(moments.random(), self.now)
        elif chance < 0.99:
            estops = [Estop(f"id{moments.randrange(40)}", "ann", "", 1, moments.random() < 0.9)]
            shown = estops if moments.random() < 0.1 else []
            self.control.merge_estops(shown, [f"id{moments.randrange(40)}"], "blue", self.now)
            pauses = [FleetPause(f"id{moments.randrange(40)}", "ann", "", 1, moments.choice(list(SenderKind)))]
            shown_pauses = pauses if moments.random() < 0.1 else []
            self.control.merge_pauses(shown_pauses, [f"id{moments.randrange(40)}"], "blue", self.now)
        elif chance < 0.9995:
            self.control.record_rejection(self._command(Stop()), Reason.BAD_VALUE, "no", self.now)
        elif chance < 0.9998:
            self._pass(moments.choice(JUMPS_S))
        else:
            self.control.shut_down(self.now)
            self.ending = True
        self._pump()
        if self.ending and (self.control.stops.finished or moments.random() < 0.01):
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
        # A resume that ends a part of what stops a car is carried out, and says what stays.
        half = isinstance(what, Resume) and answer.reason in (Reason.ESTOPPED, Reason.HELD)
        assert half or (answer.reason is not None) == (answer.status is Phase.REJECTED)
        if answer.status is Phase.QUEUED:
            self._owe(what)

    def _owe(self, what: Action) -> None:
        match what:
            case OneShot(General() as frame):
                self.owed["whistle"] += frame.whistle
                self.owed["servo"] += frame.servo is not None
            case OneShot():
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
        for event in self.decoder.tick(self.now):
            self.control.on_event(event, self.now)
        self.control.tick(self.now)

    def _hear(self, data: bytes) -> None:
        if self.linked:
            for event in self.decoder.feed(data, self.now):
                self.control.on_event(event, self.now)

    def _turn_link(self) -> None:
        if self.linked:
            self.control.link_down("unplugged", self.now)
        else:
            self.decoder = Decoder()
            self.control.link_up(self.now)
            self.free_at = self.now
        self.linked = not self.linked

    def _pump(self) -> None:
        """What the loop does when it wakes: it never turns more than a few times without sleeping."""
        for _ in range(3):
            self._turn()
            if self.control.next_at(self.now) > self.now:
                return
        raise AssertionError("a loop that never sleeps")

    def _turn(self) -> None:
        write = self.control.poll(self.now)
        if write is not None:
            self._check_write(write)
            self.writes += 1
            if self.moments.random() < 0.02:
                self.control.on_write_failed("cut", self.now)
                self.linked = False
            else:
                self.control.on_written(write, self.now)
                self.decoder.sent(write.data, self.now)
                self.free_at = self.now + self.control.model.profile.block_s(write.frame)
            assert self.control.poll(self.now) is None, "one frame in flight"
        self.control.take_records()

    # ------------------------------------------------------------------ what must hold

    def _check_write(self, write: OutgoingFrame) -> None:
        frame, control = write.frame, self.control
        assert self.linked, "nothing is written without a link"
        self.doubted = self.doubted or control.model.platform.doubted
        known = control.model.profile.refusal(frame) is None
        assert known or (self.doubted and isinstance(frame, ModeClose)), "only what the platform knows"
        if write.why in (FrameOrigin.COMMAND, FrameOrigin.REPEAT) and not isinstance(frame, ModeClose):
            stopping = isinstance(frame, General) and frame == General(Motion.STOP)
            assert self.now >= self.free_at - 1e-9 or stopping, "not into a block of ours"
        self._check_motion(write)
        self._check_once(frame, write.why)

    def _check_motion(self, write: OutgoingFrame) -> None:
        """E-stopped, held or ending, a car is never set going."""
        frame = write.frame
        if isinstance(frame, ModeOpen) or (isinstance(frame, General) and frame.motion is not Motion.STOP):
            assert not self.control.safety.estops
            assert self.control.safety.hold is None
            assert not self.ending
            self._check_mover(write)
            # A car that is heard but shows no stop may be driven by whoever sees it; a car of unknown state may not.
            assert self.control.model.known or self.control.model.trust.state is CarTrust.UNPROVEN

    def _check_mover(self, write: OutgoingFrame) -> None:
        """Paused, a car is set going by a lead only; lent, by the borrower or a lead."""
        queue, people, safety = self.control._queue, self.control.people, self.control.safety
        pending = queue.mode_change if isinstance(write.frame, ModeOpen) else queue.held and queue.held.pending
        assert pending is not None, "nobody moves it"
        mover, loan = pending.command.sender, safety.loan_at(self.now)
        if mover.kind is not SenderKind.LEAD:
            assert not safety.pauses
            assert loan is None or mover.person == loan.to or mover.person in people.leads
            borrowed = loan is not None and mover.person == loan.to
            assert borrowed or mover.kind is SenderKind.COORDINATOR or people.may_drive(mover.person)

    def _check_once(self, frame: Frame, why: FrameOrigin) -> None:
        """What acts once is written once for each command that was accepted, and never repeated."""
        acts: dict[str, bool] = {}
        if isinstance(frame, General):
            acts = {
                "whistle": frame.whistle,
                "fan": frame.fan,
                "speed": frame.speed is not None,
                "servo": frame.servo is not None,
            }
        elif not isinstance(frame, ModeOpen | ModeClose | Reset):
            acts = {"named": True}
        for name, done in acts.items():
            if done:
                assert why is FrameOrigin.COMMAND
                self.owed[name] -= 1
                assert self.owed[name] >= 0, f"{name} was doubled"

    def check_memory(self) -> None:
        """Nothing grows."""
        for name, size in sizes(self.control):
            assert size <= SMALL, f"{name} holds {size}"
        for name, size in sizes(self.decoder):
            assert size <= SMALL, f"{name} holds {size}"

    def check_stop(self) -> None:
        """From the state that it is in now a stop is all that is written, and it completes; this state itself stays."""
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
        # What joined a stop that nobody had answered for long may fail; the stop itself goes on until it is over.
        assert last.phase is Phase.FAILED or last.basis == control.model.basis, last
        assert last.phase is not Phase.FAILED or last.reason is Reason.NOT_SHOWN, last
        assert (last.phase is Phase.COMPLETE) == (last.basis == Basis.SHOWN), last
        assert control.model.motors == "off"


def until_off(control: Controller, now: float) -> CommandRecord | None:
    """The link carries everything, and the car reports once a second in which it is not blocked: how the stop ends."""
    end, report_at, last = now + STOP_WITHIN_S, now + 1.0, None
    pi = control.model.profile.kind is Platform.RASPBERRY_PI
    while now < end and (last is None or control.model.motors != "off"):
        while (write := control.poll(now)) is not None:
            frame = write.frame
            assert isinstance(frame, Reset | ModeClose) or frame == General(Motion.STOP), frame
            control.on_written(write, now)
            report_at += 1.0 if isinstance(frame, ModeClose) and not pi else 0.0
        for record in control.take_records():
            if isinstance(record, CommandRecord) and record.command.id == "the-stop" and is_end(record):
                assert last is None, "it ends once"
                last = record
        now = min(control.next_at(now), report_at)
        if now >= report_at:
            report_at = now + 1.0
            for event in Decoder().feed(PI if pi else MANUAL, now):
                control.on_event(event, now)
            control.tick(now)
    return last


def is_end(record: CommandRecord) -> bool:
    """Return True for the last record of a stop: as shown, as sent, or as failed."""
    return record.phase in (Phase.COMPLETE, Phase.FAILED) or (record.phase is Phase.SENT and record.basis != "")


def sizes(thing: object, name: str = "", depth: int = 4) -> list[tuple[str, int]]:
    """The containers in an object, and how much each holds."""
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
    """So many steps; how many frames were written, and how many stops were checked."""
    wild = Wild(seed)
    for number in range(steps):
        try:
            wild.step()
            if number % stop_every == 0:
                wild.check_stop()
                wild.check_memory()
        except Exception as error:
            error.add_note(f"seed {seed}, step {number}, {wild.control.model.profile.name}")
            raise
    return wild.writes, wild.stops

"""Actions that last, in both families: how long, what goes out meanwhile, and what ends them."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gateway.control.command_queue import CommandQueue
from gateway.control.command_records import CommandLog, Pending
from gateway.control.commands import Action, Command, Drive, Find, Led, SetLight, SetMode, Signal, Stop
from gateway.control.control_output import CommandRecord, Later
from gateway.control.controller import Controller
from gateway.control.safety_state import PersistedSafety, Safety
from gateway.control.sender_presence import Senders
from gateway.drivers import Family
from gateway.drivers.check import Bench
from gateway.drivers.yahboom.driver import YahboomDriver
from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.commands import Verb
from schemas.limits import MAX_QUEUE_TIME_S
from schemas.rights import Sender
from schemas.words import Light, Mode, Motion, Phase, Reason
from tests.gateway.control.workbench import Workbench
from tests.support import tank

BLINK_S = 0.5
MINUTE = Signal(Verb.WHISTLE, 60.0)
MANY = 80
"""Frames of `Find`, which lasts for longer than a command may wait, without a delay of its own."""
ON, OFF, WHITE = b"on\n", b"off\n", b"white\n"
FORWARD = Drive(Motion.FORWARD, 2.0)


def blinks(on: Any, off: Any, duration_s: float) -> tuple[Any, ...]:
    """Return the frames of a lamp that blinks."""
    return on, *(Later(off if number % 2 else on, BLINK_S) for number in range(1, round(duration_s / BLINK_S) + 1))


class LampTank(tank.TankDriver):
    """A tank with a lamp."""

    def part_frames(self, what: Action) -> Any:  # more than a tank without one may return
        """Return the lines of the lamp."""
        match what:
            case Signal(Verb.WHISTLE, duration_s):
                return blinks(ON, OFF, duration_s)
            case SetLight():
                return (WHITE,)
            case Find():
                return (ON,) * MANY
            case _:
                return None


class LampCar(YahboomDriver):
    """A car of the first family that blinks."""

    def _frames_of(self, what: Action) -> tuple[Frame | Later, ...]:
        match what:
            case Signal(Verb.WHISTLE, duration_s):
                return blinks(ColorLed(255, 0, 0), ColorLed(0, 0, 0), duration_s)
            case Find():
                return (ColorLed(255, 0, 0),) * (4 * MANY)
            case _:
                return super()._frames_of(what)


class Blinker:
    """A connected car with a lamp, on virtual time. It wakes when its driver says so."""

    white: Action
    began_at: float

    def ask(self, what: Action) -> str:
        """Give a command, and return its id."""
        raise NotImplementedError

    def run(self, seconds: float) -> None:
        """Let time pass."""
        raise NotImplementedError

    @property
    def lit(self) -> list[float]:
        """Return when the lamp was switched on or off, s from the beginning."""
        raise NotImplementedError

    @property
    def records(self) -> list[CommandRecord]:
        """Return all records."""
        raise NotImplementedError

    def life(self, identity: str) -> list[Phase]:
        """Return the phases of a command."""
        return [each.phase for each in self.records if each.command.id == identity]


class TankBlinker(Blinker):
    """The lamp of a tank."""

    white = SetLight(Light.WHITE)

    def __init__(self) -> None:
        family = SimpleNamespace(driver_of=lambda *_: LampTank)
        self._bench = Bench(cast("Family", family), "tank", tank.SAMPLES)
        self._bench.control.link_up(self._bench.now)
        self._bench.run(2.0)
        self.began_at = self._bench.now

    def ask(self, what: Action) -> str:
        """Give a command, and return its id."""
        return self._bench.ask(what)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self._bench.run(seconds)

    @property
    def lit(self) -> list[float]:
        """Return when the lamp was switched on or off, s from the beginning."""
        return [at - self.began_at for at, data, _ in self._bench.sent if data in (ON, OFF)]

    @property
    def records(self) -> list[CommandRecord]:
        """Return all records."""
        return self._bench.records


class CarBlinker(Blinker):
    """The LED of a car of the first family."""

    white = Led(255, 255, 255)

    def __init__(self) -> None:
        self.desk = Workbench()
        profile = parse_platform("arduino")
        self.desk.control = Controller("red", lambda desk: LampCar(desk, profile), now=self.desk.now)
        self.desk.ready()
        self.began_at = self.desk.now

    def ask(self, what: Action) -> str:
        """Give a command, and return its id."""
        self.desk.ask(what)
        return f"c{self.desk.number}"

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.desk.run(seconds)

    @property
    def lit(self) -> list[float]:
        """Return when the LED was switched on or off, s from the beginning."""
        colors = (b"$4WD,CLR255,CLG0,CLB0#", b"$4WD,CLR0,CLG0,CLB0#")
        return [at - self.began_at for at, data, _ in self.desk.sent if data in colors]

    @property
    def records(self) -> list[CommandRecord]:
        """Return all records."""
        return self.desk.records


@pytest.fixture(params=[TankBlinker, CarBlinker])
def lamp(request: pytest.FixtureRequest) -> Blinker:
    """Return the lamp of a car of each family."""
    made: Blinker = request.param()
    return made


def test_lasting_signal_has_asked_duration(lamp: Blinker) -> None:
    blink = lamp.ask(MINUTE)
    assert lamp.life(blink)[-1] is Phase.SENT, "recorded when it begins"
    lamp.run(70.0)
    assert len(lamp.lit) == 121
    assert lamp.lit[-1] == pytest.approx(60.0, abs=3.0)
    gaps = [after - before for before, after in pairwise(lamp.lit)]
    assert min(gaps) >= BLINK_S - 1e-6
    assert max(gaps) < BLINK_S + 0.1, "the writer is woken for each frame"
    assert lamp.life(blink).count(Phase.SENT) == 1
    assert lamp.life(blink)[-1] is Phase.SENT


def test_stop_ends_lasting_action_at_once(lamp: Blinker) -> None:
    blink = lamp.ask(MINUTE)
    lamp.run(5.0)
    lamp.ask(Stop())
    assert lamp.life(blink)[-1] is Phase.SUPERSEDED
    before = len(lamp.lit)
    lamp.run(5.0)
    assert len(lamp.lit) == before


def test_same_command_replaces_lasting_action(lamp: Blinker) -> None:
    blink = lamp.ask(MINUTE)
    lamp.run(5.0)
    again = lamp.ask(Signal(Verb.WHISTLE, 2.0))
    assert lamp.life(blink)[-1] is Phase.SUPERSEDED
    lamp.run(10.0)
    assert lamp.life(again)[-1] is Phase.SENT
    assert lamp.lit[-1] == pytest.approx(7.0, abs=0.3)


def test_other_commands_go_out_meanwhile(lamp: Blinker) -> None:
    blink = lamp.ask(MINUTE)
    lamp.run(5.2)
    light, drive = lamp.ask(lamp.white), lamp.ask(FORWARD)
    lamp.run(0.2)
    assert lamp.life(light)[-1] is Phase.SENT
    assert Phase.SENT in lamp.life(drive)
    lamp.run(1.5)
    assert lamp.lit[-1] > 6.0, "it lasts while the car drives"
    lamp.run(60.0)
    assert len(lamp.lit) == 121
    assert lamp.life(blink)[-1] is Phase.SENT


def test_action_of_many_frames_does_not_expire_while_sent(lamp: Blinker) -> None:
    find = lamp.ask(Find())
    lamp.run(MAX_QUEUE_TIME_S + 1.0)
    assert lamp.life(find)[-1] is Phase.QUEUED, "it lasts longer than a command may wait"
    lamp.run(60.0)
    assert lamp.life(find)[-1] is Phase.SENT


def test_mode_ends_lasting_action_without_waiting() -> None:
    lamp = CarBlinker()
    blink = lamp.ask(MINUTE)
    lamp.run(5.0)
    mode = lamp.ask(SetMode(Mode.TRACKING))
    lamp.run(3.0)
    assert Phase.SENT in lamp.life(mode)
    assert lamp.life(blink)[-1] is Phase.SUPERSEDED
    before = len(lamp.lit)
    lamp.run(5.0)
    assert len(lamp.lit) == before


def test_begun_lasting_action_expiry() -> None:
    log = CommandLog()
    queue = CommandQueue(log, Senders(), Safety.restore(PersistedSafety(), 0.0, 0))
    pending = Pending(Command("it", "whistle", Sender(), MINUTE), 0.0)
    queue.add_part_action(pending, ("on", Later("off", 40.0)), "lamp", 0.0)
    queue.on_part_action_written(pending, 1.0)
    queue.expire(41.0 + MAX_QUEUE_TIME_S - 0.1)
    assert queue.deadlines() == [41.0 + MAX_QUEUE_TIME_S]
    queue.expire(41.0 + MAX_QUEUE_TIME_S)
    last = log.take_records()[-1]
    assert isinstance(last, CommandRecord)
    assert (last.phase, last.reason) == (Phase.EXPIRED, Reason.EXPIRED)
    assert not queue.part_actions

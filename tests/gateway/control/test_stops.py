"""`stop` through control, at random moments in every mode and load; the judge is the simulated car's motors."""

import random
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from gateway.control.records import Act, Drive, Fan, Phase, SetMode, Stop
from gateway.protocol.encode import ColorLed, General, Ptz
from gateway.protocol.values import Mode, Motion
from gateway.sim.core.raspberry_pi import Transport
from gateway.sim.core.world import World
from tests.support.virtual import Pair

MOMENTS = 40
AVOIDING = 4.3
WHISTLE = Act(General(Motion.STOP, whistle=True))

Load = Callable[[Pair, random.Random], None]


def rest(pair: Pair, moments: random.Random) -> None:
    pair.run(3 * moments.random())


def driving(pair: Pair, moments: random.Random) -> None:
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(3 * moments.random())


def steering(pair: Pair, moments: random.Random) -> None:
    """A new motion every 50 to 250 ms: what a joystick does."""
    for _ in range(12):
        pair.ask(Drive(moments.choice([Motion.FORWARD, Motion.LEFT, Motion.SPIN_RIGHT, Motion.BACK]), 0.5))
        pair.run(0.05 + 0.2 * moments.random())


def let_go(pair: Pair, moments: random.Random) -> None:
    """Within the soft stop after a drive."""
    pair.ask(Drive(Motion.FORWARD, 0.3))
    pair.run(0.3 + 1.3 * moments.random())


def acting(pair: Pair, moments: random.Random) -> None:
    """One-shots of every kind queue while it drives."""
    pair.ask(Drive(Motion.FORWARD, 10.0))
    for what in (WHISTLE, Act(Ptz(30)), Act(ColorLed(1, 2, 3)), WHISTLE, Act(Ptz(120))):
        pair.ask(what)
    pair.run(2.5 * moments.random())


def fan(pair: Pair, moments: random.Random) -> None:
    pair.ask(Fan())
    pair.run(1.5)
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(2 * moments.random())


def opening(mode: Mode) -> Load:
    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(0.5)
        pair.ask(SetMode(mode))
        pair.run(5.0 * moments.random())

    return load


def inside(mode: Mode) -> Load:
    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(SetMode(mode))
        pair.run(5.0 + 6.0 * moments.random())

    return load


@dataclass(frozen=True)
class Case:
    name: str
    load: Load
    platform: str = "arduino"
    world: Callable[[], World] = World.room
    told: str | None = None
    transport: Transport = Transport.SERIAL

    def __str__(self) -> str:
        where = "-no-echo" if self.world == World.open_field else ""
        return f"{self.platform}-{self.transport}-{self.name}{where}{'-untold' if self.told else ''}"


OPENED = [mode for mode in Mode if mode is not Mode.MANUAL]
BASIC: list[tuple[str, Load]] = [
    ("rest", rest),
    ("driving", driving),
    ("steering", steering),
    ("let-go", let_go),
    ("acting", acting),
    ("fan", fan),
]
CASES = [
    *(Case(name, load) for name, load in BASIC),
    *(Case(name, load, world=World.open_field) for name, load in BASIC),
    *(Case(f"opening-{mode}", opening(mode)) for mode in OPENED),
    *(Case(f"in-{mode}", inside(mode)) for mode in OPENED),
    *(Case(f"opening-{mode}", opening(mode), world=World.open_field) for mode in (Mode.TRACKING, Mode.COLOR_LED)),
    *(Case(name, load, "stm32") for name, load in BASIC[:3]),
    *(
        Case(name, load, "raspberry_pi", transport=transport)
        for transport in Transport
        for name, load in [("rest", rest), ("driving", driving), ("steering", steering), ("let-go", let_go)]
    ),
    *(Case(name, load, told="unknown") for name, load in BASIC[:4]),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_stop_at_any_moment_stops_for_good_within_the_announced_time(case: Case) -> None:
    for seed in range(MOMENTS):
        moments = random.Random(seed)
        pair = Pair(case.platform, seed=seed, world=case.world(), told=case.told, transport=case.transport, start_s=2.0)
        pair.ready()
        pair.run(moments.random())
        case.load(pair, moments)
        asked_at = pair.now
        answer = pair.ask(Stop(), verb="stop", identity="the-stop")
        pair.run(9.0)
        took = pair.off_for_good_at() - asked_at
        assert took <= answer.worst_case_s, f"seed {seed}: {took:.3f} s, announced {answer.worst_case_s:.3f} s"
        complete = [record.took_s for record in pair.records if record.phase is Phase.COMPLETE][-1]
        assert took <= complete, f"seed {seed}: complete after {complete:.3f} s, the motors ran for {took:.3f} s"
        assert pair.phases("the-stop")[-1] is Phase.COMPLETE
        assert pair.control.motors == "off"
        if "avoidance" not in case.name:
            assert took < 4.0, f"seed {seed}: {took:.3f} s"


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi"])
@pytest.mark.parametrize("world", [World.room, World.open_field], ids=["echo", "no-echo"])
def test_a_drive_that_is_over_stops_the_car_softly(platform: str, world: Callable[[], World]) -> None:
    """protocol.md, soft: 0.02 s; with no echo up to 1.0 s, with a frame of ours in the buffer 1.1 s more."""
    bound = 0.1 if world is World.room else 1.0 + 1.1 + 0.1
    for seed in range(MOMENTS):
        moments = random.Random(seed)
        pair = Pair(platform, seed=seed, world=world(), transport=Transport.TCP, start_s=2.0).ready()
        pair.run(moments.random())
        asked_at = pair.now
        pair.ask(Drive(Motion.FORWARD, 0.7), identity="drive")
        pair.run(6.0)
        assert pair.off_for_good_at() <= asked_at + 0.7 + bound, f"seed {seed}"
        assert pair.phases("drive") == [Phase.ASKED, Phase.QUEUED, Phase.SENT, Phase.COMPLETE]
        assert not any(b"MODE" in data for at, data in pair.sent if at > asked_at), (
            "a soft stop keeps the car in mode 0"
        )


def test_a_mode_is_never_opened_while_the_motors_are_on() -> None:
    for seed in range(MOMENTS):
        moments = random.Random(seed)
        pair = Pair(seed=seed, world=moments.choice([World.room, World.open_field])(), start_s=2.0).ready()
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(2 * moments.random())
        pair.ask(SetMode(Mode.COLOR_LED), identity="mode")
        pair.until(lambda pair=pair: Phase.SENT in pair.phases("mode"), 6.0)
        assert pair.sent[-1][1] == b"$4WD,MODE41#"
        pair.run(10.0)
        assert pair.off_for_good_at() < pair.sent[-1][0], f"seed {seed}: {pair.sent}"
        assert pair.car.truth.mode == "color_led"

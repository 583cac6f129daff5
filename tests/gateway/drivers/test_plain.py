"""The plain engine, with the tank: what waits, repeats, gives way and ends."""

import json
from types import SimpleNamespace
from typing import cast

import pytest

from gateway.control.commands import ChangeSpeed, Drive, Find, Stop
from gateway.control.controller import Controller
from gateway.control.driver import Driver, Event
from gateway.drivers import Family
from gateway.drivers.check import Bench
from gateway.drivers.plain import RENEWAL_S
from schemas.words import Basis, CarTrust, FrameOrigin, Motion, Motors, Phase, Reason, Shows, SpeedStep
from tests.support import tank

REPORT = b'{"v":7.9,"dist_cm":42}\n'


class TankBench(Bench):
    """A tank that reports."""

    def __init__(self, speed_max: float = 1.0) -> None:
        super().__init__(cast("Family", tank), "tank")
        self.control = Controller("red", tank.driver_of("tank", {}), speed_max=speed_max)
        self.reports = True

    def run(self, seconds: float) -> None:
        """Let time pass, with a report each 0.2 s."""
        for _ in range(round(seconds / 0.2)):
            for event in self.control.driver.feed(REPORT if self.reports else b"", self.now):
                self.control.driver.on_event(event, self.now)
            super().run(0.2)

    def moves(self, since: float = 0.0) -> list[list[float]]:
        """Return the motions that were written since then."""
        return [json.loads(data.splitlines()[-1])["move"] for at, data, _ in self.sent if at >= since]


@pytest.fixture
def bench() -> TankBench:
    """Return a connected tank at rest."""
    made = TankBench()
    made.control.link_up(made.now)
    made.run(1.0)
    assert made.control.driver.model.trust.state is CarTrust.STOPPED
    return made


def test_plain_drive_ends_with_repeated_sent_stop(bench: TankBench) -> None:
    drive = bench.ask(Drive(Motion.FORWARD, 1.0))
    bench.run(1.6)
    assert bench.moves()[-3:] == [[0.5, 0.5], [0, 0], [0, 0]]
    last = bench.last(drive)
    assert last is not None
    assert (last.phase, last.basis) == (Phase.SENT, Basis.SENT)
    assert (bench.control.driver.model.motors, bench.control.driver.model.basis) == (Motors.OFF, Basis.SENT)
    before = len(bench.sent)
    bench.run(2 * RENEWAL_S + 1.0)
    repeats = bench.sent[before:]
    assert [why for _, _, why in repeats] == [FrameOrigin.REPEAT] * 2, "nothing shows that it arrived"
    assert {data for _, data, _ in repeats} == {b'#\n{"move": [0.0, 0.0]}\n'}


@pytest.mark.parametrize("before_s", [0.0, 0.2, 0.4, 0.6])
def test_speed_change_at_end_of_drive_starts_no_car(bench: TankBench, before_s: float) -> None:
    bench.ask(Drive(Motion.FORWARD, 1.0))
    bench.run(1.0 - before_s)
    bench.ask(ChangeSpeed(SpeedStep.UP))
    bench.run(3.0)
    assert bench.moves()[-2:] == [[0, 0], [0, 0]]
    assert bench.control.driver.model.at_rest
    bench.ask(Drive(Motion.FORWARD, 0.4))
    assert bench.moves()[-1] == [0.6, 0.6]


def test_speed_change_applies_at_once_while_driving(bench: TankBench) -> None:
    bench.ask(Drive(Motion.FORWARD, 2.0))
    bench.run(0.4)
    bench.ask(ChangeSpeed(SpeedStep.DOWN))
    bench.run(0.4)
    assert bench.moves()[-1] == [0.4, 0.4]


def test_change_of_speed_behind_a_stop_drives_nothing(bench: TankBench) -> None:
    bench.ask(Drive(Motion.FORWARD, 5.0))
    bench.run(0.4)
    stopped_at = bench.now
    stop = bench.ask(Stop())
    bench.ask(ChangeSpeed(SpeedStep.UP))
    bench.run(2.0)
    assert all(move == [0, 0] for move in bench.moves(stopped_at))
    last = bench.last(stop)
    assert last is not None
    assert last.phase is Phase.SENT, "the part of the car does not end the stop"
    assert bench.control.driver.model.at_rest


def test_stop_of_silent_car_announces_time_and_fails(bench: TankBench) -> None:
    """The client takes a stop without a worst case for one of a car at rest: `fleet stop` said that it was sent."""
    bench.ask(Drive(Motion.FORWARD, 30.0))
    bench.run(0.4)
    bench.reports = False
    bench.run(3.0)
    stop = bench.ask(Stop())
    (queued,) = [each for each in bench.records if each.command.id == stop and each.phase is Phase.QUEUED]
    assert queued.worst_case_s > 0
    bench.run(10.0)
    last = bench.last(stop)
    assert last is not None
    assert last.phase is Phase.FAILED


@pytest.mark.parametrize("speed_max", [0.05, 0.3, 1.0])
def test_speed_max_limits_speed_from_start(speed_max: float) -> None:
    driver = Controller[Driver]("red", tank.driver_of("tank", {}), speed_max=speed_max).driver
    assert driver.model.outputs.speed == min(0.5, speed_max)
    for step in (SpeedStep.UP, SpeedStep.DOWN):
        bench = TankBench(speed_max)
        bench.control.link_up(bench.now)
        bench.run(1.0)
        for _ in range(7):
            bench.ask(ChangeSpeed(step))
            bench.run(0.6)
        bench.ask(Drive(Motion.FORWARD, 0.4))
        assert 0 < bench.moves()[-1][0] <= speed_max


@pytest.mark.parametrize("speed_max", [0.15, 0.55, 0.75, 1.0])
def test_speed_reaches_its_maximum_by_steps_up(speed_max: float) -> None:
    bench = TankBench(speed_max)
    bench.control.link_up(bench.now)
    bench.run(1.0)
    for step in (SpeedStep.DOWN, *[SpeedStep.UP] * 7):
        last = bench.ask(ChangeSpeed(step))
        bench.run(0.6)
    refused = bench.last(last)
    assert refused is not None
    assert refused.phase is Phase.REJECTED
    assert f"{speed_max:.0%} " in refused.words
    assert ("speed_max" in refused.words) is (speed_max < 1.0)
    bench.ask(Drive(Motion.FORWARD, 0.4))
    assert bench.moves()[-1][0] == pytest.approx(speed_max)


def test_action_without_frames_is_refused(bench: TankBench) -> None:
    find = bench.ask(Find())
    bench.run(1.0)
    last = bench.last(find)
    assert last is not None
    assert (last.phase, last.reason) == (Phase.REJECTED, Reason.UNSUPPORTED)


class Rolls(tank.TankDriver):
    """Takes a great distance for turning wheels, and a small one for standing ones."""

    MOVES_UNASKED = "Close its page."

    @property
    def can_show(self) -> bool:
        return True

    def on_reading(self, event: Event, now: float) -> None:
        if cast("tank.TankReport", event).dist_cm > 100:
            self.model.turned_at = event.at
        else:
            self.show_rest("it is near", now)


@pytest.mark.parametrize("interval_s", [0.02, 0.2])
def test_car_that_moves_unasked_is_stopped_and_named(interval_s: float) -> None:
    bench = Bench(cast("Family", SimpleNamespace(driver_of=lambda name, kept: Rolls)), "tank", tank.SAMPLES)
    bench.control.link_up(bench.now)
    bench.run(2.0)
    driver, model = bench.control.driver, bench.control.driver.model
    assert (model.trust.state, model.basis, model.shows_stops[0]) == (CarTrust.STOPPED, Basis.SHOWN, Shows.YES)
    began, bench.samples = bench.now, ()
    for _ in range(round(1.0 / interval_s)):
        for event in driver.feed(b'{"v":7.9,"dist_cm":200}\n', bench.now):
            driver.on_event(event, bench.now)
        bench.run(interval_s)
    assert (model.motors, model.basis) != (Motors.OFF, Basis.SHOWN)
    assert bench.stop_frames(began)


def test_silent_car_is_stopped_again_and_again(bench: TankBench) -> None:
    bench.reports = False
    bench.run(3.0)
    assert bench.control.driver.model.trust.state is CarTrust.UNHEARD
    before = len(bench.sent)
    bench.run(10.0)
    assert len(bench.sent) > before + 4
    bench.reports = True
    bench.run(2.0)
    assert bench.control.driver.model.trust.state is CarTrust.STOPPED

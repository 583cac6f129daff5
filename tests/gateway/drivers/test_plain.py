"""The plain engine, with the tank: what waits, repeats, gives way and ends."""

import json
from typing import cast

import pytest

from gateway.control.commands import ChangeSpeed, Drive, Stop
from gateway.drivers import Family
from gateway.drivers.check import Bench
from gateway.drivers.plain import RENEWAL_S
from schemas.words import Basis, CarTrust, FrameOrigin, Motion, Motors, Phase, SpeedStep
from tests.support import tank

REPORT = b'{"v":7.9,"dist_cm":42}\n'


class TankBench(Bench):
    """A tank that reports."""

    def __init__(self) -> None:
        super().__init__(cast("Family", tank), "tank")
        self.reports = True

    def run(self, seconds: float) -> None:
        """Let time pass, with a report each 0.2 s."""
        for _ in range(round(seconds / 0.2)):
            for event in self.control.driver.feed(REPORT if self.reports else b"", self.now):
                self.control.driver.on_event(event, self.now)
            super().run(0.2)

    def moves(self, since: float = 0.0) -> list[list[float]]:
        """Return the motions that were written since then."""
        return [json.loads(data)["move"] for at, data, _ in self.sent if at >= since]


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
    assert {data for _, data, _ in repeats} == {b'{"move": [0.0, 0.0]}\n'}


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

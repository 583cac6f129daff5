"""The gateway stops a car of another platform than configured, or with its fan on, and the car can be used again."""

import pytest

from gateway.control.commands import Drive, Fan, Stop
from schemas.words import Basis, Mode, Motion, Phase, Reason
from tests.support.stops import ENDS_S
from tests.support.virtual import Pair

TOLD = [("arduino", "raspberry_pi"), ("stm32", "raspberry_pi"), ("raspberry_pi", "arduino")]


@pytest.mark.parametrize(("platform", "told"), TOLD)
def test_wrong_platform_car_is_stopped_by_common_stop(platform: str, told: str) -> None:
    pair = Pair(platform, told=told, start_s=2.0).ready()
    pair.until(lambda: pair.control.driver.model.platform.doubted, 10.0)
    pair.ask(Stop(), identity="first")
    pair.until(lambda: pair.last_of("first") is not None, ENDS_S)
    pair.ask(Drive(Motion.FORWARD, 9.0))
    pair.run(1.0)
    assert pair.car.truth.motor_left
    asked_at = pair.now
    answer = pair.ask(Stop(), identity="second")
    pair.until(lambda: pair.last_of("second") is not None, ENDS_S)
    last = pair.last_of("second")
    assert last is not None
    assert last.basis == pair.control.driver.model.basis
    if platform == "raspberry_pi":
        assert (last.phase, last.basis) == (Phase.SENT, Basis.SENT), "it shows nothing, whatever it was told to be"
    pair.run(8.0)
    assert pair.off_for_good_at() <= asked_at + answer.worst_case_s
    assert pair.control.driver.model.motors == "off"


def test_mode_car_told_without_modes_is_stopped() -> None:
    pair = Pair(told="raspberry_pi", start_s=2.0).ready()
    pair.car.feed(b"$4WD,MODE21#", pair.now)
    pair.until(lambda: pair.car.truth.mode is Mode.TRACKING, 3.0)
    pair.until(lambda: pair.control.driver.model.motors == "unknown", 5.0)
    assert pair.control.driver.model.motion is None
    answer = pair.ask(Stop(), identity="stop")
    asked_at = pair.now
    pair.until(lambda: pair.last_of("stop") is not None, ENDS_S)
    pair.run(8.0)
    assert pair.car.truth.mode is Mode.MANUAL
    assert pair.off_for_good_at() <= asked_at + answer.worst_case_s
    assert pair.control.driver.model.motors == "off"


def test_fan_over_cut_link_can_be_toggled_and_car_reused() -> None:
    """A car whose fan runs reports nothing (docs/reference/protocol.md#hazards), so its recovery goes on."""
    pair = Pair(start_s=2.0).ready()
    pair.ask(Fan(), identity="on")
    pair.until(lambda: pair.car.truth.fan, 3.0)
    pair.lose()
    pair.connect()
    pair.until(lambda: not pair.control.driver.model.is_heard, 60.0)
    pair.run(60.0)
    assert pair.now - pair.sent[-1][0] < 10.0, "the stop goes on"
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("unknown", None)
    assert "unheard" in [log.code for log in pair.logs]
    assert pair.ask(Fan(on=False)).reason is Reason.UNSUPPORTED, "after a cut it is not known whether it runs"
    pair.ask(Fan(), identity="off")
    pair.until(lambda: pair.control.driver.model.known, 30.0)
    assert Phase.SENT in pair.phases("off")
    assert not pair.car.truth.fan
    pair.ask(Drive(Motion.FORWARD, 1.0), identity="drive")
    pair.until(lambda: bool(pair.car.truth.motor_left), 2.0)

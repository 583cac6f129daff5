"""`speed_max` by the true speed of the car, when steps wait, gateways change, and cars are switched off and on."""

import json

import pytest

from gateway.control.commands import ChangeSpeed, Drive, SetMode, Stop
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.words import Mode, Motion, Phase, SpeedStep
from tests.support.controls import control
from tests.support.virtual import Pair

FULL_PWM = 255


def _limited(platform: str, speed_max: float, *, auto: bool = False) -> Pair:
    pair = Pair(platform)
    pair.control = control(parse_platform("unknown" if auto else platform), speed_max=speed_max, auto=auto)
    return pair.ready()


def _follow_with_another_gateway(pair: Pair, platform: str, speed_max: float) -> None:
    """End the gateway, and let another one with this limit go on with the same car."""
    kept = json.loads(json.dumps(pair.control.driver.kept()))
    pair.control.driver.shut_down(pair.now)
    pair.run(8.0)
    pair.lose()
    pair.control = control(parse_platform(platform), speed_max=speed_max, learned=Learned.restore(kept))
    pair.connect()
    pair.run(12.0)


def _drive_as_fast_as_allowed(pair: Pair) -> float:
    """Lower the speed until a drive is accepted. Return the true share of full speed in this drive."""
    for _ in range(10):
        began = pair.now
        if pair.ask(Drive(Motion.FORWARD, 2.0)).status is not Phase.REJECTED:
            break
        assert pair.ask(ChangeSpeed(SpeedStep.DOWN)).status is not Phase.REJECTED
        pair.run(1.0)
    pair.run(1.5)
    at, left, _ = pair.car.motor_log[-1]
    assert at >= began
    assert left
    return left / FULL_PWM


@pytest.mark.parametrize(("platform", "speed_max"), [("arduino", 0.8), ("stm32", 0.35)])
def test_steps_that_wait_do_not_add_up_beyond_limit(platform: str, speed_max: float) -> None:
    pair = _limited(platform, speed_max)
    pair.ask(Drive(Motion.FORWARD, 1.0))
    pair.run(0.5)
    pair.ask(Stop())
    answers = [pair.ask(ChangeSpeed(SpeedStep.UP)).status for _ in range(4)]
    assert answers == [Phase.QUEUED, *[Phase.REJECTED] * 3]
    pair.run(5.0)
    assert speed_max - 0.1 < _drive_as_fast_as_allowed(pair) <= speed_max


@pytest.mark.parametrize(("platform", "speed_max"), [("arduino", 0.6), ("stm32", 0.35), ("raspberry_pi", 0.85)])
def test_next_gateway_knows_speed_to_which_car_was_set(platform: str, speed_max: float) -> None:
    """After a reload that lowered the limit, the car still drove at full speed."""
    pair = _limited(platform, 1.0)
    for _ in range(4):
        pair.ask(ChangeSpeed(SpeedStep.UP))
        pair.run(1.0)
    _follow_with_another_gateway(pair, platform, speed_max)
    assert pair.ask(Drive(Motion.FORWARD, 1.0)).status is Phase.REJECTED
    assert _drive_as_fast_as_allowed(pair) <= speed_max


def test_next_gateway_knows_that_a_mode_has_set_speed() -> None:
    pair = _limited("arduino", 0.6)
    pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE))
    pair.run(30.0)
    _follow_with_another_gateway(pair, "arduino", 0.6)
    assert pair.car.truth.speed > 0.6 * FULL_PWM
    assert _drive_as_fast_as_allowed(pair) <= 0.6


def test_platform_that_is_detected_again_keeps_speed() -> None:
    pair = _limited("arduino", 0.6, auto=True)
    pair.until(lambda: "arduino" in pair.control.driver.model.profile.name, 10.0)
    pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE))
    pair.run(30.0)
    pair.ask(SetMode(Mode.MANUAL))
    pair.run(10.0)
    pair.lose()
    pair.run(1.0, linked=False)
    pair.ready()
    pair.run(5.0)
    assert pair.car.truth.speed > 0.6 * FULL_PWM
    assert _drive_as_fast_as_allowed(pair) <= 0.6


@pytest.mark.parametrize("after_s", [0.0, 2.0, 6.0])
def test_car_whose_platform_is_not_known_yet_may_be_the_fastest(after_s: float) -> None:
    """A raspberry_pi car begins faster than others. It was driven like others until it was detected."""
    pair = Pair("raspberry_pi", start_s=3.0)
    pair.control = control(parse_platform("unknown"), auto=True, speed_max=0.6)
    pair.connect()
    pair.run(after_s)
    refused = pair.ask(Drive(Motion.FORWARD, 3.0))
    assert refused.status is Phase.REJECTED
    assert "80%" in refused.words
    pair.run(12.0)
    assert not pair.driven_since(0.0)
    assert _drive_as_fast_as_allowed(pair) <= 0.6


@pytest.mark.parametrize("is_switched_off", [False, True])
def test_car_that_was_switched_off_during_loss_of_link_begins_with_its_own_speed(*, is_switched_off: bool) -> None:
    pair = _limited("arduino", 0.4)
    assert _drive_as_fast_as_allowed(pair) <= 0.4
    pair.run(5.0)
    pair.lose()
    if is_switched_off:
        pair.car.brown_out(pair.now)
    pair.run(5.0, linked=False)
    pair.ready()
    refused = pair.ask(Drive(Motion.FORWARD, 1.0))
    assert refused.status is Phase.REJECTED
    assert "40%" in refused.words
    assert _drive_as_fast_as_allowed(pair) <= 0.4


def test_car_that_was_switched_off_behind_an_open_link_begins_with_its_own_speed() -> None:
    pair = _limited("arduino", 0.4)
    assert _drive_as_fast_as_allowed(pair) <= 0.4
    pair.run(5.0)
    pair.deaf_until = pair.now + 20.0
    pair.lose_frames()
    pair.run(19.0)
    pair.car.brown_out(pair.now)
    pair.pass_frames()
    pair.run(15.0)
    assert pair.ask(Drive(Motion.FORWARD, 1.0)).status is Phase.REJECTED
    assert _drive_as_fast_as_allowed(pair) <= 0.4


def test_speeds_of_a_damaged_file_are_not_used() -> None:
    kept = control(parse_platform("arduino")).driver.kept()
    assert Learned.restore(kept).speeds == Learned().speeds
    assert Learned.restore({name: value for name, value in kept.items() if name != "speeds"}).speeds == Learned().speeds
    damaged: list[dict[str, object]] = [
        {"arduino": []},
        {"arduino": [300]},
        {"arduino": ["nan"]},
        {"tank": [1]},
        {"arduino": 5},
    ]
    for speeds in damaged:
        with pytest.raises((ValueError, TypeError)):
            Learned.restore({**kept, "speeds": speeds})

"""`speed_max` by the true speed of the car, when steps wait, gateways change, and cars are switched off and on."""

import json
import random
from itertools import pairwise

import pytest

from gateway.control.commands import ChangeSpeed, Drive, Resume, SetMode, Stop
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.sim.model.world import World
from schemas.words import Mode, Motion, Phase, SpeedStep
from tests.support.controls import control
from tests.support.virtual import Pair

FULL_PWM = 255
ROUNDING = 0.5 / FULL_PWM
"""Error of the simulated motors, whose power is a whole number."""


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


def _share(pair: Pair, since: float) -> float:
    """Return the highest true share of full speed since a time."""
    changes = [*pair.car.motor_log, (pair.now, 0, 0)]
    spans = [(max(abs(left), abs(right)), until) for (_, left, right), (until, *_) in pairwise(changes)]
    return max((speed / FULL_PWM for speed, until in spans if until > since), default=0.0)


def _driven(pair: Pair) -> float:
    """Drive. Return the true share of full speed in this drive."""
    began = pair.now
    assert pair.ask(Drive(Motion.FORWARD, 2.0), identity=f"at{began}").status is Phase.QUEUED
    pair.until(lambda: _share(pair, began) > 0, 20.0)
    pair.run(3.0)
    assert pair.phases(f"at{began}")[-1] is Phase.SENT
    return _share(pair, began)


@pytest.mark.parametrize(
    ("platform", "speed_max", "steps"),
    [("arduino", 0.59, 0), ("arduino", 0.5, 1), ("arduino", 0.2, 2), ("stm32", 0.11, 1), ("raspberry_pi", 0.3, 3)],
)
def test_drive_begins_after_the_steps_down_that_it_needs(platform: str, speed_max: float, steps: int) -> None:
    """It was refused, after each start of a car that begins faster, and after each mode that sets the speed."""
    pair = _limited(platform, speed_max)
    pair.run(10.0)
    sent = len(pair.sent)
    answer = pair.ask(Drive(Motion.FORWARD, 1.0), identity="d")
    assert (" step" in answer.words) is (steps > 0)
    pair.until(lambda: pair.phases("d")[-1] is Phase.SENT, steps * 1.2 + 0.2)
    down = sum(b"0,0,0,2,0" in frame for _, frame in pair.sent[sent:])
    assert down == steps
    assert ("speed_max" in pair.records[-1].words) is (steps > 0)
    pair.run(3.0)
    assert ("speed_max" in pair.records[-1].words) is ("began after" in pair.records[-1].words)
    assert 0.0 < _share(pair, 0.0) <= speed_max


def test_stream_drives_after_steps_down() -> None:
    """Each sample lasts for less than the steps take, but the next ones come."""
    pair = _limited("arduino", 0.4)
    pair.ask(SetMode(Mode.TRACKING))
    pair.run(10.0)
    pair.ask(SetMode(Mode.MANUAL))
    pair.run(10.0)
    began = pair.now
    while not _share(pair, began):
        assert pair.now < began + 10.0
        pair.ask(Drive(Motion.FORWARD, 0.5), streamed=True)
        pair.run(0.1)
    assert _share(pair, began) <= 0.4
    pair.run(3.0)
    assert pair.car.motor_log[-1][1:] == (0, 0)


@pytest.mark.parametrize("step", [SpeedStep.UP, SpeedStep.DOWN])
def test_car_turns_at_once_after_a_step_that_may_be_lost(step: SpeedStep) -> None:
    """Without an echo, it drove on ahead for up to 1.1 s, as if the step had been needed for the limit."""
    pair = Pair("arduino", world=World.open_field()).ready()
    pair.run(10.0)
    pair.ask(Drive(Motion.FORWARD, 0.5), streamed=True)
    pair.run(0.1)
    pair.ask(ChangeSpeed(step))
    pair.run(0.1)
    pair.ask(Drive(Motion.LEFT, 0.5), streamed=True)
    assert pair.sent[-1] == (pair.now, b"$3,0,0,0,0,0,0,0,0#")


def test_drive_after_a_step_that_must_not_be_lost_says_how_long_it_waits() -> None:
    pair = Pair("arduino", world=World.open_field())
    pair.control = control(parse_platform("arduino"), speed_max=0.5)
    pair.ready()
    pair.run(10.0)
    pair.ask(ChangeSpeed(SpeedStep.DOWN))
    pair.run(0.1)
    wait_s = pair.control.wait_s(Drive(Motion.FORWARD, 0.05), pair.now)
    began = pair.now
    assert f"{wait_s:.1f} s" in pair.ask(Drive(Motion.FORWARD, 0.05), identity="d").words
    pair.until(lambda: Phase.SENT in pair.phases("d"), 2.0)
    assert 0.5 < pair.now - began <= wait_s


def test_car_in_its_first_stop_waits_for_no_step_of_its_speed() -> None:
    """`fleet list` blamed the speed, and did not say for how long, although only a drive needs the step."""
    pair = Pair("arduino")
    pair.control = control(parse_platform("arduino"), speed_max=0.4)
    pair.connect()
    pair.run(1.0)
    assert pair.control.waits_for(pair.now).startswith("its first stop, for ")
    answer = pair.ask(Drive(Motion.FORWARD, 0.5))
    assert "a stop, and a step of its speed" in answer.words
    pair.until(lambda: pair.control.is_free(pair.now), 10.0)
    assert pair.control.waits_for(pair.now) == ""


def test_record_of_a_drive_says_that_its_speed_was_lowered_and_not_that_the_car_was_busy() -> None:
    """Also if the drive was requested again, when its speed had been lowered already."""
    pair = _limited("raspberry_pi", 0.3)
    pair.run(10.0)
    for identity in ("first", "again"):
        pair.ask(Drive(Motion.FORWARD, 0.5), identity=identity)
        pair.run(0.06)
    pair.run(5.0)
    said = [record.words for record in pair.records if record.command.id == "again" and record.phase is Phase.SENT]
    assert len(said) == 2
    assert all("its speed was lowered to 20% first" in words for words in said)
    assert not any("busy" in words for words in said)


def test_no_drive_is_begun_after_a_release_during_steps_down() -> None:
    pair = _limited("arduino", 0.2)
    pair.run(10.0)
    began = pair.now
    pair.ask(Drive(Motion.FORWARD, 2.0))
    pair.run(0.1)
    pair.ask(Stop())
    pair.run(10.0)
    assert not _share(pair, began)


RARE = (542, 624, 981, 2120, 3485, 3803)
"""Episodes among the first 4,000 that need more than the steps: a step up that waits, or a step of which the car knows
nothing, because it read the next frame instead. 3607 is left out: the car was stuck when the step came, as it may be
after each stop, and nothing shows which frames it has lost."""
PLATFORMS = ("arduino", "stm32", "raspberry_pi")


@pytest.mark.parametrize("seed", [*range(100), *RARE])
def test_no_drive_is_too_fast_and_each_one_begins(seed: int) -> None:
    """Random steps, modes, stops, lost links and restarts of the car, with and without echoes."""
    chance = random.Random(seed)
    platform, limit = chance.choice(PLATFORMS), chance.choice((0.25, 0.4, 0.5, 0.6, 0.8, 0.95))
    is_open = chance.random() < 0.3
    pair = Pair(platform, seed=seed, world=World.open_field() if is_open else None)
    auto = platform != "stm32" and chance.random() < 0.3  # many an stm32 car is taken for an arduino car
    pair.control = control(parse_platform("unknown" if auto else platform), speed_max=limit, auto=auto)
    pair.ready()
    # In some modes, a car without any echo hangs.
    left_out = {Mode.MANUAL, *((Mode.OBSTACLE_AVOIDANCE, Mode.FOLLOWING) if is_open else ())}
    modes = sorted(set(parse_platform(platform).modes) - left_out)
    for _ in range(12):
        match chance.choice(("up", "down", "mode", "stop", "lose", "drive", "drive")):
            case "up":
                pair.ask(ChangeSpeed(SpeedStep.UP))
            case "down":
                pair.ask(ChangeSpeed(SpeedStep.DOWN))
            case "mode" if modes:
                pair.ask(SetMode(chance.choice(modes)))
                pair.run(chance.uniform(1.0, 20.0))
                pair.ask(SetMode(Mode.MANUAL))
                pair.run(8.0)
            case "stop":
                pair.ask(Stop())
                pair.ask(Resume())
            case "lose":
                pair.lose()
                if chance.random() < 0.5:
                    pair.car.brown_out(pair.now)
                pair.run(chance.uniform(2.0, 8.0), linked=False)
                pair.ready()
            case _:
                assert 0 < _driven(pair) <= limit + ROUNDING
        pair.run(chance.choice((0.0, 0.05, 0.3, 1.0, 6.0)))


@pytest.mark.parametrize(("platform", "speed_max"), [("arduino", 0.8), ("stm32", 0.35)])
def test_steps_that_wait_do_not_add_up_beyond_limit(platform: str, speed_max: float) -> None:
    pair = _limited(platform, speed_max)
    pair.ask(Drive(Motion.FORWARD, 1.0))
    pair.run(0.5)
    pair.ask(Stop())
    answers = [pair.ask(ChangeSpeed(SpeedStep.UP)).status for _ in range(4)]
    assert answers == [Phase.QUEUED, *[Phase.REJECTED] * 3]
    pair.run(5.0)
    assert speed_max - 0.1 < _driven(pair) <= speed_max


@pytest.mark.parametrize(("platform", "speed_max"), [("arduino", 0.6), ("stm32", 0.35), ("raspberry_pi", 0.85)])
def test_next_gateway_knows_speed_to_which_car_was_set(platform: str, speed_max: float) -> None:
    """After a reload that lowered the limit, the car still drove at full speed."""
    pair = _limited(platform, 1.0)
    for _ in range(4):
        pair.ask(ChangeSpeed(SpeedStep.UP))
        pair.run(1.0)
    _follow_with_another_gateway(pair, platform, speed_max)
    assert _driven(pair) <= speed_max


def test_next_gateway_knows_that_a_mode_has_set_speed() -> None:
    pair = _limited("arduino", 0.6)
    pair.ask(SetMode(Mode.OBSTACLE_AVOIDANCE))
    pair.run(30.0)
    _follow_with_another_gateway(pair, "arduino", 0.6)
    assert pair.car.truth.speed > 0.6 * FULL_PWM
    assert _driven(pair) <= 0.6


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
    assert _driven(pair) <= 0.6


@pytest.mark.parametrize("after_s", [0.0, 2.0, 6.0])
def test_car_whose_platform_is_not_known_yet_may_be_the_fastest(after_s: float) -> None:
    """A raspberry_pi car begins faster than others. It was driven like others until it was detected."""
    pair = Pair("raspberry_pi", start_s=3.0)
    pair.control = control(parse_platform("unknown"), auto=True, speed_max=0.6)
    pair.connect()
    pair.run(after_s)
    assert pair.ask(Drive(Motion.FORWARD, 3.0)).status is Phase.QUEUED
    pair.run(20.0)
    assert 0.0 < _share(pair, 0.0) <= 0.6
    assert _driven(pair) <= 0.6


@pytest.mark.parametrize("is_switched_off", [False, True])
def test_car_that_was_switched_off_during_loss_of_link_begins_with_its_own_speed(*, is_switched_off: bool) -> None:
    pair = _limited("arduino", 0.4)
    assert _driven(pair) <= 0.4
    pair.run(5.0)
    pair.lose()
    if is_switched_off:
        pair.car.brown_out(pair.now)
    pair.run(5.0, linked=False)
    pair.ready()
    assert _driven(pair) <= 0.4


def test_car_that_was_switched_off_behind_an_open_link_begins_with_its_own_speed() -> None:
    pair = _limited("arduino", 0.4)
    assert _driven(pair) <= 0.4
    pair.run(5.0)
    pair.deaf_until = pair.now + 20.0
    pair.lose_frames()
    pair.run(19.0)
    pair.car.brown_out(pair.now)
    pair.pass_frames()
    pair.run(15.0)
    assert _driven(pair) <= 0.4


@pytest.mark.parametrize("is_closed", [True, False])
def test_steps_that_a_dead_link_has_lost_do_not_count(*, is_closed: bool) -> None:
    """The car never got the steps, but the gateway counted them, and drove it as fast as before."""
    pair = _limited("arduino", 1.0)
    for _ in range(3):
        pair.ask(ChangeSpeed(SpeedStep.UP))
        pair.run(1.5)
    _follow_with_another_gateway(pair, "arduino", 0.9)
    pair.deaf_until = pair.now + 6.0
    pair.lose_frames()
    pair.ask(Drive(Motion.FORWARD, 0.5))
    pair.run(5.0)
    assert any(b"0,0,0,2,0" in frame for _, frame in pair.sent)
    pair.pass_frames()
    if is_closed:
        pair.lose()
        pair.run(2.0, linked=False)
        pair.connect()
    pair.run(15.0)
    assert pair.car.truth.speed > 0.9 * FULL_PWM
    assert 0.0 < _driven(pair) <= 0.9


def test_step_up_whose_write_failed_may_have_arrived() -> None:
    """The car went one step faster, the gateway did not count it, and accepted one step more than the limit allows."""
    pair = _limited("arduino", 0.8)
    pair.run(3.0)
    pair.cut = len(b"$0,0,0,1,0,0,0,0,0#")  # the write failed, but the car got all of it
    pair.ask(ChangeSpeed(SpeedStep.UP))
    pair.run(2.0, linked=False)
    pair.ready()
    pair.ask(ChangeSpeed(SpeedStep.UP))
    pair.run(3.0)
    assert 0.0 < _driven(pair) <= 0.8


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

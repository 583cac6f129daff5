"""The refusals of a driver of this family, and its claims about the parts of a car."""

import json

import pytest

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Drive,
    Find,
    Led,
    MoveServo,
    Resume,
    SetLight,
    SetMode,
    Stop,
)
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.estimate.outputs import StateEstimate
from gateway.drivers.yahboom.protocol.frames import General, ModeOpen, encode
from gateway.drivers.yahboom.protocol.platforms import SPEEDS, parse_platform
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.words import Light, Mode, Motion, Phase, Platform, ServoAction, SpeedStep, Verdict
from tests.support.controls import control
from tests.support.truth import near_walls
from tests.support.virtual import Pair


@pytest.mark.parametrize(
    ("platform", "speed", "step", "limit", "refused"),
    [
        ("arduino", 150.0, SpeedStep.UP, 1.0, False),
        ("arduino", 150.0, SpeedStep.UP, 0.78, True),
        ("arduino", 150.0, SpeedStep.UP, 0.79, False),
        ("arduino", 150.0, SpeedStep.DOWN, 0.1, False),
        ("arduino", 50.0, SpeedStep.DOWN, 0.3, True),  # docs/reference/protocol.md#platforms: that step goes up, to 100
        ("raspberry_pi", 60.0, SpeedStep.UP, 0.7, True),
    ],
)
def test_no_step_beyond_the_speed_that_is_allowed(
    platform: str, speed: float, step: SpeedStep, limit: float, refused: bool
) -> None:
    driver = control(parse_platform(platform), speed_max=limit).driver
    driver.model.believed.speeds[driver.model.profile.kind] = frozenset({speed})
    words = driver.refusal(ChangeSpeed(step))
    assert (words is not None) is refused
    assert words is None or f"{limit:.0%}" in words


@pytest.mark.parametrize(
    ("platform", "limit", "steps_down"),
    [("arduino", 0.59, 0), ("arduino", 0.5, 1), ("arduino", 0.2, 2), ("stm32", 0.2, 0), ("raspberry_pi", 0.3, 3)],
)
def test_steps_down_go_before_a_drive(platform: str, limit: float, steps_down: int) -> None:
    driver = control(parse_platform(platform), speed_max=limit).driver
    for left in range(steps_down, 0, -1):
        assert driver.steps_before_drive == [SpeedStep.DOWN] * left
        assert driver.refusal(Drive(Motion.FORWARD)) is None
        driver.model.believed.on_written(General(Motion.STOP, speed=SpeedStep.DOWN), 0.0)
    assert driver.steps_before_drive == []
    assert driver.refusal(Drive(Motion.FORWARD)) is None


@pytest.mark.parametrize(("platform", "limit"), [("arduino", 0.19), ("stm32", 0.09), ("raspberry_pi", 0.19)])
def test_drive_that_is_always_too_fast_is_refused(platform: str, limit: float) -> None:
    driver = control(parse_platform(platform), speed_max=limit).driver
    words = driver.refusal(Drive(Motion.FORWARD))
    assert words is not None
    assert f"{limit:.0%}" in words
    assert driver.steps_before_drive == []


def test_stop_is_never_too_fast() -> None:
    driver = control(parse_platform("arduino"), speed_max=0.1).driver
    assert driver.refusal(Drive(Motion.FORWARD)) is not None
    assert driver.refusal(Drive(Motion.STOP)) is None


@pytest.mark.parametrize(("limit", "steps_down"), [(1.0, 0), (0.6, 3), (0.4, 4)])
def test_speed_that_a_mode_has_set_is_lowered_before_a_drive(limit: float, steps_down: int) -> None:
    driver = control(parse_platform("arduino"), speed_max=limit).driver
    driver.model.believed.on_written(ModeOpen(Mode.TRACKING), 0.0)
    assert driver.steps_before_drive == [SpeedStep.DOWN] * steps_down


@pytest.mark.parametrize("platform", ["arduino", "stm32"])
@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.MANUAL])
def test_car_is_never_faster_than_believed(platform: str, mode: Mode) -> None:
    """Whatever a mode has left, each step down keeps the estimate at or above the car's speed."""
    speed = SPEEDS[Platform(platform)]
    left = range(int(speed.top) + 1) if mode in speed.set_by else [speed.start]
    for true_speed in left:
        believed, true = StateEstimate(parse_platform(platform)), float(true_speed)
        believed.on_written(ModeOpen(mode), 0.0)
        for step in [SpeedStep.DOWN] * 7 + [SpeedStep.UP, SpeedStep.DOWN, SpeedStep.DOWN]:
            assert speed.fraction(true) <= believed.share
            believed.on_written(General(Motion.STOP, speed=step), 0.0)
            true = speed.step(true, step)


@pytest.mark.parametrize(
    "turns",
    [
        [MoveServo(ServoAction.FRONT_LEFT)],
        [MoveServo(ServoAction.FRONT_RESET)],
        [SetMode(Mode.COLOR_LED), SetMode(Mode.MANUAL)],
        [SetMode(Mode.OBSTACLE_AVOIDANCE), SetMode(Mode.MANUAL)],
    ],
)
def test_no_angle_is_claimed_once_the_servo_may_have_turned(turns: list[Action]) -> None:
    pair = Pair("arduino", world=near_walls()).ready()
    pair.ask(AimServo(30))
    pair.run(3.0)
    assert (pair.control.driver.model.outputs.servo_deg, pair.car.truth.servo) == (30, 150)
    for action in turns:
        pair.ask(action)
        pair.run(12.0)
    assert pair.car.truth.servo != 150
    assert pair.control.driver.model.outputs.servo_deg is None
    pair.ask(AimServo(40))
    pair.run(12.0)
    assert (pair.control.driver.model.outputs.servo_deg, pair.car.truth.servo) == (40, 140)


@pytest.mark.parametrize(
    "action", [SetMode(Mode.TRACKING), Drive(Motion.FORWARD), ChangeSpeed(SpeedStep.UP), Led(1, 2, 3)]
)
def test_angle_is_claimed_as_long_as_nothing_turns_the_servo(action: Action) -> None:
    pair = Pair("arduino").ready()
    pair.ask(AimServo(30))
    pair.run(3.0)
    pair.ask(action)
    pair.run(6.0)
    assert (pair.control.driver.model.outputs.servo_deg, pair.car.truth.servo) == (30, 150)


def test_no_angle_is_claimed_after_the_car_was_out_of_reach() -> None:
    pair = Pair("arduino").ready()
    pair.ask(AimServo(30))
    pair.run(3.0)
    pair.lose()
    pair.run(1.0, linked=False)
    pair.ready()
    assert pair.control.driver.model.outputs.servo_deg is None, "it may have been switched off, or be another car"


@pytest.mark.parametrize("asked_s", [-0.05, 0.001])
def test_renewed_stop_and_action_wait_for_each_other_without_an_echo(asked_s: float) -> None:
    """Without an echo the car reads rarely, and may take half of a frame behind an unread one for a motion."""
    pair = Pair(world=World.open_field(), start_s=2.0)
    pair.connect()
    pair.run(40.0)
    pair.ask(Stop(), verb="stop")
    pair.run(30.0)
    pair.run(pair.control.driver.stops.renewal.due_at + asked_s - pair.now)
    pair.ask(SetLight(Light.RED))
    pair.run(2.0)
    (first_at, first), (then_at, then) = pair.sent[-2:]
    assert {first, then} == {encode(General(Motion.STOP)), encode(General(Motion.STOP, light=Light.RED))}
    assert then_at - first_at > 0.5, "a ranging without an echo takes 1.0 s"


def test_blinking_that_has_begun_does_not_wait_for_a_long_stop() -> None:
    pair = Pair("stm32", told="arduino", start_s=2.0)  # this stop takes 17 s, because nothing shows it
    pair.connect()
    pair.ask(Find(), identity="it")
    pair.run(6.0)
    assert pair.phases("it")[-1] is Phase.SENT
    assert pair.control.driver.is_stopping


def test_mode_with_a_late_first_reading_is_not_contradicted_the_second_time() -> None:
    pair = Pair(start_s=2.0, traits=CarTraits(first_reading_s=4.0)).ready()
    for _ in range(2):
        pair.ask(SetMode(Mode.TRACKING), identity="it")
        opened = pair.now
        while pair.now < opened + 12.0:
            pair.run(0.1)
            assert pair.control.driver.model.mode.verdict is not Verdict.CONTRADICTED, pair.now - opened
        assert pair.control.driver.model.mode.verdict is Verdict.CONFIRMED
        pair.ask(Stop(), verb="stop")
        pair.run(10.0)
        pair.ask(Resume())
    kept = Learned.restore(json.loads(json.dumps(pair.control.driver.kept())))
    assert kept.first_reading_s(Mode.TRACKING, 1.7) == pytest.approx(4.0, abs=0.3)
    pair.run(5.0)

"""A healthy car raises no alarm. Each mode runs for two minutes here, and for ten hours in tests/soak."""

import pytest

from gateway.control.commands import SetMode
from gateway.sim.model.raspberry_pi import Transport
from gateway.sim.model.world import World
from schemas.words import Mode, Verdict
from tests.support.normal import NormalRun, normal
from tests.support.truth import WORLDS
from tests.support.virtual import Pair

SECONDS = 120.0


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", Mode)
def test_no_alarm_in_normal_running(mode: Mode, world: str) -> None:
    run = NormalRun(world, seed=7)
    normal(run, mode, SECONDS)
    assert run.commands > 3
    assert not run.alarms


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("platform", "told", "transport"),
    [
        ("raspberry_pi", "raspberry_pi", Transport.SERIAL),
        ("raspberry_pi", "raspberry_pi", Transport.TCP),
        ("raspberry_pi", "unknown", Transport.TCP),
        ("arduino", "unknown", Transport.SERIAL),
        ("stm32", "stm32", Transport.SERIAL),
    ],
)
def test_healthy_car_of_other_platforms_raises_no_alarm(
    platform: str, told: str, transport: Transport, world: str
) -> None:
    run = NormalRun(world, seed=8, platform=platform, told=told, transport=transport)
    normal(run, Mode.MANUAL, SECONDS)
    assert not run.alarms


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING])
def test_late_first_reading_of_a_mode_is_no_alarm(mode: Mode) -> None:
    """The car obeys up to 1.0 s later if it ranges without an echo, and reads nothing out for 1.7 s after the opening.

    From the second opening on, silence counts, because the car was seen to report in the mode.
    """
    pair = Pair(world=World.open_field()).ready()
    pair.ask(SetMode(mode))
    pair.until(lambda: pair.control.driver.model.mode.confirmed is mode, 15.0)
    pair.ask(SetMode(Mode.MANUAL))
    pair.run(30.0)  # until control no longer repeats the stop
    pair.until(lambda: not pair.car.truth.blocked, 3.0)
    pair.until(lambda: pair.car.truth.blocked, 3.0)
    pair.ask(SetMode(mode))
    pair.until(lambda: pair.control.driver.model.mode.verdict is not Verdict.ASSUMED, 15.0)
    assert pair.control.driver.model.mode.confirmed is mode, pair.control.driver.model.mode.evidence
    assert "mode_contradicted" not in [log.code for log in pair.logs]

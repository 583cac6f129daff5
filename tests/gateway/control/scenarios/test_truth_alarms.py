"""A healthy car raises no alarm. Each mode runs for two minutes here, and for ten hours in tests/soak."""

import pytest

from gateway.sim.model.raspberry_pi import Transport
from schemas.words import Mode
from tests.support.normal import NormalRun, normal
from tests.support.truth import WORLDS

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

"""What a driver of this family refuses."""

import pytest

from gateway.control.commands import ChangeSpeed
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.words import SpeedStep
from tests.support.controls import control


@pytest.mark.parametrize(
    ("platform", "speed", "step", "limit", "refused"),
    [
        ("arduino", 150.0, SpeedStep.UP, 1.0, False),
        ("arduino", 150.0, SpeedStep.UP, 0.78, True),
        ("arduino", 150.0, SpeedStep.UP, 0.79, False),
        ("arduino", 150.0, SpeedStep.DOWN, 0.1, False),
        ("arduino", 50.0, SpeedStep.DOWN, 0.3, True),  # docs/reference/protocol.md#platforms: that step goes up, to 100
        ("raspberry_pi", 50.0, SpeedStep.UP, 0.6, True),
    ],
)
def test_no_step_beyond_the_speed_that_is_allowed(
    platform: str, speed: float, step: SpeedStep, limit: float, refused: bool
) -> None:
    driver = control(parse_platform(platform), speed_max=limit).driver
    driver.model.believed.speed = speed
    words = driver.refusal(ChangeSpeed(step))
    assert (words is not None) is refused
    assert words is None or f"{limit:.0%}" in words

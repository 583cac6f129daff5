"""Draws a car of the protocol: another rhythm, other blocks, another program. See docs/reference/protocol.md#programs."""

import random
from dataclasses import dataclass

from gateway.protocol.enums import Mode
from gateway.sim.model.traits import CarTraits

USABLE_S = 15.0
"""Maximum time from the connect until a car takes commands."""
CLOSES_S = (0.0, 0.2, 1.0, 1.0, 1.3)
_PRINTING = (Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING)


@dataclass(frozen=True, slots=True)
class DrawnCar:
    """A simulated car, and the platform that the gateway is configured with."""

    platform: str
    told: str
    traits: CarTraits


def draw_car(moments: random.Random, *, modes: bool) -> DrawnCar:
    """Return a car. `modes`: it must have modes."""
    platform, told = moments.choices(
        [("arduino", "arduino"), ("stm32", "stm32"), ("stm32", "arduino"), ("arduino", "stm32")], [10, 2, 1, 1]
    )[0]
    if not modes and moments.random() < 0.1:
        return DrawnCar("course", "raspberry_pi+no_readings", CarTraits(readings=False))
    if platform == "stm32":
        return DrawnCar(platform, told, CarTraits(interval_s=1.0, timer=True, close_s=0.0, last_frame_wins=True))
    readings = moments.random() < 0.95
    traits = CarTraits(
        interval_s=moments.choice([1.254, 1.493, moments.uniform(0.3, 3.0), moments.uniform(0.3, 3.0)]),
        spread_s=moments.choice([0.0, 0.001, moments.uniform(0.0, 0.08)]),
        timer=moments.random() < 0.15,
        close_s=moments.choice(CLOSES_S),
        last_frame_wins=moments.random() < 0.2,
        silent_modes=frozenset(mode for mode in _PRINTING if moments.random() < 0.15),
        text=moments.random() < 0.2,
        readings=readings,
    )
    if not readings:
        told = f"{told}+no_readings"
    return DrawnCar(platform, told, traits)

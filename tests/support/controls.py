"""The control of one simulated car of the first family."""

from typing import Any

from gateway.control.controller import Controller
from gateway.drivers.yahboom.driver import YahboomDriver, yahboom
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.protocol.platforms import Profile

Control = Controller[YahboomDriver]


def control(
    profile: Profile, *, name: str = "red", auto: bool = False, learned: Learned | None = None, **options: Any
) -> Control:
    """Return a controller with its driver. options: as `Controller` takes them."""
    return Controller(name, yahboom(profile, auto=auto, learned=learned), **options)

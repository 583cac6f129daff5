"""The family of cars that speak the `$...#` protocol, for `gateway.drivers`."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from gateway.drivers.yahboom.protocol.platforms import Profile, parse_platform
from schemas.platform_name import AUTO_PLATFORMS, OPTIONS, parse_option
from schemas.words import Platform

if TYPE_CHECKING:
    from gateway.control.driver import Desk
    from gateway.drivers.yahboom.driver import YahboomDriver

PLATFORMS: Final = tuple(map(str, Platform))


def profile_of(name: str) -> Profile:
    """Return the profile of a platform. Raises ValueError for a wrong name."""
    return parse_platform(name)


def profiles() -> tuple[Profile, ...]:
    """Return the profile of each known platform, with an arm and an IMU."""
    return tuple(parse_platform("+".join((kind, *sorted(OPTIONS)))) for kind in AUTO_PLATFORMS)


def driver_of(name: str, kept: Mapping[str, Any]) -> "Callable[[Desk], YahboomDriver]":
    """Return a function that makes a car's driver. With `auto`, the driver detects the platform. Raises ValueError."""
    # Import the driver only here, because a program that only asks for a profile does not need it.
    from gateway.drivers.yahboom.driver import yahboom
    from gateway.drivers.yahboom.estimate.learned import Learned

    start, auto = parse_option(name)
    return yahboom(parse_platform(start), auto=auto, learned=Learned.restore(kept) if kept else Learned())

"""Waveshare's UGV family, for `gateway.drivers`."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from gateway.drivers.plain_profile import PlainProfile
from gateway.drivers.waveshare import ugv_platforms
from gateway.drivers.waveshare.ugv_platforms import profile_of

if TYPE_CHECKING:
    from gateway.control.driver import Desk
    from gateway.drivers.waveshare.driver import WaveshareDriver

__all__ = ["PLATFORMS", "driver_of", "profile_of", "profiles"]

PLATFORMS: Final = tuple(ugv_platforms.PLATFORMS)


def profiles() -> tuple[PlainProfile, ...]:
    """Return the profile of each platform."""
    return tuple(profile_of(name) for name in PLATFORMS)


def driver_of(name: str, kept: Mapping[str, Any]) -> "Callable[[Desk], WaveshareDriver]":
    """Return a function that makes a car's driver. `kept` is not used. Raises the errors of `profile_of`."""
    from gateway.drivers.waveshare.driver import WaveshareDriver

    del kept
    profile = profile_of(name)
    return lambda desk: WaveshareDriver(desk, profile)

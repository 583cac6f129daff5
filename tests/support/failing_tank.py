"""A tank whose driver has a mistake: it knows no spin to the left."""

from collections.abc import Callable, Mapping
from typing import Any

from gateway.control.driver import Desk
from schemas.words import Motion
from tests.support import tank

PLATFORMS = tank.PLATFORMS
profile_of = tank.profile_of
profiles = tank.profiles


class FailingDriver(tank.TankDriver):
    """Raises where a frame is asked for."""

    def motion_frame(self, motion: Motion) -> bytes:
        """Return the line of a motion; raise KeyError for one."""
        if motion is Motion.SPIN_LEFT:
            raise KeyError(motion)
        return super().motion_frame(motion)


def driver_of(name: str, kept: Mapping[str, Any]) -> Callable[[Desk], FailingDriver]:
    """Return the driver."""
    del name, kept
    return FailingDriver

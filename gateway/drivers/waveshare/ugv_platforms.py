"""The platforms of the family, by their firmware. docs/reference/waveshare.md has the source of each number."""

from typing import Final

from msgspec import Struct

from gateway.drivers.plain_profile import PlainProfile
from gateway.drivers.waveshare.firmware import UgvFirmware
from schemas.words import Light


class Chassis(Struct, frozen=True):
    """One chassis with one firmware."""

    main: int
    """The number of the chassis in the command `T:900`, which sets wheels, direction and the kind of speed control."""
    has_encoders: bool
    """True if the car controls its speed with encoders: commands are in m/s, and the reported `L` and `R` are measured.
    False if a command is a share of full power (0.5 is full). Then the reports have no `L` and `R`, or those of the
    command."""


PLATFORMS: Final[dict[str, dict[UgvFirmware, Chassis]]] = {
    "wave_rover": {UgvFirmware.GENERAL: Chassis(1, has_encoders=False)},
    "ugv01": {UgvFirmware.GENERAL: Chassis(3, has_encoders=True)},
    "ugv02": {UgvFirmware.GENERAL: Chassis(2, has_encoders=False), UgvFirmware.ROS: Chassis(2, has_encoders=True)},
    "ugv_rover": {UgvFirmware.ROS: Chassis(2, has_encoders=True)},
    "ugv_beast": {UgvFirmware.ROS: Chassis(3, has_encoders=True)},
}
"""Old and new stock of one product may have different firmwares, so a platform may have two."""
FULL_SPEED: Final = 0.5
"""Maximum `L` and `R` that a gateway sends: 0.5 m/s with encoders, full power without. Beyond 2.0, a car with encoders
keeps its old speed, but the command still resets the dead-man timer."""
DEAD_MAN_S: Final = 3.0
"""Dead-man time of both firmwares after a reset. A gateway sets a shorter time, but a reset of the car undoes that."""
CELLS: Final = 3
_CAPABILITIES: Final = frozenset({"drive", "speed", "light"})
_HINTS: Final = (("silent", "The gateway asks such a car for feedback: is the link the USB port of its board?"),)
_NOT_OBSERVED: Final = ("everything: it was read in the source of the firmwares, and not tried on a car",)


def profile_of(name: str) -> PlainProfile:
    """Return the profile of a platform. Raises ValueError for options, and KeyError for a name not in `PLATFORMS`."""
    kind, plus, options = name.partition("+")
    if plus:
        raise ValueError(f'Unknown option "+{options[:40]}" of {kind}, which has no options.')
    measures = {"battery"}
    for firmware, chassis in PLATFORMS[kind].items():
        measures |= {"attitude"} if firmware is UgvFirmware.GENERAL else {"odometer", "imu"}
        measures |= {"wheels"} if chassis.has_encoders else set()
    return PlainProfile(
        kind,
        _CAPABILITIES,
        frozenset(measures),
        lights=frozenset({Light.WHITE, Light.OFF}),
        cells=CELLS,
        dead_man_s=DEAD_MAN_S,
        not_observed=_NOT_OBSERVED,
        has_network=False,
        hints=_HINTS,
    )

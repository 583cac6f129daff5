"""The platforms of the family, by their firmware. docs/reference/waveshare.md has the source of each number."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gateway.drivers.plain import PlainProfile
from schemas.words import Light


class UgvFirmware(StrEnum):
    """The two programs of these cars. They share the commands, and differ in what makes a command safe."""

    GENERAL = "ugv_base_general"
    ROS = "ugv_base_ros"


@dataclass(frozen=True, slots=True)
class Chassis:
    """One chassis with one firmware."""

    main: int
    """Its number in the command `T:900`, which sets wheels, direction and the kind of speed control."""
    has_encoders: bool
    """True if the speed control is closed: the car's `L` and `R` are measured, and commands are m/s. False if a command
    is a share of full power, 0.5 being all of it, and `L` and `R` are nothing or the command itself."""


PLATFORMS: Final[dict[str, dict[UgvFirmware, Chassis]]] = {
    "wave_rover": {UgvFirmware.GENERAL: Chassis(1, has_encoders=False)},
    "ugv01": {UgvFirmware.GENERAL: Chassis(3, has_encoders=True)},
    "ugv02": {
        UgvFirmware.GENERAL: Chassis(2, has_encoders=False),
        UgvFirmware.ROS: Chassis(2, has_encoders=True),
    },
    "ugv_rover": {UgvFirmware.ROS: Chassis(2, has_encoders=True)},
    "ugv_beast": {UgvFirmware.ROS: Chassis(3, has_encoders=True)},
}
"""Products of old and new stock have different firmwares, so a platform may have two."""
FULL_SPEED: Final = 0.5
"""The greatest `L` and `R` that a gateway sends: full power with an open loop, and 0.5 m/s with a closed one. Beyond
2.0 a closed loop keeps its old speed, and counts the command as a sign of life."""
DEAD_MAN_S: Final = 3.0
"""Dead-man of both firmwares after a reset. A gateway sets a shorter one, which a reset forgets."""
CELLS: Final = 3
_CAPABILITIES: Final = frozenset({"drive", "speed", "light"})
_NOT_OBSERVED: Final = ("all of it: read in the firmwares' source, tried on no car",)


def profile_of(name: str) -> PlainProfile:
    """Return what cars of a platform can do. Raises ValueError for a wrong name."""
    kind, plus, options = name.partition("+")
    if plus:
        raise ValueError(f'Unknown option "+{options[:40]}" of {kind}. It has none.')
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
    )

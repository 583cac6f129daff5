"""Recognises the program of a Waveshare car by its feedback. Pure."""

from collections.abc import Container
from enum import StrEnum
from typing import Final

MAX_V: Final = 13.0
"""Maximum voltage of three cells. A greater number is not in volts."""


class UgvFirmware(StrEnum):
    """The two programs of these cars. They have the same commands, but need different care to be safe."""

    GENERAL = "ugv_base_general"
    ROS = "ugv_base_ros"


def firmware_of(fields: Container[str], v: float) -> UgvFirmware | None:
    """Return the firmware that reports these fields: GENERAL has a temperature, ROS has the distance of the wheels.

    A variant may lack that field. Then angles and volts show GENERAL, a gyroscope and hundredths of a volt show ROS.
    """
    is_general = "temp" in fields or ("r" in fields and "p" in fields and "y" in fields and 0.0 < v <= MAX_V)
    is_ros = "odl" in fields or "odr" in fields or ("gx" in fields and v > 100.0)
    if is_general is is_ros:
        return None
    return UgvFirmware.GENERAL if is_general else UgvFirmware.ROS

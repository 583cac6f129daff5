"""What a battery voltage means: level and charge, with how far the estimate may be off."""

from enum import StrEnum
from typing import Final

EMPTY_V: Final = 6.4  # protocol.md: two Li-ion cells, 6.4 V empty
FULL_V: Final = 8.4  # to 8.4 V full
LOW_V: Final = 7.0
CRITICAL_V: Final = 6.6
SAG_V: Final = 0.4
"""How far motors under load pull the voltage down; an estimate, not measured."""


class BatteryLevel(StrEnum):
    """Whether a person should do something."""

    OK = "ok"
    LOW = "low"
    CRITICAL = "critical"


def level(voltage_v: float) -> BatteryLevel:
    """The level of a voltage, V."""
    if voltage_v < CRITICAL_V:
        return BatteryLevel.CRITICAL
    return BatteryLevel.LOW if voltage_v < LOW_V else BatteryLevel.OK


def charge(voltage_v: float, *, loaded: bool) -> tuple[float, float]:
    """Charge and the half width of its uncertainty, 0..1 each: a straight line between empty and full.

    A Li-ion cell's curve is flat in the middle, so the line is off by about 0.15; under load the sag adds to it.
    """
    share = (voltage_v - EMPTY_V) / (FULL_V - EMPTY_V)
    error = 0.15 + (SAG_V / (FULL_V - EMPTY_V) if loaded else 0.0)
    return min(1.0, max(0.0, share)), min(1.0, error)

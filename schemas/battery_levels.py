"""The voltages at which the battery of a car is full, low, critical and empty: two Li-ion cells at rest. Pure.

`gateway.control.battery` decides the level by them. A fleet file may set others for a car. They are scaled in
proportion for a car with another number of cells.
"""

from typing import Final

FULL_V: Final = 8.4
EMPTY_V: Final = 6.4
"""Both from docs/reference/protocol.md#readings."""
LOW_V: Final = 7.0
CRITICAL_V: Final = 6.6
"""Thresholds of the battery's levels, V at rest."""

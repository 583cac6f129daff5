"""The voltages at which a battery of two Li-ion cells without a load is full, low, critical and empty. Pure.

`gateway.control.battery` decides the level by these voltages. A fleet file may set others for a car. For a car with
another number of cells, the voltages are scaled in proportion.
"""

from typing import Final

FULL_V: Final = 8.4
EMPTY_V: Final = 6.4
"""FULL_V and EMPTY_V are the range of the battery, V, from docs/reference/protocol.md#readings."""
LOW_V: Final = 7.0
CRITICAL_V: Final = 6.6
"""LOW_V and CRITICAL_V are the voltages at which a battery without a load becomes low and critical, V."""

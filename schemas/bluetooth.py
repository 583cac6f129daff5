"""What a Bluetooth adapter of a computer can carry, and the words for one that is full. Pure."""

from typing import Final

ADAPTER_CONNECTIONS: Final = 5
"""Connections that most adapters hold (home-assistant #84331). Known before: an adapter tells nobody."""
SMALL_ADAPTER_CONNECTIONS: Final = 3
"""Connections that some adapters hold (bleak #1858)."""
ADAPTER_NOTIFICATIONS_PER_S: Final = 165
"""Notifications that an adapter carries (docs/explanation/measurements.md#bluetooth)."""
# In tracking up to 27 reports a second (docs/reference/protocol.md#rates), each in three pieces of 20 bytes.
CAR_NOTIFICATIONS_PER_S: Final = 27 * 3
"""Most notifications that one car sends."""
ADAPTER_FULL: Final = "Bluetooth adapter is full"
"""A part of the reason of a link that is lost because its adapter has no room."""


def describe_full(adapter: str, connections: int) -> str:
    """Return in one line that an adapter is full, and what to do."""
    what = f"the {ADAPTER_FULL}: {adapter} has {connections} connections, and most take {ADAPTER_CONNECTIONS}"
    return f"{what}, some {SMALL_ADAPTER_CONNECTIONS}. Give this car another one, ?adapter=hci1, or write ?adapter=auto"

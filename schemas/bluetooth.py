"""The limits of a computer's Bluetooth adapter, and the text about a full one. Pure."""

from typing import Final

ADAPTER_CONNECTIONS: Final = 5
"""Number of connections that most adapters can hold (issue 84331 of home-assistant). No adapter reports its limit."""
SMALL_ADAPTER_CONNECTIONS: Final = 3
"""Number of connections that the smallest adapters can hold (issue 1858 of bleak)."""
ADAPTER_NOTIFICATIONS_PER_S: Final = 165
"""Notifications per second that an adapter carries (docs/explanation/measurements.md#bluetooth)."""
# In tracking, a car sends up to 27 reports of 35 bytes a second (docs/reference/protocol.md#rates). A report takes two
# pieces of 20 bytes, and sometimes three if it does not begin with a piece.
CAR_NOTIFICATIONS_PER_S: Final = 27 * 3
"""Maximum notifications per second from one car."""
ADAPTER_FULL: Final = "Bluetooth adapter is full"
"""Part of the reason of a link that is lost because its adapter has no room."""


def describe_full(adapter: str, connections: int) -> str:
    """Return one line that says that an adapter is full, and what to do."""
    what = f"the {ADAPTER_FULL}: {adapter} has {connections} connections, and most can hold {ADAPTER_CONNECTIONS}"
    return f"{what}, some {SMALL_ADAPTER_CONNECTIONS}. Add ?adapter=hci1 or ?adapter=auto to this car's link"

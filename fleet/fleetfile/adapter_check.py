"""Adds up the load that the cars in a fleet file put on the computer's Bluetooth adapters. Opens nothing.

An adapter does not report how many connections it can hold: a car beyond its limit just does not connect. So the
numbers here are typical ones.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct

from fleet.fleet_links import FleetLink
from schemas.bluetooth import (
    ADAPTER_CONNECTIONS,
    ADAPTER_NOTIFICATIONS_PER_S,
    CAR_NOTIFICATIONS_PER_S,
    SMALL_ADAPTER_CONNECTIONS,
)
from schemas.links import AUTO_ADAPTER, BleUrl

ADAPTERS: Final = Path("/sys/class/bluetooth")
_FIRST: Final = "the first adapter"


class AdapterCheck(Struct, frozen=True):
    """The load of one adapter. For `auto`, the load of all adapters of the computer together."""

    adapter: str
    cars: tuple[str, ...]
    connections: int
    notifications_per_s: int
    """Maximum number of notifications per second that its cars send together."""
    is_crowded: bool
    """True if this load is too high for some models of adapters."""
    words: str


def list_adapters(directory: Path | None = None) -> list[str]:
    """Return the names of the computer's adapters in order. Empty if they are not known."""
    try:
        names = [each.name for each in (ADAPTERS if directory is None else directory).iterdir()]
    except OSError:
        return []
    return sorted((name for name in names if ":" not in name), key=lambda name: (len(name), name))


def check_adapters(links: Mapping[str, FleetLink], adapters: Sequence[str]) -> Iterator[AdapterCheck]:
    """Yield the load of each adapter that a car uses. `adapters` are the computer's, or empty if unknown."""
    first = adapters[0] if adapters else _FIRST
    by_adapter: dict[str, list[str]] = {}
    for car, link in links.items():
        if isinstance(link, BleUrl):
            by_adapter.setdefault(link.adapter or first, []).append(car)
    if AUTO_ADAPTER in by_adapter:  # a car with `auto` may share its adapter with any other car
        by_adapter[AUTO_ADAPTER] = [car for cars in by_adapter.values() for car in cars]
    for adapter, cars in by_adapter.items():
        yield _sum(adapter, cars, max(1, len(adapters)) if adapter == AUTO_ADAPTER else 1)


def _sum(adapter: str, cars: Sequence[str], count: int) -> AdapterCheck:
    """Return the load of the cars that share `count` adapters."""
    notifications = len(cars) * CAR_NOTIFICATIONS_PER_S
    many = "car connects" if len(cars) == 1 else "cars connect"
    through = "it" if count == 1 and adapter != AUTO_ADAPTER else f"{count} adapter{'' if count == 1 else 's'}"
    parts = [f"{len(cars)} {many} through {through}"]
    if has_many := len(cars) > SMALL_ADAPTER_CONNECTIONS * count:
        parts.append(f"most adapters take {ADAPTER_CONNECTIONS} connections, some {SMALL_ADAPTER_CONNECTIONS}")
    if is_loud := notifications > ADAPTER_NOTIFICATIONS_PER_S * count:
        carried = f"an adapter carries {ADAPTER_NOTIFICATIONS_PER_S}"
        parts.append(f"all in tracking, they send up to {notifications} notifications a second, and {carried}")
    if len(cars) > ADAPTER_CONNECTIONS * count:
        parts.append("plug in another adapter, and write ?adapter=auto into the links")
    is_crowded, words = has_many or is_loud, "; ".join(parts)
    return AdapterCheck(adapter, tuple(cars), len(cars), notifications, is_crowded, words)

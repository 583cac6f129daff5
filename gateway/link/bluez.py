"""Calls of BlueZ over D-Bus that bleak does not offer, and a start of bleak that misses no module.

BlueZ is Linux's Bluetooth service. Its adapters, devices and their GATT characteristics are objects on D-Bus. On other
systems, the functions do nothing.
"""

import asyncio
import contextlib
import sys
from collections.abc import Coroutine, Mapping
from typing import Any, Final, TypeVar

if sys.platform == "linux":  # there, bleak installs dbus_fast
    from bleak.backends.bluezdbus.manager import get_global_bluez_manager
    from dbus_fast import BusType, Message, MessageType
    from dbus_fast.aio import MessageBus

T = TypeVar("T")
CALL_TIMEOUT_S: Final = 3.0
"""Timeout of a call of BlueZ, and of bleak's start."""
_BLUEZ: Final = "org.bluez"
_OBJECTS: Final = "org.freedesktop.DBus.ObjectManager"


async def list_connections() -> dict[str, int]:
    """Return the powered adapters in order, each with its number of connections. Empty if that is unknown."""
    if sys.platform != "linux":
        return {}
    return _connections(await _attempt(_managed_objects()) or {})


async def start_bleak() -> dict[str, int]:
    """Start bleak, report to it the objects that it has missed, and return the same as `list_connections`.

    When bleak 3.1 starts, it lists BlueZ's objects, and then forgets what signals have added. If BlueZ adds an object
    just after the list, bleak may read the signal together with the list, and forgets the object. For the rest of the
    process, bleak ignores what that module sends. This happens when several gateways start at once, because the scan of
    one adds the modules of all.

    bleak can neither be asked for all that it knows nor be told more, so this uses private members.
    """
    if sys.platform != "linux":
        return {}
    manager = await _attempt(get_global_bluez_manager())
    found = await _attempt(_managed_objects()) or {}
    if manager is not None:
        for path in found.keys() - manager._properties.keys():
            with contextlib.suppress(Exception):
                manager._parse_msg(_added(path, found[path]))
    return _connections(found)


async def disconnect(adapter: str, address: str) -> None:
    """End the connection of an adapter to a device. Ignore errors, because they mean that there is no connection."""
    if sys.platform != "linux":
        return
    path = f"/org/bluez/{adapter}/dev_{address.upper().replace(':', '_')}"
    await _attempt(_call(path, f"{_BLUEZ}.Device1", "Disconnect"))


async def _attempt(work: Coroutine[Any, Any, T]) -> T | None:
    """Return the result. None after a timeout and after any error of D-Bus, because bleak reports the fault better."""
    with contextlib.suppress(Exception):
        async with asyncio.timeout(CALL_TIMEOUT_S):
            return await work
    return None


def _added(path: str, interfaces: Any) -> "Message":
    """Return the signal that BlueZ has added an object."""
    return Message(
        message_type=MessageType.SIGNAL,
        path="/",
        interface=_OBJECTS,
        member="InterfacesAdded",
        signature="oa{sa{sv}}",
        body=[path, interfaces],
    )


def _connections(found: Mapping[str, Any]) -> dict[str, int]:
    """Return the powered adapters among BlueZ's objects, each with its number of connections."""
    adapters = {path for path, each in found.items() if _value(each, "Adapter1", "Powered") is True}
    devices = [_value(each, "Device1", "Adapter") for each in found.values() if _value(each, "Device1", "Connected")]
    ordered = sorted(adapters, key=lambda path: (len(path), path))  # hci10 comes after hci9
    return {path.rpartition("/")[2]: devices.count(path) for path in ordered}


async def _managed_objects() -> dict[str, Any]:
    (found,) = await _call("/", _OBJECTS, "GetManagedObjects")
    return dict(found)


async def _call(path: str, interface: str, member: str) -> list[Any]:
    """Call BlueZ. Raises whatever D-Bus raises."""
    connection = MessageBus(bus_type=BusType.SYSTEM)
    try:
        await connection.connect()
        message = Message(destination=_BLUEZ, path=path, interface=interface, member=member)
        answer = await connection.call(message)
    finally:
        connection.disconnect()
    if answer.error_name:
        raise OSError(f"BlueZ refused {member}")
    return list(answer.body)


def _value(interfaces: Any, interface: str, name: str) -> Any:
    """Return a property of an object. None if it has no such interface or property."""
    found = interfaces.get(f"{_BLUEZ}.{interface}", {}).get(name)
    return None if found is None else found.value

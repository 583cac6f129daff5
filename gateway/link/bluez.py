"""What bleak does not offer: how many connections each adapter has, their end, and objects that bleak has missed.

BlueZ is Linux's Bluetooth service. Its adapters, devices and their GATT characteristics are objects on D-Bus. On other
systems, the functions do nothing.
"""

import asyncio
import contextlib
import sys
from typing import Any, Final

if sys.platform == "linux":  # there, bleak installs dbus_fast
    from bleak.backends.bluezdbus.manager import get_global_bluez_manager
    from dbus_fast import BusType, Message, MessageType
    from dbus_fast.aio import MessageBus

LIST_TIMEOUT_S: Final = 3.0
"""Timeout for BlueZ to list its objects."""
_BLUEZ: Final = "org.bluez"
_OBJECTS: Final = "org.freedesktop.DBus.ObjectManager"


async def list_connections() -> dict[str, int]:
    """Return the powered adapters in order, each with its number of connections. Empty if that is unknown."""
    if sys.platform != "linux":
        return {}
    found: dict[str, Any] = {}
    with contextlib.suppress(Exception):  # whatever D-Bus raises, because bleak reports the fault better
        async with asyncio.timeout(LIST_TIMEOUT_S):
            found = await _managed_objects()
    adapters = {path for path, each in found.items() if _value(each, "Adapter1", "Powered") is True}
    devices = [_value(each, "Device1", "Adapter") for each in found.values() if _value(each, "Device1", "Connected")]
    ordered = sorted(adapters, key=lambda path: (len(path), path))  # hci10 comes after hci9
    return {path.rpartition("/")[2]: devices.count(path) for path in ordered}


async def disconnect(adapter: str, address: str) -> None:
    """End the connection of an adapter to a device. Ignore errors, because they mean that there is no connection."""
    if sys.platform != "linux":
        return
    path = f"/org/bluez/{adapter}/dev_{address.upper().replace(':', '_')}"
    with contextlib.suppress(Exception):
        async with asyncio.timeout(LIST_TIMEOUT_S):
            await _call(path, f"{_BLUEZ}.Device1", "Disconnect")


async def give_bleak_missed_objects() -> None:
    """Report to bleak the objects that BlueZ has and bleak does not know. Ignore errors, because bleak reports them.

    When bleak 3.1 begins, it lists BlueZ's objects, and then forgets what signals have added. Of an object that BlueZ
    adds just after the list, the signal may be read together with the list, and is forgotten. For the rest of the
    process, bleak ignores what that module sends. This happens when several gateways start at once, because the scan of
    one adds the modules of all.

    bleak can neither be asked for all that it knows nor be told more, so this uses private members.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(Exception):
        async with asyncio.timeout(LIST_TIMEOUT_S):
            manager = await get_global_bluez_manager()
            for path, interfaces in (await _managed_objects()).items():
                if path not in manager._properties:
                    manager._parse_msg(
                        Message(
                            message_type=MessageType.SIGNAL,
                            path="/",
                            interface=_OBJECTS,
                            member="InterfacesAdded",
                            signature="oa{sa{sv}}",
                            body=[path, interfaces],
                        )
                    )


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

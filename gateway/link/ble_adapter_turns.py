"""The Bluetooth adapters of this computer: which gateway connects through one next, and how many connections it has.

An adapter can make only one connection at a time. BlueZ refuses a second attempt meanwhile (InProgress): without turns,
40 % of the attempts of several gateways failed that way. So the gateways of one user take turns: each adapter has a
lock, a file in the state directory, which is released when its holder ends. A car that may be moving goes first: its
gateway takes a second lock, the lane. While the lane is taken, other gateways do not even try. Only connecting needs a
turn. A stop is a write on an open link, and never waits.
"""

import asyncio
import contextlib
import sys
from pathlib import Path
from typing import Any, Final

from schemas.process.file_lock import FileLock
from schemas.state_dir import default_directory

if sys.platform == "linux":  # there, bleak installs dbus_fast
    from dbus_fast import BusType, Message
    from dbus_fast.aio import MessageBus

TURN_POLL_S: Final = 0.05
"""Interval of the attempts to take a turn."""
LIST_TIMEOUT_S: Final = 3.0
"""Timeout for BlueZ to list its devices."""
_BLUEZ: Final = "org.bluez"


class Turn:
    """The turn of one gateway to connect through one adapter. With `first`, its car may be moving."""

    def __init__(self, adapter: str, *, first: bool, directory: Path | None = None) -> None:
        self._first = first
        self._turn = FileLock(_directory(directory) / f"{adapter}.lock")
        self._lane = FileLock(_directory(directory) / f"{adapter}.first.lock")

    def try_take(self) -> bool:
        """Take the turn if it is free. Return True if this gateway has it now."""
        # If several cars may be moving, one of their gateways holds the lane for all. Others take it for a moment only.
        try:
            is_free = self._lane.try_take()
            if not (is_free or self._first):
                return False
            taken = self._turn.try_take()
        except OSError:  # a lock file cannot be made: it is better to connect without a turn than never
            return True
        if taken or not self._first:
            self._lane.release()
        return taken

    def release(self) -> None:
        """Let the next gateway connect, and leave the lane."""
        self._turn.release()
        self._lane.release()


class ConnectionNote:
    """A file that says which device a gateway has connected through which adapter.

    If a gateway is killed, the system keeps its connection. Only this file shows that it belonged to a gateway.
    """

    def __init__(self, adapter: str, address: str, directory: Path | None = None) -> None:
        self.adapter, self.address = adapter, address.upper()
        self._path = _directory(directory) / f"{adapter}.{self.address.replace(':', '_')}.connected"

    @classmethod
    def all_of(cls, adapter: str, directory: Path | None = None) -> "list[ConnectionNote]":
        """Return the notes of an adapter."""
        found = sorted(_directory(directory).glob(f"{adapter}.*.connected"))
        return [cls(adapter, path.name.split(".")[1].replace("_", ":"), directory) for path in found]

    def write(self) -> None:
        """Write the file, if that is possible."""
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.touch()

    def remove(self) -> None:
        """Remove the file."""
        with contextlib.suppress(OSError):
            self._path.unlink()

    async def disconnect(self) -> None:
        """End the connection of a gateway that has ended."""
        await disconnect(self.adapter, self.address)
        self.remove()


def _directory(directory: Path | None) -> Path:
    return (default_directory() if directory is None else directory) / "bluetooth"


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


async def _managed_objects() -> dict[str, Any]:
    (found,) = await _call("/", "org.freedesktop.DBus.ObjectManager", "GetManagedObjects")
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

"""The other ends of links: the master of a PTY, a TCP server, a module of a Bluetooth service in this process.

Each behaves as a car's end can. The link uses its real library: pyserial, a socket, or bleak's BlueZ backend.
"""

import asyncio
import contextlib
import os
import pty
import socket
import struct
import tempfile
import threading
import tty
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.link import LinkUrl, ble
from schemas.links import BleUrl, SerialUrl, TcpUrl
from schemas.state_dir import STATE_VARIABLE

if TYPE_CHECKING:
    from tests.support.bluez import Adapter

SYSTEM_BUS = "DBUS_SYSTEM_BUS_ADDRESS"
PATIENCE_S = 20.0


class Peer(ABC):
    """A car's end of a link."""

    url: LinkUrl

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send all bytes. Block while the link takes none."""

    @abstractmethod
    def receive(self, size: int) -> bytes:
        """Return exactly `size` bytes."""

    @abstractmethod
    def die(self) -> None:
        """Close the connection. A PTY closes as an unplugged port does."""

    @abstractmethod
    def revive(self) -> None:
        """Come back under the same URL."""

    @abstractmethod
    def stall(self) -> None:
        """Take no more bytes, but keep the connection."""

    @abstractmethod
    def close(self) -> None:
        """Close everything."""


class PtyPeer(Peer):
    """The master of a PTY, behind a symlink that outlives it, as /dev/serial/by-id does."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / "tty"
        self.url = SerialUrl(str(self._path))
        self._master: int | None = None
        self.revive()

    def send(self, data: bytes) -> None:
        assert self._master is not None
        while data:
            data = data[os.write(self._master, data) :]

    def receive(self, size: int) -> bytes:
        assert self._master is not None
        data = b""
        while len(data) < size:
            data += os.read(self._master, size - len(data))
        return data

    def die(self) -> None:
        if self._master is not None:
            os.close(self._master)
            self._master = None
            self._path.unlink()

    def revive(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def stall(self) -> None:
        pass  # without a reader, the buffer fills

    def close(self) -> None:
        self.die()


class TcpPeer(Peer):
    """A server that takes one connection at a time."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = TcpUrl("127.0.0.1", self._listener.getsockname()[1])
        self._peer: socket.socket | None = None

    @property
    def peer(self) -> socket.socket:
        """Wait for a connection, and return it."""
        if self._peer is None:
            self._peer, _ = self._listener.accept()
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._peer

    def send(self, data: bytes) -> None:
        self.peer.sendall(data)

    def receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = self.peer.recv(size - len(data))
            assert piece, "hung up"
            data += piece
        return data

    def die(self) -> None:
        self.peer.close()
        self._peer = None

    def reset(self) -> None:
        """Close the connection with a real RST."""
        self.peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.die()

    def revive(self) -> None:
        pass  # the server always listens

    def stall(self) -> None:
        pass  # without a reader, the buffer fills

    def close(self) -> None:
        if self._peer is not None:
            self._peer.close()
        self._listener.close()


class BlePeer(Peer):
    """A module of a private BlueZ."""

    def __init__(self, *adapters: "Adapter") -> None:
        from tests.support.bluez import FakeBluez, Module, free_address  # Linux only, as dbus_fast

        self.module = Module(free_address(), "BT04")
        self.bluez = FakeBluez(self.module, adapters=adapters)
        self.url = BleUrl(self.module.address)
        self._state = tempfile.TemporaryDirectory()
        # The adapter of another test must not keep this one waiting.
        changed = {SYSTEM_BUS: self.bluez.address, STATE_VARIABLE: self._state.name}
        self._before = {name: os.environ.get(name) for name in changed}
        os.environ.update(changed)
        self._write_s = ble.BLE_WRITE_TIMEOUT_S
        # on a busy machine, both ends may stall for longer than the timeout of a command
        ble.BLE_WRITE_TIMEOUT_S = PATIENCE_S  # type: ignore[misc]

    def send(self, data: bytes) -> None:
        self.bluez.notify(self.module, data)

    def receive(self, size: int) -> bytes:
        return self.bluez.written(self.module, size)

    def die(self) -> None:
        self.bluez.switch(self.module, on=False)

    def revive(self) -> None:
        self.bluez.switch(self.module, on=True)

    def stall(self) -> None:
        self.stall_after(0)

    def stall_after(self, pieces: int) -> None:
        """Take `pieces` more pieces, then no more."""
        self.module.takes = pieces
        ble.BLE_WRITE_TIMEOUT_S = self._write_s  # type: ignore[misc]

    def close(self) -> None:
        self.bluez.close()
        ble.BLE_WRITE_TIMEOUT_S = self._write_s  # type: ignore[misc]
        for name, value in self._before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        self._state.cleanup()


async def settled() -> None:
    """Wait until all other tasks have ended. bleak keeps one bus per loop, and must notice the end of the bus."""
    async with asyncio.timeout(PATIENCE_S):
        while others := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(others)


def open_descriptors() -> dict[str, str]:
    """Return the open descriptors of this process, none if the system does not list them."""
    found = {}
    with contextlib.suppress(FileNotFoundError):
        for each in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):
                found[each.name] = str(each.readlink())
    return found


async def no_threads() -> None:
    """Wait until the threads of links have ended."""
    for thread in link_threads():
        await asyncio.to_thread(thread.join, PATIENCE_S)
        assert not thread.is_alive()


def link_threads() -> list[threading.Thread]:
    """Return the threads of links."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("read ")]

"""The end of a simulated car's link that a host opens: a pseudo terminal or a listening TCP port.

A link passes the host's bytes to its owner. Bytes that the car sends while there is no host are lost on TCP. A terminal
keeps them until its buffer is full, but a gateway drops them when it opens the terminal, as pyserial does.
"""

import asyncio
import contextlib
import os
import re
import socket
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from gateway.sim.model.line_rate import misread

READ_SIZE = 128
PORT_BAUD = 9600
"""Rate of a port that no host has set, as Linux sets those of a serial adapter."""
ODD_BAUD = 250_000
"""Stands for a rate that the system has no constant for. No car has such a rate."""
_RATE = re.compile(r"B[1-9]\d*")
_TERMINAL = re.compile(r"/dev/(pts/|ttys)\d+")
# A file system may store whole seconds only.
_FILE_TIME_MARGIN_S = 2.0


class EndpointError(Exception):
    """A link cannot be opened or renamed. The message says why."""


class Taken(EndpointError):
    """The path of a link is in use. The exit code is the one for wrong arguments."""


class Owner(Protocol):
    """The car behind a link."""

    def received(self, data: bytes) -> None:
        """Accept bytes from the host."""

    def connected(self) -> None:
        """Record that a host has connected (TCP only)."""

    def disconnected(self) -> None:
        """Record that the host has disconnected (TCP only)."""


class SimEndpoint(Protocol):
    """The common part of both kinds of links."""

    _held: bool = False
    _stuck: bool = False

    @property
    def url(self) -> str:
        """The URL that a gateway opens."""

    async def up(self) -> None:
        """Open the link for a host. Raises EndpointError if it cannot open: its port or path may be taken."""

    async def down(self) -> None:
        """Close the link, as when a cable is unplugged or a network is lost. `up` opens it again."""

    def send(self, data: bytes) -> None:
        """Send bytes to the host, if there is one."""

    def hold(self, *, on: bool) -> None:
        """Pause or resume reading. During a pause the host can write until the system's buffers are full."""
        self._held = on
        self._update_reading()

    def stick(self, *, on: bool) -> None:
        """Stop or resume reading, as a stuck device does.

        The next write to a PTY blocks at once. With TCP, the systems of both sides buffer up to some megabytes (4 MB
        were measured on Linux), which arrive later.
        """
        self._stuck = on
        self._update_reading()

    def _update_reading(self) -> None:
        """Read unless the link is held or stuck."""

    def rename(self, path: str | None) -> None:
        """Become another device at the next `up`, at `path` if not None. Raises EndpointError if that cannot be."""

    async def close(self) -> None:
        """Close the link for good, and remove its symlink or sockets."""


class PtyEndpoint(SimEndpoint):
    """A pseudo terminal; POSIX only.

    Its bytes have no rate, so it garbles them itself if the host sets another rate than that of the car, `baud`. If
    `baud` is None, any rate is right.
    """

    def __init__(self, owner: Owner, path: str | None, baud: int | None = None) -> None:
        try:
            import pty
            import termios
            import tty
        except ImportError:
            raise EndpointError(
                "a pty link needs Linux or macOS, because this system has no pseudo terminals: use tcp://127.0.0.1:0"
            ) from None
        self._openpty: Callable[[], tuple[int, int]] = pty.openpty
        self._setraw: Callable[[int], object] = tty.setraw
        self._tcflow: Callable[[int, int], object] = termios.tcflow
        self._flow_on, self._flow_off = termios.TCOON, termios.TCOOFF
        self._attributes: Callable[[int], list[Any]] = termios.tcgetattr
        self._set_attributes: Callable[[int, int, list[Any]], None] = termios.tcsetattr
        self._set_now = termios.TCSANOW
        # The numbers of its constants B9600, B115200 and so on belong to this system.
        self._rates = {value: int(name[1:]) for name, value in vars(termios).items() if _RATE.fullmatch(name)}
        self._baud = baud
        self._owner = owner
        self._path = Path(path) if path else None
        self._master = self._slave = -1
        self._next: tuple[int, int] | None = None
        self._name = ""
        self._reading = False

    @property
    def url(self) -> str:
        """The device, or the stable symlink to it, as `serial://` URL."""
        return f"serial://{self._path.absolute() if self._path else self._name}"

    async def up(self) -> None:
        """Open a new terminal and point the symlink at it."""
        self._master, self._slave = self._next or self._open()
        self._next = None
        # The slave stays open here, so that the terminal and its raw mode last while no host has it open.
        self._setraw(self._slave)
        self._set_rate(PORT_BAUD)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._path is not None:
            try:
                self._point(self._path)
            except EndpointError:
                await self.down()
                raise
        self._held = False
        self._update_reading()
        self._tcflow(self._slave, self._flow_off if self._stuck else self._flow_on)

    def _open(self) -> tuple[int, int]:
        try:
            return self._openpty()
        except OSError as error:
            raise EndpointError(f"The system has no free pseudo terminal: {error.strerror}") from None

    def _point(self, path: Path) -> None:
        """Create the symlink. Replace nothing at this path except the symlink that a killed simulator has left."""
        if self._is_leftover(path):
            path.unlink(missing_ok=True)
        try:
            path.symlink_to(self._name)
        except FileExistsError:
            what = "is there already"
            if path.is_symlink():
                what = f"leads to {path.readlink()}"
                if _TERMINAL.fullmatch(str(path.readlink())):
                    what += ", which is in use, perhaps by another simulator"
            raise Taken(f"{path} {what}: name another path, or remove it") from None
        except OSError as error:
            raise EndpointError(f"no symlink can be made at {path}: {error.strerror}") from None

    def _is_leftover(self, path: Path) -> bool:
        """Return True if the symlink's terminal is gone, or if its number belongs to a newer terminal."""
        if not path.is_symlink() or not _TERMINAL.fullmatch(target := str(path.readlink())):
            return False
        try:
            opened_s = path.stat().st_ctime
        except OSError:
            return True
        # Only on Linux, because macOS never removes the nodes of its terminals.
        newer = sys.platform == "linux" and opened_s > path.lstat().st_mtime + _FILE_TIME_MARGIN_S
        return target == self._name or newer

    def _readable(self) -> None:
        try:
            data = os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return
        except OSError:  # macOS: the last host has closed the slave; wait for the next one
            return
        self._owner.received(self._garbled(data, to_host=False))

    def _set_rate(self, baud: int) -> None:
        attributes = self._attributes(self._slave)
        attributes[4] = attributes[5] = next(value for value, rate in self._rates.items() if rate == baud)
        self._set_attributes(self._slave, self._set_now, attributes)

    def _garbled(self, data: bytes, *, to_host: bool) -> bytes:
        """Return what arrives of the bytes at the rate that the host has set."""
        if self._baud is None or self._slave < 0:
            return data
        host = self._rates.get(self._attributes(self._slave)[4 if to_host else 5], ODD_BAUD)
        if host == self._baud:
            return data
        sent_at, read_at = (self._baud, host) if to_host else (host, self._baud)
        return misread(data, sent_at=sent_at, read_at=read_at)

    def stick(self, *, on: bool) -> None:
        """Stop or resume reading, and the terminal's output: while it is stopped, the host's writes block at once."""
        super().stick(on=on)
        if self._master >= 0:
            self._tcflow(self._slave, self._flow_off if on else self._flow_on)

    def _update_reading(self) -> None:
        reading = not (self._held or self._stuck)
        if self._master < 0 or reading == self._reading:
            return
        loop = asyncio.get_running_loop()
        if reading:
            loop.add_reader(self._master, self._readable)
        else:
            loop.remove_reader(self._master)
        self._reading = reading

    def rename(self, path: str | None) -> None:
        """Open the next terminal now, while this one is still open, so that it gets another number."""
        if path is not None:
            new = Path(path)
            if new != self._path and (new.exists() or new.is_symlink()):
                raise EndpointError(f"{path} is there already: name another path")
            if not new.parent.is_dir():
                raise EndpointError(f"no symlink can be made at {path}: its directory is not there")
        if self._next is None:
            self._next = self._open()
        if path is not None:
            self._unlink()
            self._path = Path(path)

    def send(self, data: bytes) -> None:
        """Send bytes. As on a UART, bytes that do not fit are lost."""
        if self._master >= 0:
            with contextlib.suppress(BlockingIOError, OSError):
                os.write(self._master, self._garbled(data, to_host=True))

    async def down(self) -> None:
        """Close both ends: a host sees an unplugged cable."""
        if self._master < 0:
            return
        self.hold(on=True)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        self._unlink()

    def _unlink(self) -> None:
        if self._path is not None and self._path.is_symlink() and str(self._path.readlink()) == self._name:
            self._path.unlink(missing_ok=True)

    async def close(self) -> None:
        """Close both ends and remove the symlink."""
        await self.down()
        for end in self._next or ():
            os.close(end)
        self._next = None


class TcpEndpoint(SimEndpoint):
    """A listening port with one host at a time."""

    def __init__(self, owner: Owner, host: str, port: int) -> None:
        self._owner = owner
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._next: socket.socket | None = None
        self._transport: asyncio.Transport | None = None

    @property
    def url(self) -> str:
        """`tcp://HOST:PORT` with the real port."""
        return f"tcp://[{self._host}]:{self._port}" if ":" in self._host else f"tcp://{self._host}:{self._port}"

    async def up(self) -> None:
        """Listen. From the second time on, use the port of the last time again, unless `rename` has bound another."""
        if self._server is not None:
            return
        loop = asyncio.get_running_loop()
        taken, self._next = self._next, None
        try:
            if taken is not None:
                self._server = await loop.create_server(lambda: _Client(self), sock=taken)
            else:
                self._server = await loop.create_server(
                    lambda: _Client(self), self._host, self._port, reuse_address=os.name == "posix"
                )
        except OSError as error:
            raise self._cannot_listen(self._port, error) from None
        self._port = self._server.sockets[0].getsockname()[1]

    def _cannot_listen(self, port: int, error: OSError) -> EndpointError:
        words = error.strerror or str(error)
        return EndpointError(f"cannot listen on {self._host}:{port}: {words}; name another port, or 0 for any free one")

    def rename(self, path: str | None) -> None:
        """Bind another port now, while this one is still in use."""
        if path is not None:
            raise EndpointError(f"path {path} is not allowed for a TCP link, which has no path")
        if self._next is None:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            self._next = socket.socket(family, socket.SOCK_STREAM)
            try:
                self._next.bind((self._host, 0))
            except OSError as error:
                self._next.close()
                self._next = None
                raise self._cannot_listen(0, error) from None

    def admit(self, transport: asyncio.Transport) -> bool:
        """Accept a host. Return False if another host is connected already."""
        if self._transport is not None:
            return False
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._transport = transport
        self._held = False
        self._update_reading()
        self._owner.connected()
        return True

    def received(self, data: bytes) -> None:
        """Pass bytes to the owner."""
        self._owner.received(data)

    def on_host_gone(self, transport: asyncio.Transport) -> None:
        """Record the end of a connection, unless this link has cut it itself."""
        if transport is self._transport:
            self._transport = None
            self._owner.disconnected()

    def send(self, data: bytes) -> None:
        """Send bytes. They are lost if the host does not read."""
        if self._transport is not None and self._transport.get_write_buffer_size() < 65536:
            self._transport.write(data)

    def _update_reading(self) -> None:
        if self._transport is not None:
            if self._held or self._stuck:
                self._transport.pause_reading()
            else:
                self._transport.resume_reading()

    async def down(self) -> None:
        """Stop listening and reset the connection."""
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._transport is not None:
            # Linger 0 turns the close into a reset. A host also gets one from a bridge that lost its power and is back.
            linger = struct.pack("HH" if os.name == "nt" else "ii", 1, 0)
            self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            transport, self._transport = self._transport, None
            transport.abort()
            self._owner.disconnected()

    async def close(self) -> None:
        """Close the connection and all sockets."""
        await self.down()
        if self._next is not None:
            self._next.close()
            self._next = None


class _Client(asyncio.BufferedProtocol):
    """One TCP connection, read in small pieces so that a flood of bytes can be paused early."""

    def __init__(self, link: TcpEndpoint) -> None:
        self._link = link
        self._piece = bytearray(READ_SIZE)
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._link.admit(transport):
            self._transport = transport
        else:
            transport.abort()

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002 - asyncio's signature
        return self._piece

    def buffer_updated(self, nbytes: int) -> None:
        if self._transport is not None:
            self._link.received(bytes(self._piece[:nbytes]))

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's signature
        if self._transport is not None:
            self._link.on_host_gone(self._transport)

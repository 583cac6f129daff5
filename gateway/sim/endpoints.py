"""The ends of a simulated car's link that a host opens: a pseudo terminal or a listening TCP port.

Bytes only; pacing and meaning are the core's. What comes from a host goes to the link's owner; what nobody
takes is swallowed, as by a wire.
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
from typing import Protocol

READ_SIZE = 128
_TERMINAL = re.compile(r"/dev/(pts/|ttys)\d+")
_CLOCKS_S = 2.0
"""A file system may keep whole seconds only."""


class EndpointError(Exception):
    """A link cannot be opened; its text says why and what to do."""


class Taken(EndpointError):
    """Something else is at the path that a link was to have: wrong use."""


class Owner(Protocol):
    """Who runs the car behind a link."""

    def received(self, data: bytes) -> None:
        """Bytes from the host."""
        ...

    def connected(self) -> None:
        """A host has connected (TCP only: a wire does not tell)."""
        ...

    def disconnected(self) -> None:
        """The host has gone away (TCP only)."""
        ...


class SimLink(Protocol):
    """What the shell needs of either link."""

    @property
    def url(self) -> str:
        """What a gateway opens."""
        ...

    async def up(self) -> None:
        """Be there; raises LinkError."""
        ...

    async def down(self) -> None:
        """Be gone, as after an unplugged cable or a lost network; `up` brings it back."""
        ...

    def send(self, data: bytes) -> None:
        """Bytes to the host, if there is one."""
        ...

    def hold(self, *, on: bool) -> None:
        """Stop or resume taking bytes from the host, which may go on until the system's buffers are full."""
        ...

    def stick(self, *, on: bool) -> None:
        """Take nothing more, as a device that has stopped reading; a host's writes wait where the system lets them."""
        ...

    def rename(self, path: str | None) -> None:
        """Be another device when `up` comes next, at another path if one is given; raises LinkError."""
        ...

    async def close(self) -> None:
        """Be gone for good, leaving nothing behind."""
        ...


class PtySimLink:
    """A pseudo terminal; POSIX only."""

    def __init__(self, owner: Owner, path: str | None) -> None:
        try:
            import pty
            import termios
            import tty
        except ImportError:
            raise EndpointError(
                "a pty link needs Linux or macOS, this system has no pseudo terminals: use tcp://127.0.0.1:0"
            ) from None
        self._openpty: Callable[[], tuple[int, int]] = pty.openpty
        self._setraw: Callable[[int], object] = tty.setraw
        self._tcflow: Callable[[int, int], object] = termios.tcflow
        self._flow_on, self._flow_off = termios.TCOON, termios.TCOOFF
        self._owner = owner
        self._path = Path(path) if path else None
        self._master = self._slave = -1
        self._next: tuple[int, int] | None = None
        self._name = ""
        self._reading = self._held = self._stuck = False

    @property
    def url(self) -> str:
        """`serial://` and the device, or the stable symlink to it."""
        return f"serial://{self._path.absolute() if self._path else self._name}"

    async def up(self) -> None:
        """Open a new terminal, and point the symlink at it."""
        self._master, self._slave = self._next or self._open()
        self._next = None
        # Our own hold on the slave keeps the terminal and its raw mode while no host has it open.
        self._setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._path is not None:
            try:
                self._point(self._path)
            except EndpointError:
                await self.down()
                raise
        self._held = False
        self._settle()
        self._tcflow(self._slave, self._flow_off if self._stuck else self._flow_on)

    def _open(self) -> tuple[int, int]:
        try:
            return self._openpty()
        except OSError as error:
            raise EndpointError(f"no pseudo terminal to be had: {error.strerror}") from None

    def _point(self, path: Path) -> None:
        """What a killed simulator has left may be replaced, anything else may not."""
        if self._left_over(path):
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

    def _left_over(self, path: Path) -> bool:
        """Whether this symlink's terminal is gone, or its number another's by now, opened after the link was made."""
        if not path.is_symlink() or not _TERMINAL.fullmatch(target := str(path.readlink())):
            return False
        try:
            opened_s = path.stat().st_ctime
        except OSError:
            return True
        # macOS keeps the nodes of its terminals.
        newer = sys.platform == "linux" and opened_s > path.lstat().st_mtime + _CLOCKS_S
        return target == self._name or newer

    def _readable(self) -> None:
        try:
            data = os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return
        except OSError:  # macOS: the last host has closed the slave; the next one is waited for
            return
        self._owner.received(data)

    def hold(self, *, on: bool) -> None:
        """Stop or resume reading; a host that goes on writing blocks after some kilobytes."""
        self._held = on
        self._settle()

    def stick(self, *, on: bool) -> None:
        """As with flow control: a host's next write blocks at once."""
        self._stuck = on
        self._settle()
        if self._master >= 0:
            self._tcflow(self._slave, self._flow_off if on else self._flow_on)

    def _settle(self) -> None:
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
        """The next terminal is opened while this one still has its number, so that it gets another."""
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
        """A UART does not wait: what does not fit is lost."""
        if self._master >= 0:
            with contextlib.suppress(BlockingIOError, OSError):
                os.write(self._master, data)

    async def down(self) -> None:
        """Close both ends: for a host the same as an unplugged cable."""
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
        """The same: its symlink goes with it."""
        await self.down()
        for end in self._next or ():
            os.close(end)
        self._next = None


class TcpSimLink:
    """A listening port with one host at a time."""

    def __init__(self, owner: Owner, host: str, port: int) -> None:
        self._owner = owner
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._next: socket.socket | None = None
        self._held = self._stuck = False
        self._transport: asyncio.Transport | None = None

    @property
    def url(self) -> str:
        """`tcp://HOST:PORT` with the real port."""
        return f"tcp://[{self._host}]:{self._port}" if ":" in self._host else f"tcp://{self._host}:{self._port}"

    async def up(self) -> None:
        """Listen; after the first time on the same port again."""
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
        """Another port, taken while this one is still in use."""
        if path is not None:
            raise EndpointError(f"{path} is not for a TCP link: it has no path")
        if self._next is None:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            self._next = socket.socket(family, socket.SOCK_STREAM)
            try:
                self._next.bind((self._host, 0))
            except OSError as error:
                self._next.close()
                self._next = None
                raise self._cannot_listen(0, error) from None

    def joined(self, transport: asyncio.Transport) -> bool:
        """Whether this host is the one; a second is sent away."""
        if self._transport is not None:
            return False
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._transport = transport
        self._held = False
        self._settle()
        self._owner.connected()
        return True

    def received(self, data: bytes) -> None:
        """Bytes from the host."""
        self._owner.received(data)

    def left(self, transport: asyncio.Transport) -> None:
        """A connection has ended; it may have been cut from here before."""
        if transport is self._transport:
            self._transport = None
            self._owner.disconnected()

    def send(self, data: bytes) -> None:
        """A host that does not read loses bytes, not we memory."""
        if self._transport is not None and self._transport.get_write_buffer_size() < 65536:
            self._transport.write(data)

    def hold(self, *, on: bool) -> None:
        """Stop or resume reading."""
        self._held = on
        self._settle()

    def stick(self, *, on: bool) -> None:
        """The systems at both ends go on taking some hundred kilobytes; all of it arrives when it is over."""
        self._stuck = on
        self._settle()

    def _settle(self) -> None:
        if self._transport is not None:
            if self._held or self._stuck:
                self._transport.pause_reading()
            else:
                self._transport.resume_reading()

    async def down(self) -> None:
        """Refuse, and reset the connection there is."""
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._transport is not None:
            # Linger 0 makes the close a reset, which is what a host sees of a bridge that lost its power.
            linger = struct.pack("HH" if os.name == "nt" else "ii", 1, 0)
            self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            transport, self._transport = self._transport, None
            transport.abort()
            self._owner.disconnected()

    async def close(self) -> None:
        """The same."""
        await self.down()
        if self._next is not None:
            self._next.close()
            self._next = None


class _Client(asyncio.BufferedProtocol):
    """One TCP connection, read in small pieces so that a firehose can be held back early."""

    def __init__(self, link: TcpSimLink) -> None:
        self._link = link
        self._piece = bytearray(READ_SIZE)
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._link.joined(transport):
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
            self._link.left(self._transport)

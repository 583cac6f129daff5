"""A TCP connection to a car, or to a bridge: one write per frame, never two frames in one segment by our doing."""

import asyncio
import contextlib
import os
import socket
from typing import Final

from gateway.link.base import CannotOpen, Link, LinkLost
from gateway.link.url import TcpUrl

HELD_BYTES: Final = 64 * 1024
"""Bytes that may wait for a loop that does not read; then the socket is not read, and the car's side waits."""
CLOSE_S: Final = 1.0
_KEEPALIVE: Final = (("TCP_KEEPIDLE", 3), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 5000))
"""A peer that has vanished without a word is noticed within about five seconds, where the system allows."""


class TcpLink(asyncio.Protocol, Link):
    """One connection. Made by `open_tcp`."""

    def __init__(self, url: TcpUrl) -> None:
        self._url = url
        self._transport: asyncio.Transport | None = None
        self._data = bytearray()
        self._came = asyncio.Event()
        self._ended = asyncio.Event()
        self._lost: str | None = None
        self._paused = False

    async def read(self) -> bytes:
        """The next bytes as they came; raises LinkLost."""
        while not self._data:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        data = bytes(self._data)
        self._data.clear()
        if self._paused and self._transport is not None and not self._transport.is_closing():
            self._paused = False
            self._transport.resume_reading()
        return data

    async def write(self, data: bytes) -> None:
        """Send these bytes in a segment of their own; raises LinkLost."""
        transport = self._transport
        if transport is None or self._lost is not None or transport.is_closing():
            raise LinkLost(self._lost or f"{self._url} is closed")
        if transport.get_write_buffer_size():
            # What waits would go out together with this, and a car obeys only the first frame of a segment.
            transport.abort()
            raise LinkLost(f"{self._url} takes no bytes: the car or its bridge has stopped reading")
        transport.write(data)

    async def close(self) -> None:
        """Close in order; what is not closed after a second is cut."""
        transport = self._transport
        if transport is None:
            return
        self._lost = self._lost or f"{self._url} was closed"
        self._came.set()
        transport.close()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._ended.wait(), CLOSE_S)
        transport.abort()

    # ------------------------------------------------------------------ asyncio's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set the socket up."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer: socket.socket = transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            option = getattr(socket, name, None)
            if option is not None:
                peer.setsockopt(socket.IPPROTO_TCP, option, value)

    def data_received(self, data: bytes) -> None:
        """Keep bytes until they are read, so many and no more."""
        self._data += data
        self._came.set()
        if len(self._data) > HELD_BYTES and not self._paused and self._transport is not None:
            self._paused = True
            self._transport.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """Note why."""
        self._lost = self._lost or f"{self._url} is gone: " + ("the car closed it" if exc is None else _cause(exc))
        self._came.set()
        self._ended.set()


async def open_tcp(url: TcpUrl, timeout_s: float) -> Link:
    """Connect; raises CannotOpen."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(timeout_s):
            _, link = await loop.create_connection(lambda: TcpLink(url), url.host, url.port)
    except TimeoutError:
        raise CannotOpen(f"{url}: no answer within {timeout_s:g} s: is the car on, and in this network?") from None
    except (socket.gaierror, UnicodeError):  # UnicodeError: a label too long for a host name
        raise CannotOpen(f"{url}: there is no host {url.host!r}: check the name, or give its address") from None
    except ConnectionRefusedError:
        words = (
            "nothing listens on that port (a Raspberry Pi car's program dies with its last client: restart it there)"
        )
        raise CannotOpen(f"{url}: {words}") from None
    except OSError as error:
        raise CannotOpen(f"{url}: no connection, {_cause(error)}") from None
    return link


def _cause(error: Exception) -> str:
    code = getattr(error, "errno", None)
    return os.strerror(code).lower() if isinstance(code, int) and code > 0 else str(error) or type(error).__name__

"""A TCP connection to a car or a bridge. Each frame is one write, sent at once.

If the network loses a segment, the system may join the frames of two writes when it sends them again.
"""

import asyncio
import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any, Final

from gateway.link.base import CLOSE_S, Link, LinkKind
from gateway.link.buffered_link import MAX_BUFFERED_BYTES, BufferedLink
from gateway.link.link_exceptions import CannotOpen, LinkLost
from schemas.links import TcpUrl

# A vanished peer is noticed within about five seconds, where the system has these options.
_KEEPALIVE: Final = (("TCP_KEEPIDLE", 3), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 5000))

REJECTED_WITHIN_S: Final = 3.0
"""Time within which a bridge that already has a client closes a new connection. It may send a text before that, which
says why. If a connection lasts longer, all its bytes come from a car."""
MAX_QUOTE_BYTES: Final = 120
"""Maximum length of the quote from a bridge in an error message, bytes."""

_Addresses = list[tuple[int, Any]]
"""(family, socket address), as from getaddrinfo."""
_lookups: Final[dict[TcpUrl, "Future[_Addresses]"]] = {}
"""The last name lookup for each link."""


class TcpLink(asyncio.Protocol, BufferedLink):
    """One connection, created by `TcpKind.open`."""

    def __init__(self, url: TcpUrl) -> None:
        super().__init__()
        self._url = url
        self._transport: asyncio.Transport | None = None
        self._ended = asyncio.Event()
        self._first = b""
        """The first received bytes. They may be the text of a bridge that is in use."""
        self._paused = False
        self._made_at = 0.0

    async def read(self) -> bytes:
        """Wait for bytes and return them as they arrived. Raises LinkLost if the link ends."""
        data = await super().read()
        if self._paused and self._transport is not None and not self._transport.is_closing():
            self._paused = False
            self._transport.resume_reading()
        return data

    async def write(self, data: bytes) -> None:
        """Send these bytes at once, in a write of their own. Raises LinkLost if the connection is gone or stuck."""
        transport = self._transport
        if transport is not None and self._lost is None and transport.is_closing():
            await self._ended.wait()  # connection_lost sets the reason
        if transport is None or self._lost is not None:
            raise LinkLost(self._lost or f"{self._url} is closed")
        if transport.get_write_buffer_size():
            # The buffered frame would be sent together with this one, and a car obeys only the first one in a segment.
            self._lost = f"{self._url} accepts no bytes: the car or its bridge has stopped reading"
            self._came.set()
            transport.abort()
            raise LinkLost(self._lost)
        transport.write(data)
        if transport.is_closing():  # after a reset, asyncio calls connection_lost instead of raising
            await self._ended.wait()
            raise LinkLost(self._lost)

    async def close(self) -> None:
        """Close the connection. If it is not closed after a second, cut it."""
        transport = self._transport
        if transport is None:
            return
        self._lost = self._lost or f"{self._url} was closed"
        self._came.set()
        transport.close()
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ended.wait(), CLOSE_S)
        finally:
            transport.abort()

    # ------------------------------------------------------------------ asyncio's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set the socket options."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._made_at = time.monotonic()
        peer: socket.socket = transport.get_extra_info("socket")
        # macOS refuses the options if the connection is already reset. Then connection_lost follows.
        with contextlib.suppress(OSError):
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEPALIVE:
                option = getattr(socket, name, None)
                if option is not None:
                    peer.setsockopt(socket.IPPROTO_TCP, option, value)

    def data_received(self, data: bytes) -> None:
        """Buffer bytes for `read`, and pause the socket if the buffer is full."""
        if len(self._first) <= MAX_QUOTE_BYTES:
            self._first += data[: MAX_QUOTE_BYTES + 1]
        self._data += data
        self._came.set()
        if len(self._data) > MAX_BUFFERED_BYTES and not self._paused and self._transport is not None:
            self._paused = True
            self._transport.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """Store why the connection ended."""
        why = "the car closed it" if exc is None else _cause(exc)
        # A car serves one client and rejects the next. A bridge, such as ser2net, often says why before it closes.
        is_early = time.monotonic() - self._made_at < REJECTED_WITHIN_S
        said = _bridge_text(self._first) if is_early else ""
        peer_closed = exc is None or isinstance(exc, ConnectionResetError)
        if peer_closed and (said or not self._first):
            why += f', and said "{said}".' if said else " before it sent anything."
            why += " Perhaps another gateway or program is connected to it."
        self._lost = self._lost or f"{self._url} is gone: {why}"
        self._came.set()
        self._ended.set()


def _bridge_text(data: bytes) -> str:
    """Return what a bridge said before it closed, with control characters escaped. Empty for a car's bytes."""
    text = data.decode(errors="replace").strip()
    printed = sum(each.isprintable() and each != "\ufffd" for each in text)
    if b"$" in data or text.startswith("{") or 2 * printed < len(text):  # frames, JSON, or no text
        return ""
    shown = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
    return shown[:MAX_QUOTE_BYTES] + ("..." if len(shown) > MAX_QUOTE_BYTES else "")


class TcpKind(LinkKind[TcpUrl]):
    """Opens TCP links."""

    async def open(self, url: TcpUrl, timeout_s: float, *, first: bool) -> Link:  # noqa: ARG002 - there is no queue
        """Connect. Raises CannotOpen if nobody answers."""
        try:
            async with asyncio.timeout(timeout_s):
                return await connect_first(url, await _look_up(url))
        except TimeoutError:
            raise CannotOpen(f"{url}: no answer within {timeout_s:g} s. Is the car on, and in this network?") from None
        except (socket.gaierror, UnicodeError):  # UnicodeError: a label too long for a host name
            raise CannotOpen(f"{url}: there is no host {url.host!r}. Check the name, or use its address.") from None
        except ConnectionRefusedError:
            reason = (
                "nothing listens on that port. If the car's own program died, the car may be driving: look at it, "
                "switch it off, and start it again."
            )
            raise CannotOpen(f"{url}: {reason}") from None
        except OSError as error:
            raise CannotOpen(f"{url}: no connection, {_cause(error)}") from None


KIND: Final = TcpKind()


async def _look_up(url: TcpUrl) -> _Addresses:
    """Return the addresses of the host. Raises the errors of getaddrinfo."""
    # If the name server is silent, getaddrinfo blocks for a minute and cannot be cancelled. So run it in a daemon
    # thread. A thread of the loop would keep the process alive for that minute. All attempts share one lookup.
    found = _lookups.get(url)
    if found is None or found.done():
        found = Future()
        found.set_running_or_notify_cancel()  # now a waiter that is cancelled does not cancel the lookup
        threading.Thread(target=_resolve, args=(url, found), name=f"look up {url}", daemon=True).start()
        _lookups[url] = found
    return await asyncio.wrap_future(found)


def _resolve(url: TcpUrl, found: "Future[_Addresses]") -> None:
    try:
        answers = socket.getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM)
    except Exception as error:  # noqa: BLE001 - the waiter raises it again
        found.set_exception(error)
    else:
        found.set_result([(family, address) for family, _, _, _, address in answers])


async def connect_first(url: TcpUrl, addresses: Iterable[tuple[int, Any]]) -> Link:
    """Connect to the first (family, socket address) that accepts. If none does, raise the first OSError."""
    # `create_connection` could try all addresses of a name. But if several fail, its error has no number, only a text.
    loop = asyncio.get_running_loop()
    first: OSError | None = None
    for family, address in addresses:
        peer = None
        try:
            peer = socket.socket(family, socket.SOCK_STREAM)
            peer.settimeout(0)
            await loop.sock_connect(peer, address)
            _, link = await loop.create_connection(lambda: TcpLink(url), sock=peer)
        except BaseException as error:
            if peer is not None:
                peer.close()
            if not isinstance(error, OSError):
                raise
            first = first or error
        else:
            return link
    raise first or OSError("the name has no address")


def _cause(error: Exception) -> str:
    code = getattr(error, "errno", None)
    return os.strerror(code).lower() if isinstance(code, int) and code > 0 else str(error) or type(error).__name__

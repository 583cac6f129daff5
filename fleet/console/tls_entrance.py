"""Accepts the connections of the network and hands them to TLS at a bounded rate.

`waiting_room` decides which one is next.
"""

import asyncio
import gc
import random
import socket
import ssl
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from fleet.console.waiting_room import WaitingRoom

if TYPE_CHECKING:  # only `--lan` needs its packages
    from fleet.console.network_console import LimitedListener

Address = tuple[str, int]
ACCEPTS_AT_ONCE: Final = 20
"""Maximum number of connections that are accepted in one turn of the loop. Each takes some 0.05 ms."""
ACCEPT_PAUSE_S: Final = 0.01
"""Pause after a full turn. So at most 2000 connections a second are accepted, in a tenth of a core. The others wait in
the kernel."""
SERVE_INTERVAL_S: Final = 0.02
"""Interval at which a waiting line that has used up its rate is checked. It is shorter than the interval between two
handshakes of one address."""
EXPIRY_INTERVAL_S: Final = 0.25
"""Interval at which silent connections are ended."""
HANDSHAKE_TIMEOUT_S: Final = 3.0
"""Timeout of a handshake: two round trips over a bad Wi-Fi (0.5 s), one of them sent again after a second."""
# asyncio's own timeout is 30 s. If a page was closed in a flood, its client never ends TLS, and keeps its place and its
# buffers.
SHUTDOWN_TIMEOUT_S: Final = 2.0
"""Timeout for the client's end of TLS. It is the same as for the end of the WebSocket, which comes before
(`fair_socket`)."""
# The objects of a connection refer to each other, and have some 90 kB of buffers. Python's garbage collector looks at
# old objects only after some 80,000 new ones. That may take an hour: after a flood, 64 MB stayed. A collection takes 1
# to 3 ms.
COLLECT_AFTER: Final = 100
"""Number of handshakes after which their garbage is collected: 9 MB at most."""
SOCKET_RETRY_S: Final = SERVE_INTERVAL_S
"""Interval at which sockets are tried on Windows, whose loop cannot watch them."""
_READ_BYTES: Final = 4096
_TLS_HELLO: Final = b"\x16"
"""The first byte of a TLS client: a handshake record (RFC 8446, 5.1)."""


class Entrance:
    """Accepts connections from the network, and begins TLS in turn. All methods run on the loop."""

    def __init__(
        self, listener: "LimitedListener", context: ssl.SSLContext, make_protocol: Callable[[], asyncio.Protocol]
    ) -> None:
        self._listener = listener
        self._context = context
        self._make_protocol = make_protocol
        self._loop = asyncio.get_running_loop()
        self._room = WaitingRoom(random.choice)
        self._waiting: dict[Address, socket.socket] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._timers: dict[Callable[[], None], asyncio.TimerHandle] = {}
        self._polls: dict[int, asyncio.TimerHandle] = {}
        """The next try of each socket that the loop cannot watch, by its file number."""
        self._begun = 0
        """Number of handshakes since the last collection."""

    def open(self) -> None:
        """Begin to accept."""
        self._listener.settimeout(0.0)
        self._watch(self._listener, self._accept)
        self._expire()

    def close(self) -> None:
        """Accept no more connections, and close those that wait. The caller closes the listener afterwards."""
        for timer in self._timers.values():
            timer.cancel()
        self._unwatch(self._listener)
        for task in self._tasks:
            task.cancel()
        for key in list(self._waiting):
            self._drop(key)

    def _watch(self, watched: socket.socket, call: Callable[[], None]) -> None:
        """Call a function whenever a socket may be read. The function must not block if there is nothing to read."""
        try:
            self._loop.add_reader(watched.fileno(), call)
        except NotImplementedError:  # the loop of Windows that can start processes
            self._poll_later(watched.fileno(), call)

    def _poll_later(self, number: int, call: Callable[[], None]) -> None:
        def poll() -> None:
            self._poll_later(number, call)
            call()  # may end the polls

        self._polls[number] = self._loop.call_later(SOCKET_RETRY_S, poll)

    def _unwatch(self, watched: socket.socket) -> None:
        try:
            self._loop.remove_reader(watched.fileno())
        except NotImplementedError:
            if (poll := self._polls.pop(watched.fileno(), None)) is not None:
                poll.cancel()

    def _after(self, delay_s: float, call: Callable[[], None]) -> None:
        """Call a function once after a delay. Do nothing if a call of it waits already."""
        if call not in self._timers:

            def run() -> None:
                del self._timers[call]
                call()

            self._timers[call] = self._loop.call_later(delay_s, run)

    def _accept(self) -> None:
        for _ in range(ACCEPTS_AT_ONCE):
            try:
                connection, address = self._listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError:  # too many open files: some will be closed in a moment
                break
            connection.settimeout(0.0)
            self._waiting[address] = connection
            self._watch(connection, partial(self._on_readable, address))
            dropped = self._room.add(address, address[0], time.monotonic())
            if isinstance(dropped, tuple):
                self._drop(dropped)
        self._unwatch(self._listener)
        self._after(ACCEPT_PAUSE_S, self._accept_again)

    def _accept_again(self) -> None:
        self._watch(self._listener, self._accept)

    def _on_readable(self, key: Address) -> None:
        connection = self._waiting[key]
        try:
            start = connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            start = b""
        if start != _TLS_HELLO:  # the client has gone, or does not speak TLS
            if start:
                connection.recv(_READ_BYTES)  # closing a connection with unread bytes would reset it
            self._drop(key)
            return
        self._unwatch(connection)
        self._room.on_hello(key, key[0])
        self._after(0.0, self._serve_next)

    def _serve_next(self) -> None:
        """Begin one handshake.

        The next one begins in another turn of the loop, so that a STOP can be carried out in between.
        """
        key = self._room.take(time.monotonic())
        if isinstance(key, tuple):
            task = asyncio.ensure_future(self._begin(self._waiting.pop(key), key))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        if self._room.has_ready:
            self._after(SERVE_INTERVAL_S if key is None else 0.0, self._serve_next)

    async def _begin(self, connection: socket.socket, key: Address) -> None:
        try:
            if not self._listener.admit(connection, key):
                connection.close()
                return
            await self._loop.connect_accepted_socket(
                self._make_protocol,
                connection,
                ssl=self._context,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
                ssl_shutdown_timeout=SHUTDOWN_TIMEOUT_S,
            )
        except OSError:  # an error of TLS or its timeout, too: the client has gone
            connection.close()
        finally:
            self._room.on_begun(key[0])
            self._begun += 1

    def _drop(self, key: Address) -> None:
        connection = self._waiting.pop(key)
        self._unwatch(connection)
        connection.close()
        self._room.remove(key, key[0])

    def _expire(self) -> None:
        for key in self._room.expire(time.monotonic()):
            if isinstance(key, tuple):
                self._drop(key)
        if self._begun >= COLLECT_AFTER:
            self._begun = 0
            gc.collect()
        self._after(EXPIRY_INTERVAL_S, self._expire)

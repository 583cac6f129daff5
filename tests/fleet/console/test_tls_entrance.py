"""The entrance on real sockets: who sends no TLS hello costs nobody a place, and waits for nothing."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator

import pytest

from fleet.console.certificate import ensure_certificate
from fleet.console.connection_limit import MAX_STRANGERS_PER_ADDRESS
from fleet.console.network_console import LimitedListener
from fleet.console.tls_entrance import Entrance
from fleet.console.waiting_room import MAX_WAITING_PER_ADDRESS
from tests.support.network_client import untrusting


class ByteEcho(asyncio.Protocol):
    """Answers what it reads, over TLS."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._transport.write(data)


@pytest.fixture
def listener(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> Iterator[LimitedListener]:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    with LimitedListener.on_port(0) as made:
        yield made


def echoed(port: int) -> bytes:
    """Return the answer to a byte over TLS."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as plain, untrusting().wrap_socket(plain) as secure:
        secure.sendall(b"x")
        return secure.recv(1)


def fail_as_on_windows(*_: object) -> None:
    raise NotImplementedError


@pytest.mark.parametrize("can_watch", [True, False])
async def test_silent_connections_and_other_protocols_lock_nobody_out(
    listener: LimitedListener, monkeypatch: pytest.MonkeyPatch, can_watch: bool
) -> None:
    loop = asyncio.get_running_loop()
    if not can_watch:  # the handshakes still need the loop of this system
        monkeypatch.setattr(loop, "add_reader", fail_as_on_windows)
        monkeypatch.setattr(loop, "remove_reader", fail_as_on_windows)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    ensure_certificate(("127.0.0.1",)).load_into(context)
    entrance = Entrance(listener, context, ByteEcho)
    entrance.open()
    port = listener.getsockname()[1]

    def flood(opened: contextlib.ExitStack) -> list[socket.socket]:
        return [
            opened.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30))
            for _ in range(MAX_WAITING_PER_ADDRESS + 10)
        ]

    def end_of(connection: socket.socket) -> bytes:
        with contextlib.suppress(ConnectionError):
            return connection.recv(1)
        return b""

    try:
        with contextlib.ExitStack() as opened:
            silent = await asyncio.to_thread(flood, opened)
            assert await asyncio.to_thread(echoed, port) == b"x"
            for each in silent[:10]:  # the oldest have lost their places
                assert await asyncio.to_thread(end_of, each) == b""
            silent[-1].sendall(b"GET / HTTP/1.1")
            assert await asyncio.to_thread(end_of, silent[-1]) == b""
            tasks = [asyncio.to_thread(echoed, port) for _ in range(2 * MAX_STRANGERS_PER_ADDRESS)]
            assert await asyncio.gather(*tasks) == [b"x"] * len(tasks)
    finally:
        entrance.close()

"""A TCP proxy for tests that cut, record or stall a connection."""

import contextlib
import socket
import threading
import time


def _shut_down(*sockets: socket.socket) -> None:
    """End both directions of each socket that is still open."""
    for each in sockets:
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


class TcpProxy:
    """Passes each byte on, in both directions, between clients of loopback and a target."""

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self._target = (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    @property
    def connections(self) -> int:
        """Return the number of connections until now."""
        return len(self._sockets) // 2

    def close(self) -> None:
        """Close the proxy, and all connections."""
        ended = (self._listener, *self._sockets)
        _shut_down(*ended)
        for each in ended:
            each.close()

    def hang_up(self) -> None:
        """End all connections. The next one is accepted."""
        _shut_down(*self._sockets)

    def on_bytes(self, data: bytes, connection: int, *, from_client: bool) -> None:
        """Handle bytes before they are passed on. Connections are counted from 0."""

    def on_end(self, source: socket.socket, sink: socket.socket) -> None:
        """Close the other direction's end when a sender has ended."""
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
                number = self.connections
                self._sockets += [near, far]
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(
                        target=self._pass, args=(source, sink, number, source is near), daemon=True
                    ).start()

    def _pass(self, source: socket.socket, sink: socket.socket, number: int, from_client: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self.on_bytes(data, number, from_client=from_client)
                sink.sendall(data)
        self.on_end(source, sink)


class StallProxy(TcpProxy):
    """While cut, it passes nothing and closes nothing, as lost Wi-Fi does."""

    def __init__(self, port: int) -> None:
        self._whole = threading.Event()
        self._whole.set()
        super().__init__(port)

    def cut(self) -> int:
        """Pass nothing from now on. Return the time, ns since the epoch."""
        self._whole.clear()
        return time.time_ns()

    def mend(self) -> None:
        """Deliver all buffered bytes in a burst."""
        self._whole.set()

    def on_bytes(self, data: bytes, connection: int, *, from_client: bool) -> None:
        """Hold the bytes while the proxy is cut."""
        self._whole.wait()

    def close(self) -> None:
        """Close the proxy, and all connections."""
        self._whole.set()
        super().close()

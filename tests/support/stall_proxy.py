"""A TCP proxy that stalls as lost Wi-Fi does."""

import contextlib
import socket
import threading
import time


class StallProxy:
    """A TCP proxy to a port of loopback. While cut, it passes nothing and closes nothing, as lost Wi-Fi does."""

    def __init__(self, port: int) -> None:
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._whole = threading.Event()
        self._whole.set()
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self) -> int:
        """Pass nothing from now on. Return the time, ns since the epoch."""
        self._whole.clear()
        return time.time_ns()

    def mend(self) -> None:
        """Deliver all buffered bytes in a burst."""
        self._whole.set()

    def close(self) -> None:
        """Close the proxy."""
        self._whole.set()
        for each in (self._listener, *self._sockets):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
                self._sockets += [near, far]
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=pair, daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                sink.sendall(data)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_WR)

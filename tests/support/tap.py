"""A TCP proxy between a gateway and its car that a test can read, stall and cut."""

import contextlib
import select
import socket
import struct
import threading
import time
from urllib.parse import urlsplit


class Tap:
    """Passes bytes in both directions, and stores the bytes to the car at `link` with times (ns since the epoch)."""

    def __init__(self, link: str) -> None:
        parts = urlsplit(link)
        self._car = (parts.hostname, parts.port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._address = self._listener.getsockname()
        self.link = f"tcp://127.0.0.1:{self._address[1]}"
        self.passed: list[tuple[int, bytes]] = []
        self._flows = threading.Event()
        self._flows.set()
        self._ends: list[socket.socket] = []
        self._closing = False
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def stall(self) -> None:
        """Take no more bytes from either end, and close no connection."""
        self._flows.clear()

    def flow(self) -> None:
        """Pass bytes again. The delayed ones arrive at once."""
        self._flows.set()

    def reset(self, *, refuse: bool = True) -> None:
        """Reset the connection, as a bridge without power does. With `refuse`, refuse new ones until `accept`."""
        if refuse:
            self._listener.close()
        self._cut()
        self._flows.set()

    def accept(self) -> None:
        """Listen again at the same port."""
        self._thread.join()
        self._listener = socket.create_server(self._address)
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        """Close all connections and end."""
        self._closing = True
        self._listener.close()
        self._cut()
        self._flows.set()
        self._thread.join()

    def _cut(self) -> None:
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.shutdown(socket.SHUT_RD)

    def _serve(self) -> None:
        listener = self._listener
        while listener.fileno() >= 0:
            try:
                if not select.select([listener], [], [], 0.05)[0]:
                    continue
                host, _ = listener.accept()
            except (OSError, ValueError):  # another thread has closed the socket
                return
            with contextlib.suppress(OSError), host, socket.create_connection(self._car) as car:
                for end in (host, car):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._ends = [host, car]
                self._pass(host, car)
            self._ends = []

    def _pass(self, host: socket.socket, car: socket.socket) -> None:
        while not self._closing:  # a client that connects during the close would prevent its end
            self._flows.wait()
            ready, _, _ = select.select([host, car], [], [], 0.05)
            if not self._flows.is_set():
                continue
            for end in ready:
                data = end.recv(4096)
                if not data:
                    return
                if end is host:
                    self.passed.append((time.time_ns(), data))
                    car.sendall(data)
                else:
                    host.sendall(data)

"""A TCP proxy between a gateway and its car that loses bytes around a stop: from any byte on, in any direction."""

import contextlib
import random
import select
import socket
import threading
import time
from dataclasses import dataclass, field
from enum import StrEnum

BYTE_S = 1 / 960


class GapDirection(StrEnum):
    TO_CAR = "to car"
    TO_HOST = "to host"
    BOTH = "both"


@dataclass(frozen=True, slots=True)
class ByteGap:
    """Bytes that a wire loses. The length counts from the gateway's first byte after `GapProxy.arm`."""

    direction: GapDirection
    length_s: float
    first: int = 0
    """First byte that is lost, counted from the gateway's first byte."""
    early: bool = False
    """True if the gap begins with `GapProxy.arm`."""
    share: float = 1.0
    """Share of these bytes that is lost."""
    seed: int = 0

    def __str__(self) -> str:
        first = "before the first byte" if self.early else f"from byte {self.first}"
        share = "" if self.share == 1.0 else f", {self.share:.0%} of it"
        return f"{self.direction}, {self.length_s:.2f} s {first}{share}"


@dataclass
class _Flow:
    """One direction of the wire."""

    name: GapDirection
    passed: list[tuple[float, bytes, bytes]] = field(default_factory=list)
    """Time, received bytes, and passed bytes."""
    last_at: float = 0.0


class GapProxy:
    """Passes bytes to the car at this port of loopback, and from it."""

    def __init__(self, port: int) -> None:
        self._car = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.link = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.to_car, self.to_host = _Flow(GapDirection.TO_CAR), _Flow(GapDirection.TO_HOST)
        self._gap: ByteGap | None = None
        self._count = 0
        self._until = float("inf")
        self._chance = random.Random()
        self._closing = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def arm(self, gap: ByteGap) -> None:
        """Prepare this gap. Its bytes and its length count from the gateway's next byte."""
        with self._lock:
            self._count, self._until, self._chance = 0, float("inf"), random.Random(gap.seed)
            self._gap = gap

    def mend(self) -> None:
        """Pass everything again."""
        with self._lock:
            self._gap = None

    @property
    def whole_at(self) -> float | None:
        """End of the gap, s since the epoch, also if it is in the future. None before the gateway's first byte."""
        return None if self._until == float("inf") else self._until

    def frames(self, since: float) -> list[tuple[float, bytes, bytes]]:
        """Return the gateway's writes: time, bytes, and the bytes that arrived."""
        return [each for each in self.to_car.passed if each[0] >= since]

    def close(self) -> None:
        """Close all connections and end."""
        self._closing = True
        self._thread.join()
        self._listener.close()

    def _swallows(self, flow: _Flow, at: float) -> bool:
        gap = self._gap
        if gap is None:
            return False
        begun = gap.early or self._count > gap.first
        if flow is self.to_car:
            if self._count == 0:
                self._until = at + gap.length_s
            self._count += 1
            begun = gap.early or self._count > gap.first
        hit = begun and at < self._until and gap.direction in (flow.name, GapDirection.BOTH)
        return hit and self._chance.random() < gap.share

    def _filter(self, flow: _Flow, data: bytes) -> bytes:
        """Return the bytes that the proxy passes. Each byte has its own time, as on a UART."""
        now, kept = time.time(), bytearray()
        with self._lock:
            for byte in data:
                flow.last_at = max(now, flow.last_at) + BYTE_S
                if not self._swallows(flow, flow.last_at):
                    kept.append(byte)
        flow.passed.append((now, data, bytes(kept)))
        return bytes(kept)

    def _serve(self) -> None:
        while not self._closing:
            if not select.select([self._listener], [], [], 0.05)[0]:
                continue
            host, _ = self._listener.accept()
            with contextlib.suppress(OSError), host, socket.create_connection(self._car) as car:
                for end in (host, car):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._pass(host, car)

    def _pass(self, host: socket.socket, car: socket.socket) -> None:
        while not self._closing:
            for end in select.select([host, car], [], [], 0.05)[0]:
                data = end.recv(4096)
                if not data:
                    return
                if end is host:
                    car.sendall(self._filter(self.to_car, data))
                else:
                    host.sendall(self._filter(self.to_host, data))

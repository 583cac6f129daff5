"""A link with faults on virtual time: it delays or loses bytes in either direction, and adds bytes to those of the car.

Without faults it passes bytes on unchanged. `endpoints` opens and closes links; `firmware_base` models the UART's rate.
"""

from collections import deque
from enum import StrEnum
from math import inf
from typing import Final, Protocol

from gateway.sim.model.firmware_base import BYTES_PER_S

TO_HOST_LIMIT: Final = 1024
"""Maximum number of bytes in a slow link to the host. Further bytes are lost, as in a Bluetooth module."""
FLOOD_INTERVAL_S: Final = 0.005
NEVER_ENDING: Final = b"$4WD,CSB"
"""The beginning of a frame without an end; zeros follow."""


class Direction(StrEnum):
    """A direction of a link."""

    TO_CAR = "car"
    TO_HOST = "host"


class Flood(StrEnum):
    """The kind of bytes that the fault `firehose` sends."""

    NOISE = "noise"
    FRAME = "frame"


class Noise(Protocol):
    """A seeded source of random numbers and bytes; `random.Random` is one."""

    def random(self) -> float:
        """Return the next number in 0..1."""

    def randbytes(self, n: int) -> bytes:
        """Return the next `n` bytes."""


class _ByteQueue:
    """One direction: a queue of pieces, each with the time of its delivery."""

    def __init__(self, rng: Noise, limit: float) -> None:
        self._rng = rng
        self._limit = limit
        self.pieces: deque[tuple[float, bytes]] = deque()
        self.waiting = 0
        self.rate = inf
        self.slow_until = 0.0
        self.share = 0.0
        self.lossy_until = 0.0
        self.closed_until = 0.0
        self.lost_bytes = 0

    def put(self, data: bytes, now: float) -> None:
        """Queue bytes."""
        accepted = data
        if now < self.closed_until:
            accepted = b""
        elif now < self.lossy_until:
            accepted = bytes(byte for byte in data if self._rng.random() >= self.share)
        if now < self.slow_until or self.waiting:
            accepted = accepted[: int(min(len(accepted), self._limit - self.waiting))]
        self.lost_bytes += len(data) - len(accepted)
        at = max(now, self.pieces[-1][0] if self.pieces else now)
        if now < self.slow_until:
            for index in range(len(accepted)):
                at += 1 / self.rate
                self.pieces.append((at, accepted[index : index + 1]))
        elif accepted:
            self.pieces.append((at, accepted))
        self.waiting += len(accepted)

    def take(self, now: float) -> list[bytes]:
        """Return the pieces that are due."""
        out = []
        while self.pieces and self.pieces[0][0] <= now:
            out.append(self.pieces.popleft()[1])
            self.waiting -= len(out[-1])
        return out

    def clear(self) -> None:
        """Lose all queued bytes."""
        self.pieces.clear()
        self.lost_bytes += self.waiting
        self.waiting = 0


class FaultyLink:
    """Both directions of a car's link.

    Times are seconds from any origin and never run backwards. If `until` is inf, the fault lasts for ever.
    """

    def __init__(self, to_car: Noise, to_host: Noise) -> None:
        self._noise = to_host
        self._lanes = {Direction.TO_CAR: _ByteQueue(to_car, inf), Direction.TO_HOST: _ByteQueue(to_host, TO_HOST_LIMIT)}
        self._echo_until = 0.0
        self._flood_until = 0.0
        self._flood_at = 0.0
        self._flood_rate = 0.0
        self._flood = Flood.NOISE
        self._flooded = 0
        self._cut: int | None = None
        self._cut_began = False

    # The faults.

    def slow(self, factor: float, until: float) -> None:
        """Deliver single bytes at this fraction of 960 bytes/s, in both directions."""
        for lane in self._lanes.values():
            lane.rate, lane.slow_until = factor * BYTES_PER_S, until

    def lossy(self, share: float, ways: tuple[Direction, ...], until: float) -> None:
        """Lose this fraction of the bytes, each independently."""
        for way in ways:
            self._lanes[way].share, self._lanes[way].lossy_until = share, until

    def close(self, way: Direction, until: float) -> None:
        """Accept and lose all bytes of a direction."""
        self._lanes[way].closed_until = until

    def echo(self, until: float) -> None:
        """Deliver the host's bytes to the car, and also send them back to the host."""
        self._echo_until = until

    def flood(self, what: Flood, rate: float, now: float, until: float) -> None:
        """Send `rate` bytes per second to the host, besides the bytes of the car."""
        self._flood, self._flood_rate, self._flood_at, self._flood_until = what, rate, now, until
        self._flooded = 0

    def cut_next(self, count: int) -> None:
        """Deliver only `count` bytes of the next frame, from its `$` on, and nothing after them until `mend`."""
        self._cut, self._cut_began = count, False

    @property
    def cut(self) -> bool:
        """True if the frame was cut and the bytes before the cut are delivered."""
        return self._cut == 0 and self._cut_began and not self._lanes[Direction.TO_CAR].pieces

    def mend(self) -> None:
        """End the cut."""
        self._cut = None

    # The bytes.

    def from_host(self, data: bytes, now: float) -> None:
        """Accept bytes from the host."""
        if now < self._echo_until:
            self._lanes[Direction.TO_HOST].put(data, now)
        if self._cut is not None:
            data = self._before_cut(data)
        self._lanes[Direction.TO_CAR].put(data, now)

    def _before_cut(self, data: bytes) -> bytes:
        assert self._cut is not None
        start = 0
        if not self._cut_began:
            start = data.find(b"$")
            if start < 0:
                return data
            self._cut_began = True
        end = min(len(data), start + self._cut)
        self._cut -= end - start
        return data[:end]

    def from_car(self, data: bytes, now: float) -> None:
        """Accept bytes from the car."""
        self._lanes[Direction.TO_HOST].put(data, now)

    def to_car(self, now: float) -> list[bytes]:
        """Return the pieces that reach the car's UART."""
        return self._lanes[Direction.TO_CAR].take(now)

    def to_host(self, now: float) -> list[bytes]:
        """Return the pieces that reach the host."""
        out = self._lanes[Direction.TO_HOST].take(now)
        if self._flood_at < self._flood_until:
            end = min(now, self._flood_until)
            # No buffer holds more than one second of bytes. So after a longer pause, send those of the last second.
            since = max(self._flood_at, end - 1.0)
            count = int((end - since) * self._flood_rate + 1e-6)
            self._flood_at = end if end == self._flood_until else since + count / self._flood_rate
            if count:
                out.append(self._flooding(count))
        return out

    def _flooding(self, count: int) -> bytes:
        if self._flood is Flood.NOISE:
            return self._noise.randbytes(count)
        begun, self._flooded = self._flooded, self._flooded + count
        return NEVER_ENDING[begun : begun + count].ljust(count, b"0")

    def waiting(self) -> int:
        """Return the number of bytes queued to the car. The caller feeds no more bytes while this number is large."""
        return self._lanes[Direction.TO_CAR].waiting

    @property
    def lost_bytes(self) -> dict[Direction, int]:
        """The number of lost bytes in each direction."""
        return {way: lane.lost_bytes for way, lane in self._lanes.items()}

    def next_event(self) -> float:
        """Return the time of the next delivery, or inf if there is none."""
        due = min((lane.pieces[0][0] for lane in self._lanes.values() if lane.pieces), default=inf)
        if self._flood_at < self._flood_until:
            due = min(due, self._flood_at + max(FLOOD_INTERVAL_S, 1 / self._flood_rate))
        return due

    def clear(self) -> None:
        """Lose all queued bytes, because the link breaks."""
        for lane in self._lanes.values():
            lane.clear()

"""A link with its faults, on virtual time: bytes go in at either end, and come out late, fewer, other, or not at all.

A link without faults hands on what it gets as it gets it. Being there or not is links.py's part, the UART's pace the
firmware's.
"""

from collections import deque
from enum import StrEnum
from math import inf
from typing import Final, Protocol

from gateway.sim.model.firmware import BYTES_PER_S

TO_HOST_LIMIT: Final = 1024
"""Bytes that wait in a slow link on their way to the host; what comes on top is lost, as in a Bluetooth module."""
FLOOD_EVERY_S: Final = 0.005
NEVER_ENDING: Final = b"$4WD,CSB"
"""How the frame begins that has no end; zeros follow."""


class Direction(StrEnum):
    """Either way of a link."""

    TO_CAR = "car"
    TO_HOST = "host"


class Flood(StrEnum):
    """What a firehose sends."""

    NOISE = "noise"
    FRAME = "frame"


class Noise(Protocol):
    """A seeded source of random numbers and bytes; `random.Random` is one."""

    def random(self) -> float:
        """The next number in 0..1."""
        ...

    def randbytes(self, n: int) -> bytes:
        """The next `n` bytes."""
        ...


class _Lane:
    """One way: a queue, each piece with the time at which it comes out."""

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
        """Bytes go in."""
        kept = data
        if now < self.closed_until:
            kept = b""
        elif now < self.lossy_until:
            kept = bytes(byte for byte in data if self._rng.random() >= self.share)
        if now < self.slow_until or self.waiting:
            kept = kept[: int(min(len(kept), self._limit - self.waiting))]
        self.lost_bytes += len(data) - len(kept)
        at = max(now, self.pieces[-1][0] if self.pieces else now)
        if now < self.slow_until:
            for index in range(len(kept)):
                at += 1 / self.rate
                self.pieces.append((at, kept[index : index + 1]))
        elif kept:
            self.pieces.append((at, kept))
        self.waiting += len(kept)

    def take(self, now: float) -> list[bytes]:
        """What has come out by now, piece by piece."""
        out = []
        while self.pieces and self.pieces[0][0] <= now:
            out.append(self.pieces.popleft()[1])
            self.waiting -= len(out[-1])
        return out

    def clear(self) -> None:
        """What is under way is lost."""
        self.pieces.clear()
        self.lost_bytes += self.waiting
        self.waiting = 0


class FaultyLink:
    """Both ways of a car's link. Times: seconds from any origin, must not run backwards; `until` inf: for ever."""

    def __init__(self, to_car: Noise, to_host: Noise) -> None:
        self._noise = to_host
        self._lanes = {Direction.TO_CAR: _Lane(to_car, inf), Direction.TO_HOST: _Lane(to_host, TO_HOST_LIMIT)}
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
        """Bytes come out one at a time, at this part of 960 bytes/s, both ways."""
        for lane in self._lanes.values():
            lane.rate, lane.slow_until = factor * BYTES_PER_S, until

    def lossy(self, share: float, ways: tuple[Direction, ...], until: float) -> None:
        """This part of the bytes is lost, each by itself."""
        for way in ways:
            self._lanes[way].share, self._lanes[way].lossy_until = share, until

    def close(self, way: Direction, until: float) -> None:
        """All is taken and nothing comes out."""
        self._lanes[way].closed_until = until

    def echo(self, until: float) -> None:
        """What the host sends also comes back to it."""
        self._echo_until = until

    def flood(self, what: Flood, rate: float, now: float, until: float) -> None:
        """So many bytes a second to the host, besides what the car sends."""
        self._flood, self._flood_rate, self._flood_at, self._flood_until = what, rate, now, until
        self._flooded = 0

    def cut_next(self, count: int) -> None:
        """Of the next frame, from its `$` on, so many bytes come out, and nothing after them until `mend`."""
        self._cut, self._cut_began = count, False

    @property
    def cut(self) -> bool:
        """Whether the cut has come, and what came before it is out."""
        return self._cut == 0 and self._cut_began and not self._lanes[Direction.TO_CAR].pieces

    def mend(self) -> None:
        """The cut is over."""
        self._cut = None

    # The bytes.

    def from_host(self, data: bytes, now: float) -> None:
        """The host has sent this."""
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
        """The car has sent this."""
        self._lanes[Direction.TO_HOST].put(data, now)

    def to_car(self, now: float) -> list[bytes]:
        """What reaches the car's UART."""
        return self._lanes[Direction.TO_CAR].take(now)

    def to_host(self, now: float) -> list[bytes]:
        """What reaches the host."""
        out = self._lanes[Direction.TO_HOST].take(now)
        if self._flood_at < self._flood_until:
            end = min(now, self._flood_until)
            # A host that was busy finds at most a second's worth: nobody has kept the rest.
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
        """Bytes on their way to the car: whoever feeds should hold back while this is large."""
        return self._lanes[Direction.TO_CAR].waiting

    @property
    def lost_bytes(self) -> dict[Direction, int]:
        """What was lost so far, each way."""
        return {way: lane.lost_bytes for way, lane in self._lanes.items()}

    def next_event(self) -> float:
        """When something next comes out by itself; inf if nothing will."""
        due = min((lane.pieces[0][0] for lane in self._lanes.values() if lane.pieces), default=inf)
        if self._flood_at < self._flood_until:
            due = min(due, self._flood_at + max(FLOOD_EVERY_S, 1 / self._flood_rate))
        return due

    def clear(self) -> None:
        """The link is cut: what is under way is lost."""
        for lane in self._lanes.values():
            lane.clear()

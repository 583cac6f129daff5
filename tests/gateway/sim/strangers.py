"""Clients of one car that know only the wire: on virtual time, at its PTY, or at its socket."""

import asyncio
import random
import time
from collections.abc import Callable
from typing import Any, Protocol

import serial

from gateway.sim.car_spec import parse_cars
from gateway.sim.model.factory import build
from gateway.sim.model.firmware_base import Firmware, Truth
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from gateway.sim.simulation import SimCar, Simulation

STOP = b"$0,0,0,0,0,0,0,0,0#"
RUN = b"$1,0,0,0,0,0,0,0,0#"
BACK = b"$2,0,0,0,0,0,0,0,0#"
WHISTLE = b"$0,0,1,0,0,0,0,0,0#"
FAN = b"$0,0,0,0,0,0,0,1,0#"
PTZ90 = b"$4WD,PTZ90#"
MODE00 = b"$4WD,MODE00#"
PATIENCE = 40.0


async def until(so: Any, what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not so():
        assert time.monotonic() < end, f"never: {what}"
        await asyncio.sleep(0.005)


def opening(mode: int) -> bytes:
    return f"$4WD,MODE{mode}1#".encode()


def opening_s(mode: int) -> float:
    """Return the seconds for which opening a mode blocks a car (docs/reference/protocol.md#blocking-times)."""
    return 2.1 + 0.2 * (mode + 1)


class Stranger(Protocol):
    received: bytearray

    async def write(self, data: bytes) -> None: ...

    async def wait(self, seconds: float) -> None: ...

    async def until(self, so: Callable[..., bool], within: float = 8.0) -> None: ...

    async def until_received(self, count: int, within: float = 8.0) -> None: ...

    async def hang_up(self) -> None: ...

    async def refused(self) -> bool: ...

    @property
    def truth(self) -> Truth: ...


class VirtualStranger:
    """A client of the model itself, on virtual time."""

    def __init__(self, car: Firmware) -> None:
        self.car = car
        self.now = car.now
        self.received = bytearray()
        if isinstance(car, RaspberryPiCar):
            car.connected(self.now)

    async def write(self, data: bytes) -> None:
        self.car.feed(data, self.now)

    async def wait(self, seconds: float) -> None:
        self.now += seconds
        for _, data in self.car.advance(self.now):
            self.received += data

    async def until(self, so: Callable[..., bool], within: float = 8.0) -> None:
        end = self.now + within
        while not so(self.truth):
            assert self.now < end, f"never so within {within} s: {self.truth}"
            await self.wait(0.001)

    async def until_received(self, count: int, within: float = 8.0) -> None:
        await self.until(lambda _: len(self.received) >= count, within)

    async def hang_up(self) -> None:
        assert isinstance(self.car, RaspberryPiCar)
        self.car.disconnected(self.now)

    async def refused(self) -> bool:
        return not self.car.alive

    @property
    def truth(self) -> Truth:
        self.car.advance(self.now)
        return self.car.truth


def virtual(
    platform: str = "arduino",
    *,
    world: World | None = None,
    tcp: bool = False,
    seed: int = 1,
    options: str = "",
    traits: CarTraits | None = None,
) -> VirtualStranger:
    transport = Transport.TCP if tcp else Transport.SERIAL
    rng, chosen = random.Random(seed), frozenset(options.split())
    car = build(platform, world or World.room(), 0, rng, options=chosen, transport=transport, traits=traits)
    return VirtualStranger(car)


class WireStranger:
    """A client of a running simulator's link, by real pyserial or a real socket. The model gives the truth."""

    def __init__(self, simulation: Simulation, car: SimCar) -> None:
        self._simulation = simulation
        self._car = car
        self._loop = asyncio.get_running_loop()
        self._port: serial.Serial | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self.received = bytearray()

    @classmethod
    async def at(cls, platform: str, *, world: World | None = None, tcp: bool = False) -> "WireStranger":
        link = "tcp://127.0.0.1:0" if tcp else "pty"
        simulation = Simulation(parse_cars([f"red:{platform}:{link}"]), seed=1, world=world)
        await simulation.start()
        self = cls(simulation, simulation.cars["red"])
        await self._open()
        return self

    async def _open(self) -> None:
        scheme, _, where = self._car.url.partition("://")
        if scheme == "serial":
            self._port = serial.Serial(where, 9600, timeout=0)
            self._loop.add_reader(self._port.fileno(), self._read)
            return
        host, _, port = where.rpartition(":")
        reader, self._writer = await asyncio.open_connection(host, int(port))
        self._reading = self._loop.create_task(self._read_stream(reader))

    def _read(self) -> None:
        assert self._port is not None
        self.received += self._port.read(4096)

    async def _read_stream(self, reader: asyncio.StreamReader) -> None:
        try:
            while data := await reader.read(4096):
                self.received += data
        except ConnectionError:
            return

    async def write(self, data: bytes) -> None:
        if self._port is not None:
            self._port.write(data)
        else:
            assert self._writer is not None
            self._writer.write(data)

    async def wait(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def until(self, so: Callable[..., bool], within: float = 8.0) -> None:
        end = self._loop.time() + within + 10
        while not so(self.truth):
            assert self._loop.time() < end, f"never so within {within} s: {self.truth}"
            await asyncio.sleep(0.002)

    async def until_received(self, count: int, within: float = 8.0) -> None:
        await self.until(lambda _: len(self.received) >= count, within)

    async def hang_up(self) -> None:
        assert self._writer is not None
        self._writer.close()

    async def refused(self) -> bool:
        host, _, port = self._car.url.removeprefix("tcp://").rpartition(":")
        try:
            _, writer = await asyncio.open_connection(host, int(port))
        except (ConnectionRefusedError, ConnectionResetError):  # reset: it was queued at a closed socket
            return True
        writer.close()
        return False

    @property
    def truth(self) -> Truth:
        truth = self._car.truth
        assert truth is not None
        return truth

    async def leave(self) -> None:
        if self._port is not None:
            self._loop.remove_reader(self._port.fileno())
            self._port.close()
        if self._writer is not None:
            self._writer.close()
        if self._reading is not None:
            self._reading.cancel()
        await self._simulation.stop()

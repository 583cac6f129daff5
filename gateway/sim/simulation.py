"""Runs the cars of the model in real time, each behind its link, all in one asyncio loop.

The loop's clock is the only clock of the simulator. This module also carries out the faults that `faults` parses.
"""

import asyncio
import random
from collections.abc import Callable, Coroutine, Sequence
from math import inf
from typing import Final, Protocol

from gateway.sim.car_spec import CarSpec, PtyPath, ReplaySpec
from gateway.sim.endpoints import EndpointError, PtyEndpoint, SimEndpoint, TcpEndpoint
from gateway.sim.faults import Fault, FaultKind, Press, targets
from gateway.sim.model.capture_car import CaptureCar
from gateway.sim.model.course import CourseCar
from gateway.sim.model.factory import build, build_ugv
from gateway.sim.model.faulty_link import Direction, FaultyLink
from gateway.sim.model.firmware_base import Firmware, Pose, Truth
from gateway.sim.model.ir_remote import Button
from gateway.sim.model.raspberry_pi import PI_BOOT_S, RaspberryPiCar, Transport
from gateway.sim.model.ugv import UGV_BUILDS, UgvCar
from gateway.sim.model.world import World
from gateway.sim.world_commands import Change, WorldState, as_it_is

CAR_BAUD: Final = 9600
UGV_BAUD: Final = 115200
MAX_WIRE_BYTES: Final = 128
"""Maximum bytes on a car's wire. Above it, the link stops reading from the host, so that memory is bounded."""

Watcher = Callable[["SimCar"], None]


class Machine(Protocol):
    """The machine behind a link: a car's program, or a capture."""

    @property
    def alive(self) -> bool:
        """False once a program has died."""

    @property
    def truth(self) -> Truth | None:
        """The true state, or None if unknown."""

    def pose(self, now: float) -> Pose | None:
        """Return the pose, or None if unknown."""

    def feed(self, data: bytes, now: float) -> None:
        """Accept bytes from the host."""

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """Run the car up to `now`. Return the pieces that it has sent since the last call."""

    def next_event(self) -> float:
        """Return the time of the next event."""

    def backlog(self, now: float) -> int:
        """Return the number of bytes still on the wire."""

    def drop_link(self, now: float) -> None:
        """Cut the link."""


class SimCar:
    """One car: its program, its link, the faults between them, and the timer that runs all of them."""

    def __init__(self, spec: CarSpec | ReplaySpec, firmware: Machine, seed: str) -> None:
        self.spec = spec
        self.firmware = firmware
        # Separate generators, so that a fault does not change the car's own random numbers.
        self._rng = _rng(f"{seed}:faults")
        self._faults = FaultyLink(_rng(f"{seed}:to_car"), _rng(f"{seed}:to_host"))
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._held = False
        self._is_off = False
        self._dropped = False
        self._restore: asyncio.TimerHandle | None = None
        self._unstick: asyncio.TimerHandle | None = None
        self._cut_for_s: float | None = None
        self._cutting = False
        self._ended = False
        self._known_as = ""
        self._closing: set[asyncio.Task[None]] = set()
        self._truth = firmware.truth
        self._alive = firmware.alive
        self.watchers: list[Watcher] = []
        """Called after every change of the truth."""
        self.on_renamed: Watcher = lambda _: None
        """Called when the link has returned under another name."""
        self.on_ended: Watcher = lambda _: None
        """Called at the end of a capture that does not loop."""
        self.on_failed: Callable[[SimCar, EndpointError], None] = lambda *_: None
        """Called when a lost link cannot be opened again."""
        self._link: SimEndpoint
        if isinstance(spec.link, PtyPath):
            self._link = PtyEndpoint(self, spec.link.path, _baud(firmware))
        else:
            self._link = TcpEndpoint(self, spec.link.host, spec.link.port)

    @property
    def url(self) -> str:
        """The URL that a gateway opens to reach this car."""
        return self._link.url

    @property
    def lost_bytes(self) -> dict[str, int]:
        """The number of bytes that faults of the link have lost, on the way to the car and to the host."""
        return {way.value: count for way, count in self._faults.lost_bytes.items()}

    @property
    def truth(self) -> Truth | None:
        """The true state now. None for a capture."""
        self._pump()
        return self.firmware.truth

    @property
    def pose(self) -> Pose | None:
        """The true pose now. None for a capture."""
        return self.firmware.pose(self._loop.time())

    async def start(self) -> None:
        """Open the link and start the program. Raises EndpointError if the link cannot open."""
        await self._link.up()
        self._known_as = self.url
        if isinstance(self.firmware, CaptureCar) and isinstance(self.spec.link, PtyPath):
            self.firmware.begin(self._loop.time())  # a terminal does not report a new host
        self._pump()

    async def stop(self) -> None:
        """Close the link and stop the timers."""
        self._dropped = True
        for task in list(self._closing):
            await task
        await self._link.close()
        for timer in (self._timer, self._restore, self._unstick):
            if timer is not None:
                timer.cancel()

    # Calls of the link.

    def received(self, data: bytes) -> None:
        """Accept bytes from the host."""
        self._faults.from_host(data, self._loop.time())
        self._pump()

    def connected(self) -> None:
        """Tell the program that a TCP host has connected."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.connected(self._loop.time())
        elif isinstance(self.firmware, CaptureCar):
            self.firmware.begin(self._loop.time())
            self._pump()

    def disconnected(self) -> None:
        """Tell the program that a TCP host has disconnected."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.disconnected(self._loop.time())
            self._pump()

    # The program and the faults.

    def _pump(self) -> None:
        now = self._loop.time()
        was_alive, before = self._alive, self._truth
        for data in self._faults.to_car(now):
            self.firmware.feed(data, now)
        for _, data in self.firmware.advance(now):
            if not self._dropped:
                self._faults.from_car(data, now)
        for data in self._faults.to_host(now):
            if not self._dropped:
                self._link.send(data)
        backlog = self.firmware.backlog(now)
        if self._faults.cut and backlog == 0 and not self._cutting:
            self._cutting = True
            self._later(self._drop(self._cut_for_s))
        backlog += self._faults.waiting()
        if backlog > MAX_WIRE_BYTES or (self._held and backlog > MAX_WIRE_BYTES // 2):
            self._hold(on=True)
        elif self._held:
            self._hold(on=False)
        due = min(self.firmware.next_event(), self._faults.next_event())
        if self._held or self._faults.cut:
            due = min(due, now + 0.02)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(due, self._pump) if due != inf else None
        self._truth, self._alive = self.firmware.truth, self.firmware.alive
        if self._truth != before:
            for watcher in self.watchers:
                watcher(self)
        if was_alive and not self._alive and isinstance(self._link, TcpEndpoint):
            # The program's sockets close when it dies: the connection ends, and a new one is refused.
            self._later(self._link.down())
        if isinstance(self.firmware, CaptureCar) and self.firmware.done and not self._ended:
            self._ended = True
            self.on_ended(self)

    def _hold(self, *, on: bool) -> None:
        if on != self._held:
            self._held = on
            self._link.hold(on=on)

    def _later(self, work: Coroutine[None, None, None]) -> None:
        async def run() -> None:
            try:
                await work
            except EndpointError as error:
                self.on_failed(self, error)

        task = self._loop.create_task(run())
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    # Commands.

    def press(self, button: Button) -> bool:
        """Press a button of the infrared remote; return True if the car obeys it."""
        obeyed = (
            not self._is_off
            and isinstance(self.firmware, Firmware | UgvCar)
            and self.firmware.press(button, self._loop.time())
        )
        self._pump()
        return obeyed

    async def inflict(self, fault: Fault) -> None:
        """Carry out a fault now. Raises EndpointError if a link cannot be renamed, or not be opened again."""
        self._pump()
        now = self._loop.time()
        until = inf if fault.for_s is None else now + fault.for_s
        match fault.kind:
            case FaultKind.LINK_DROP if fault.for_s == 0:
                await self._bring_back()
            case FaultKind.LINK_DROP:
                await self._drop(fault.for_s)
            case FaultKind.RENAME:
                self._link.rename(fault.path)
                await self._drop(fault.for_s)
            case FaultKind.CUT_WRITE:
                self._cut_for_s = fault.for_s
                self._faults.cut_next(fault.bytes)
            case FaultKind.SLOW:
                self._faults.slow(fault.factor, until)
            case FaultKind.LOSSY:
                self._faults.lossy(fault.share, fault.ways, until)
            case FaultKind.STUCK:
                self._stick(fault.for_s)
            case FaultKind.DEAF:
                self._faults.close(Direction.TO_CAR, until)
            case FaultKind.MUTE:
                self._faults.close(Direction.TO_HOST, until)
            case FaultKind.ECHO:
                self._faults.echo(until)
            case FaultKind.FIREHOSE:
                self._faults.flood(fault.flood, fault.rate, now, until)
            case FaultKind.GARBAGE:
                if Direction.TO_CAR in fault.ways:
                    self.received(self._rng.randbytes(fault.bytes))
                if Direction.TO_HOST in fault.ways and not self._dropped:
                    self._link.send(self._rng.randbytes(fault.bytes))
            case FaultKind.BROWNOUT:
                await self._brown_out()
            case FaultKind.EMPTY:
                for_s = fault.for_s or 0.0
                if isinstance(self.firmware, Firmware | UgvCar):
                    self.firmware.drain(now, for_s)
                self._loop.call_later(for_s, lambda: self._later(self._go_out()))
        self._pump()

    async def _go_out(self) -> None:
        """Switch the car off, because its battery is empty, until somebody ends `link_drop`. Its link is gone, too."""
        self._is_off = True
        await self._drop(None)  # first, as in `_brown_out`
        if isinstance(self.firmware, UgvCar):
            self.firmware.switch_off(self._loop.time())
        elif isinstance(self.firmware, Firmware):
            self.firmware.brown_out(self._loop.time())

    async def _brown_out(self) -> None:
        if self._is_off:
            return
        if isinstance(self.firmware, RaspberryPiCar | CourseCar) and isinstance(self._link, TcpEndpoint):
            # The whole machine goes down with its sockets, before the program starts without a client.
            await self._drop(PI_BOOT_S)
        if isinstance(self.firmware, Firmware | UgvCar):
            self.firmware.brown_out(self._loop.time())

    def _stick(self, for_s: float | None) -> None:
        if self._unstick is not None:
            self._unstick.cancel()
            self._unstick = None
        self._link.stick(on=for_s != 0)
        if for_s:
            self._unstick = self._loop.call_later(for_s, lambda: self._link.stick(on=False))

    async def _drop(self, for_s: float | None) -> None:
        if self._restore is not None:
            self._restore.cancel()
            self._restore = None
        self._pump()
        if not self._dropped:
            self._dropped = True
            self.firmware.drop_link(self._loop.time())
            self._faults.clear()
            await self._link.down()
            self._faults.mend()
            self._held = self._cutting = False
        if for_s is not None:
            self._restore = self._loop.call_later(for_s, lambda: self._later(self._bring_back()))

    async def _bring_back(self) -> None:
        self._faults.mend()  # a cut that still waits for its frame is called off
        self._pump()
        if not self._dropped:
            return
        self._dropped = False
        if self._is_off:
            self._is_off = False
            if isinstance(self.firmware, UgvCar):
                self.firmware.brown_out(self._loop.time())
        if self._restore is not None:
            self._restore.cancel()
            self._restore = None
        if self.firmware.alive:
            await self._link.up()
            if self.url != self._known_as:
                self._known_as = self.url
                self.on_renamed(self)


def _baud(firmware: Machine) -> int | None:
    """Return the baud rate of a car's UART. A capture plays at any rate."""
    if isinstance(firmware, CaptureCar):
        return None
    return UGV_BAUD if isinstance(firmware, UgvCar) else CAR_BAUD


def _rng(seed: str) -> random.Random:
    return random.Random(seed)  # noqa: S311 - a simulation, no secret


class Simulation:
    """Any number of cars in one world. Build and run it inside a running loop."""

    def __init__(
        self,
        specs: Sequence[CarSpec],
        *,
        seed: int = 0,
        world: World | None = None,
        replays: Sequence[tuple[ReplaySpec, CaptureCar]] = (),
    ) -> None:
        self.world = world or World.room()
        self.cars: dict[str, SimCar] = {}
        now = asyncio.get_running_loop().time()
        for index, spec in enumerate(specs):
            # The seed includes the name, so that a car behaves the same whatever other cars there are.
            seeded = f"{seed}:{spec.name}"
            transport = Transport.SERIAL if isinstance(spec.link, PtyPath) else Transport.TCP
            rng, options = _rng(seeded), spec.options
            firmware: Machine
            if spec.platform in UGV_BUILDS:
                firmware = build_ugv(spec.platform, self.world, index, rng, options=options, now=now, name=spec.name)
            else:
                firmware = build(
                    spec.platform,
                    self.world,
                    index,
                    rng,
                    options=options,
                    transport=transport,
                    now=now,
                    name=spec.name,
                    traits=spec.traits,
                )
            self.cars[spec.name] = SimCar(spec, firmware, seeded)
        for replay, played in replays:
            self.cars[replay.name] = SimCar(replay, played, f"{seed}:{replay.name}")

    async def start(self) -> None:
        """Open every link. If one fails, close all and raise EndpointError with the name of the car."""
        for name, car in self.cars.items():
            try:
                await car.start()
            except EndpointError as error:
                await self.stop()
                raise type(error)(f"car {name}: {error}") from None

    async def stop(self) -> None:
        """Close every link."""
        for car in self.cars.values():
            await car.stop()

    async def inflict(self, fault: Fault) -> list[str]:
        """Carry out a fault on one car or all. Return the names of these cars.

        Raises BadSpec if a car is unknown or cannot have this fault, and EndpointError if the link of a car cannot be
        renamed, or not be opened again. Then the cars after it are left out.
        """
        names = targets([car.spec for car in self.cars.values()], fault)
        for name in names:
            await self.cars[name].inflict(fault)
        return names

    def change(self, change: Change) -> None:
        """Change the world now."""
        now = asyncio.get_running_loop().time()
        self.world.advance(now)
        change(self.world, now)

    def world_as_it_is(self) -> WorldState:
        """Return the lamps and things now."""
        now = asyncio.get_running_loop().time()
        self.world.advance(now)
        return as_it_is(self.world, now)

    def press(self, press: Press) -> list[str]:
        """Press a button for one car or all; return the names of those that obey.

        Raises BadSpec if the car is unknown, or if there are only captures.
        """
        names = targets([car.spec for car in self.cars.values()], press)
        return [name for name in names if self.cars[name].press(press.button)]

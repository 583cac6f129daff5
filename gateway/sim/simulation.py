"""The simulator as it runs: cars of the core on real time, each behind its link, all in one asyncio loop.

Here lies the only clock. Faults on demand are carried out here; what a user may write is faults.py's part.
"""

import asyncio
import random
from collections.abc import Callable, Coroutine, Sequence
from math import inf
from typing import Final, Protocol

from gateway.sim.car_spec import CarSpec, PtyPath, ReplaySpec
from gateway.sim.endpoints import EndpointError, PtySimLink, SimLink, TcpSimLink
from gateway.sim.faults import Fault, FaultKind, Press, targets
from gateway.sim.model.capture_car import CaptureCar
from gateway.sim.model.factory import build
from gateway.sim.model.faulty_link import Direction, FaultyLink
from gateway.sim.model.firmware import Firmware, Pose, Truth
from gateway.sim.model.ir_remote import Button
from gateway.sim.model.raspberry_pi import BOOT_S, RaspberryPiCar, Transport
from gateway.sim.model.world import World
from gateway.sim.world_commands import Change, Said, as_it_is

HOLD_ABOVE: Final = 128
"""Bytes on a car's wire above which its host is not read from: the sum of what is fed is bounded."""

Watcher = Callable[["SimCar"], None]


class Machine(Protocol):
    """What stands behind a link: a car's program, or a capture."""

    @property
    def alive(self) -> bool:
        """False once a program has died."""
        ...

    @property
    def truth(self) -> Truth | None:
        """What is so; None where nobody knows."""
        ...

    def pose(self, now: float) -> Pose | None:
        """Where it is; None where nobody knows."""
        ...

    def feed(self, data: bytes, now: float) -> None:
        """Bytes from the host."""
        ...

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """Go on to `now`; what was sent since."""
        ...

    def next_event(self) -> float:
        """When something next happens by itself."""
        ...

    def backlog(self, now: float) -> int:
        """Bytes fed that are still on the wire."""
        ...

    def drop_link(self, now: float) -> None:
        """The link is cut."""
        ...


class SimCar:
    """One car: firmware, link, what is between them, and the timer that keeps all going."""

    def __init__(self, spec: CarSpec | ReplaySpec, firmware: Machine, seed: str) -> None:
        self.spec = spec
        self.firmware = firmware
        # Of their own, so that a fault changes nothing of what the car itself does by chance.
        self._rng = _rng(f"{seed}:faults")
        self._line = FaultyLink(_rng(f"{seed}:to_car"), _rng(f"{seed}:to_host"))
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._held = False
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
        self.moved: Watcher = lambda _: None
        """Called when the link has come back under another name."""
        self.ended: Watcher = lambda _: None
        """Called when a capture has played to its end and will not begin again."""
        self.failed: Callable[[SimCar, EndpointError], None] = lambda *_: None
        """Called when a link that was to come back cannot."""
        self._link: SimLink
        if isinstance(spec.link, PtyPath):
            self._link = PtySimLink(self, spec.link.path)
        else:
            self._link = TcpSimLink(self, spec.link.host, spec.link.port)

    @property
    def url(self) -> str:
        """What a gateway opens to reach this car."""
        return self._link.url

    @property
    def lost_bytes(self) -> dict[str, int]:
        """What faults of the link have lost so far, to the car and to the host."""
        return {way.value: count for way, count in self._line.lost_bytes.items()}

    @property
    def truth(self) -> Truth | None:
        """What is so now; None for a capture."""
        self._pump()
        return self.firmware.truth

    @property
    def pose(self) -> Pose | None:
        """Where the car truly is now; None for a capture."""
        return self.firmware.pose(self._loop.time())

    async def start(self) -> None:
        """Open the link and let the program run; raises LinkError."""
        await self._link.up()
        self._known_as = self.url
        if isinstance(self.firmware, CaptureCar) and isinstance(self.spec.link, PtyPath):
            self.firmware.begin(self._loop.time())  # a terminal does not tell when a host comes
        self._pump()

    async def stop(self) -> None:
        """Close the link and stand still."""
        self._dropped = True
        for task in list(self._closing):
            await task
        await self._link.close()
        for timer in (self._timer, self._restore, self._unstick):
            if timer is not None:
                timer.cancel()

    # The link's side.

    def received(self, data: bytes) -> None:
        """Bytes from the host."""
        self._line.from_host(data, self._loop.time())
        self._pump()

    def connected(self) -> None:
        """A TCP host has come."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.connected(self._loop.time())
        elif isinstance(self.firmware, CaptureCar):
            self.firmware.begin(self._loop.time())
            self._pump()

    def disconnected(self) -> None:
        """A TCP host has gone."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.disconnected(self._loop.time())
            self._pump()

    # The core's side.

    def _pump(self) -> None:
        now = self._loop.time()
        was_alive, before = self._alive, self._truth
        for data in self._line.to_car(now):
            self.firmware.feed(data, now)
        for _, data in self.firmware.advance(now):
            if not self._dropped:
                self._line.from_car(data, now)
        for data in self._line.to_host(now):
            if not self._dropped:
                self._link.send(data)
        backlog = self.firmware.backlog(now)
        if self._line.cut and backlog == 0 and not self._cutting:
            self._cutting = True
            self._later(self._drop(self._cut_for_s))
        backlog += self._line.waiting()
        if backlog > HOLD_ABOVE or (self._held and backlog > HOLD_ABOVE // 2):
            self._hold(on=True)
        elif self._held:
            self._hold(on=False)
        due = min(self.firmware.next_event(), self._line.next_event())
        if self._held or self._line.cut:
            due = min(due, now + 0.02)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(due, self._pump) if due != inf else None
        self._truth, self._alive = self.firmware.truth, self.firmware.alive
        if self._truth != before:
            for watcher in self.watchers:
                watcher(self)
        if was_alive and not self._alive and isinstance(self._link, TcpSimLink):
            # The program's sockets die with it: the connection ends and a new one is refused.
            self._later(self._link.down())
        if isinstance(self.firmware, CaptureCar) and self.firmware.done and not self._ended:
            self._ended = True
            self.ended(self)

    def _hold(self, *, on: bool) -> None:
        if on != self._held:
            self._held = on
            self._link.hold(on=on)

    def _later(self, work: Coroutine[None, None, None]) -> None:
        async def told() -> None:
            try:
                await work
            except EndpointError as error:
                self.failed(self, error)

        task = self._loop.create_task(told())
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    # What is done to it.

    def press(self, button: Button) -> bool:
        """Press a button of the infrared remote; whether the car obeys it."""
        obeyed = isinstance(self.firmware, Firmware) and self.firmware.press(button, self._loop.time())
        self._pump()
        return obeyed

    async def inflict(self, fault: Fault) -> None:
        """Carry out a fault now; raises LinkError if a link that was to come back cannot."""
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
                self._line.cut_next(fault.bytes)
            case FaultKind.SLOW:
                self._line.slow(fault.factor, until)
            case FaultKind.LOSSY:
                self._line.lossy(fault.share, fault.ways, until)
            case FaultKind.STUCK:
                self._stick(fault.for_s)
            case FaultKind.DEAF:
                self._line.close(Direction.TO_CAR, until)
            case FaultKind.MUTE:
                self._line.close(Direction.TO_HOST, until)
            case FaultKind.ECHO:
                self._line.echo(until)
            case FaultKind.FIREHOSE:
                self._line.flood(fault.flood, fault.rate, now, until)
            case FaultKind.GARBAGE:
                if Direction.TO_CAR in fault.ways:
                    self.received(self._rng.randbytes(fault.bytes))
                if Direction.TO_HOST in fault.ways and not self._dropped:
                    self._link.send(self._rng.randbytes(fault.bytes))
            case FaultKind.BROWNOUT:
                await self._brown_out()
        self._pump()

    async def _brown_out(self) -> None:
        if isinstance(self.firmware, RaspberryPiCar) and isinstance(self._link, TcpSimLink):
            # The whole machine goes down, its sockets with it, before the program starts with none.
            await self._drop(BOOT_S)
        if isinstance(self.firmware, Firmware):
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
            self._line.clear()
            await self._link.down()
            self._line.mend()
            self._held = self._cutting = False
        if for_s is not None:
            self._restore = self._loop.call_later(for_s, lambda: self._later(self._bring_back()))

    async def _bring_back(self) -> None:
        self._pump()
        if not self._dropped:
            return
        self._dropped = False
        if self._restore is not None:
            self._restore.cancel()
            self._restore = None
        if self.firmware.alive:
            await self._link.up()
            if self.url != self._known_as:
                self._known_as = self.url
                self.moved(self)


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
            # Seeded by the name too, so that a car behaves the same whatever other cars there are.
            seeded = f"{seed}:{spec.name}"
            transport = Transport.SERIAL if isinstance(spec.link, PtyPath) else Transport.TCP
            rng, options = _rng(seeded), spec.options
            firmware = build(
                spec.platform, self.world, index, rng, options=options, transport=transport, now=now, name=spec.name
            )
            self.cars[spec.name] = SimCar(spec, firmware, seeded)
        for replay, played in replays:
            self.cars[replay.name] = SimCar(replay, played, f"{seed}:{replay.name}")

    async def start(self) -> None:
        """Open every link; raises LinkError, after closing what was open, naming the car."""
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
        """Carry out a fault on one car or all; the names of those it hit. Raises BadSpec for a car that is not here."""
        names = targets([car.spec for car in self.cars.values()], fault)
        for name in names:
            await self.cars[name].inflict(fault)
        return names

    def change(self, change: Change) -> None:
        """Change the world now."""
        now = asyncio.get_running_loop().time()
        self.world.advance(now)
        change(self.world, now)

    def world_as_it_is(self) -> Said:
        """Lamps and things now."""
        now = asyncio.get_running_loop().time()
        self.world.advance(now)
        return as_it_is(self.world, now)

    def press(self, press: Press) -> list[str]:
        """Press a button before one car or all; the names of those that obey. Raises BadSpec as `inflict`."""
        names = targets([car.spec for car in self.cars.values()], press)
        return [name for name in names if self.cars[name].press(press.button)]

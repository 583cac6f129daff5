"""The simulator as it runs: cars of the core on real time, each behind its link, all in one asyncio loop.

Here lies the only clock. Faults on demand are carried out here; what they are is spec.py's part.
"""

import asyncio
import random
from collections.abc import Callable, Coroutine, Sequence
from typing import Final

from gateway.sim.core.cars import build
from gateway.sim.core.firmware import Firmware, Pose, Truth
from gateway.sim.core.raspberry_pi import BOOT_S, RaspberryPiCar, Transport
from gateway.sim.core.world import World
from gateway.sim.links import LinkError, PtySimLink, SimLink, TcpSimLink
from gateway.sim.spec import CarSpec, Fault, FaultKind, PtyLink, check_hit

HOLD_ABOVE: Final = 128
"""Bytes on a car's wire above which its host is not read from: the sum of what is fed is bounded."""

Watcher = Callable[["SimCar"], None]


class SimCar:
    """One car: firmware, link, and the timer that keeps both going."""

    def __init__(self, spec: CarSpec, firmware: Firmware, rng: random.Random) -> None:
        self.spec = spec
        self.firmware = firmware
        self._rng = rng
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._held = False
        self._dropped = False
        self._restore: asyncio.TimerHandle | None = None
        self._closing: set[asyncio.Task[None]] = set()
        self._truth = firmware.truth
        self.watchers: list[Watcher] = []
        """Called after every change of the truth."""
        self.moved: Watcher = lambda _: None
        """Called when the link has come back under another name."""
        self._link: SimLink
        if isinstance(spec.link, PtyLink):
            self._link = PtySimLink(self, spec.link.path)
        else:
            self._link = TcpSimLink(self, spec.link.host, spec.link.port)

    @property
    def url(self) -> str:
        """What a gateway opens to reach this car."""
        return self._link.url

    @property
    def truth(self) -> Truth:
        """What is so now."""
        self._pump()
        return self.firmware.truth

    @property
    def pose(self) -> Pose:
        """Where the car truly is now."""
        return self.firmware.pose(self._loop.time())

    async def start(self) -> None:
        """Open the link and let the program run; raises LinkError."""
        await self._link.up()
        self._pump()

    async def stop(self) -> None:
        """Close the link and stand still."""
        self._dropped = True
        for task in list(self._closing):
            await task
        await self._link.close()
        for timer in (self._timer, self._restore):
            if timer is not None:
                timer.cancel()

    # The link's side.

    def received(self, data: bytes) -> None:
        """Bytes from the host reach the wire now."""
        self.firmware.feed(data, self._loop.time())
        self._pump()

    def connected(self) -> None:
        """A TCP host has come."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.connected(self._loop.time())

    def disconnected(self) -> None:
        """A TCP host has gone."""
        if isinstance(self.firmware, RaspberryPiCar):
            self.firmware.disconnected(self._loop.time())
            self._pump()

    # The core's side.

    def _pump(self) -> None:
        now = self._loop.time()
        was_alive = self._truth.alive
        for _, data in self.firmware.advance(now):
            if not self._dropped:
                self._link.send(data)
        backlog = self.firmware.backlog(now)
        if backlog > HOLD_ABOVE or (self._held and backlog > HOLD_ABOVE // 2):
            self._hold(on=True)
        elif self._held:
            self._hold(on=False)
        due = self.firmware.next_event()
        if self._held:
            due = min(due, now + 0.02)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(due, self._pump) if due != float("inf") else None
        truth = self.firmware.truth
        if truth != self._truth:
            self._truth = truth
            for watcher in self.watchers:
                watcher(self)
        if was_alive and not truth.alive and isinstance(self._link, TcpSimLink):
            # The program's sockets die with it: the connection ends and a new one is refused.
            self._later(self._link.down())

    def _hold(self, *, on: bool) -> None:
        if on != self._held:
            self._held = on
            self._link.hold(on=on)

    def _later(self, work: Coroutine[None, None, None]) -> None:
        task = self._loop.create_task(work)
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    # Faults.

    async def inflict(self, fault: Fault) -> None:
        """Carry out a fault now; raises LinkError if a link that was to come back cannot."""
        now = self._loop.time()
        match fault.kind:
            case FaultKind.GARBAGE:
                noise = self._rng.randbytes(fault.bytes)
                if fault.to_car:
                    self.received(noise)
                elif not self._dropped:
                    self._link.send(noise)
            case FaultKind.BROWNOUT if isinstance(self.firmware, RaspberryPiCar) and isinstance(self._link, TcpSimLink):
                # The whole machine goes down, its sockets with it, before the program starts with none.
                await self._drop(BOOT_S)
                self.firmware.brown_out(now)
                self._pump()
            case FaultKind.BROWNOUT:
                self.firmware.brown_out(now)
                self._pump()
            case FaultKind.LINK_DROP if fault.for_s == 0:
                await self._bring_back()
            case FaultKind.LINK_DROP:
                await self._drop(fault.for_s)

    async def _drop(self, for_s: float | None) -> None:
        if self._restore is not None:
            self._restore.cancel()
            self._restore = None
        self._pump()
        if not self._dropped:
            self._dropped = True
            self.firmware.drop_link(self._loop.time())
            await self._link.down()
            self._held = False
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
            before = self.url
            await self._link.up()
            if self.url != before:
                self.moved(self)


class Simulation:
    """Any number of cars in one world. Build and run it inside a running loop."""

    def __init__(self, specs: Sequence[CarSpec], *, seed: int = 0, world: World | None = None) -> None:
        self.world = world or World.room()
        self.cars: dict[str, SimCar] = {}
        now = asyncio.get_running_loop().time()
        for index, spec in enumerate(specs):
            # Seeded by the name too, so that a car behaves the same whatever other cars there are.
            rng = random.Random(f"{seed}:{spec.name}")  # noqa: S311 - a simulation, no secret
            transport = Transport.SERIAL if isinstance(spec.link, PtyLink) else Transport.TCP
            firmware = build(spec.platform, self.world, index, rng, options=spec.options, transport=transport, now=now)
            self.cars[spec.name] = SimCar(spec, firmware, rng)

    async def start(self) -> None:
        """Open every link; raises LinkError, after closing what was open, naming the car."""
        for name, car in self.cars.items():
            try:
                await car.start()
            except LinkError as error:
                await self.stop()
                raise LinkError(f"car {name}: {error}") from None

    async def stop(self) -> None:
        """Close every link."""
        for car in self.cars.values():
            await car.stop()

    async def inflict(self, fault: Fault) -> list[str]:
        """Carry out a fault on one car or all; the names of those it hit. Raises BadSpec for a car that is not here."""
        check_hit(list(self.cars), [fault])
        names = [fault.car] if fault.car is not None else list(self.cars)
        for name in names:
            await self.cars[name].inflict(fault)
        return names

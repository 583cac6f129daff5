"""What is so, published: `<fleet>/<car>/sim/truth` at 10 Hz and on every change, as long as there is a hub.

Of a world with anything in it also `<fleet>/@sim/world`: at 10 Hz while it changes, else at 1 Hz.

The simulator runs without a bus just as well; this waits for a hub, never starts one.
"""

import asyncio
import threading
import time
from collections.abc import Callable
from math import inf
from typing import Final

from gateway.sim.model.geometry import Point
from gateway.sim.model.world import World
from gateway.sim.simulation import SimCar, Simulation
from gateway.sim.world_commands import Said
from schemas import keys
from schemas.bus import Bus, BusError, Publisher
from schemas.gen import fleet_v1_pb2
from schemas.topics import TOPICS

PERIOD_S: Final = 0.1
REPEAT_S: Final = 1.0
LOOK_AGAIN_S: Final = 0.3
OPEN_WITHIN_S: Final = 0.3
PATIENCE_S: Final = 10.0
"""Cars may be started before their gateways; after so long somebody may wonder."""


class TruthPublisher:
    """Publishes every car of a simulation once a hub is there."""

    def __init__(
        self, simulation: Simulation, endpoint: str, fleet: str, complain: Callable[[str], object] = lambda _: None
    ) -> None:
        self._simulation = simulation
        self._endpoint = endpoint
        self._fleet = fleet
        self._complain = complain
        self._bus: Bus | None = None
        self._publishers: dict[str, Publisher] = {}

    async def run(self) -> None:
        """Until cancelled."""
        loop = asyncio.get_running_loop()
        try:
            self._bus = await self._open(loop)
            topic = TOPICS["sim/truth"]
            cars = {name: car for name, car in self._simulation.cars.items() if car.truth is not None}
            for name, car in cars.items():
                key = keys.topic_key(self._fleet, name, topic.name)
                self._publishers[name] = self._bus.publisher(key, topic, name)
                car.watchers.append(self._put)
            publish_world = self._world_publisher()
            due = loop.time()
            while True:
                for car in cars.values():
                    self._put(car)
                publish_world(loop.time())
                # From one origin, so that the rate does not drift; a stalled loop does not catch up.
                due = max(due + PERIOD_S, loop.time())
                await asyncio.sleep(due - loop.time())
        finally:
            for car in self._simulation.cars.values():
                if self._put in car.watchers:
                    car.watchers.remove(self._put)
            if self._bus is not None:
                self._bus.close()

    def _world_publisher(self) -> Callable[[float], None]:
        """What publishes the world, if there is anything in it but cars."""
        world, topic = self._simulation.world, TOPICS["@sim/world"]
        if self._bus is None or not (world.lively or world.lamps or world.walls or world.line):
            return lambda _: None
        key = keys.topic_key(self._fleet, keys.SIMULATOR, "world")
        publisher = self._bus.publisher(key, topic, keys.SIMULATOR)
        last, said_at = fleet_v1_pb2.World(), -inf

        def publish(now: float) -> None:
            nonlocal last, said_at
            message = world_message(world, self._simulation.world_as_it_is())
            if message == last and now - said_at < REPEAT_S:
                return
            last.CopyFrom(message)
            said_at = now
            publisher.put(message, time.time_ns())

        return publish

    async def _open(self, loop: asyncio.AbstractEventLoop) -> Bus:
        """Opening blocks, so it has a thread; a daemon, since a hub that is not there must not hold up our end."""
        patience_until = loop.time() + PATIENCE_S
        while True:
            if loop.time() >= patience_until:
                patience_until = inf
                self._complain(
                    f"there is no hub at {self._endpoint} yet, so nobody can see what is true of the cars: "
                    "gateway run and fleet up start one (--no-truth: publish nothing)"
                )
            opened: asyncio.Future[Bus | None] = loop.create_future()
            threading.Thread(target=self._try, args=(loop, opened), daemon=True).start()
            bus = await opened
            if bus is not None:
                return bus
            await asyncio.sleep(LOOK_AGAIN_S)

    def _try(self, loop: asyncio.AbstractEventLoop, opened: "asyncio.Future[Bus | None]") -> None:
        try:
            bus = Bus.open(self._endpoint, timeout_s=OPEN_WITHIN_S)
        except BusError:
            bus = None

        def hand_over() -> None:
            if not opened.done():
                opened.set_result(bus)
            elif bus is not None:
                bus.close()

        try:
            loop.call_soon_threadsafe(hand_over)
        except RuntimeError:  # the loop has ended meanwhile
            if bus is not None:
                bus.close()

    def _put(self, car: SimCar) -> None:
        truth, pose = car.firmware.truth, car.pose
        if truth is None or pose is None:
            return
        message = fleet_v1_pb2.Truth(
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            mode=truth.mode.value,
            motor_left=truth.motor_left,
            motor_right=truth.motor_right,
            blocked=truth.blocked,
            fan=truth.fan,
            led=truth.led,
        )
        self._publishers[car.spec.name].put(message, time.time_ns())


def world_message(world: World, said: Said) -> fleet_v1_pb2.World:
    """The world as it is: what never moves, and lamps and things as the control channel has them."""
    walls = [((x1, y1), (x2, y2)) for x1, y1, x2, y2 in world.walls]
    return fleet_v1_pb2.World(
        lamps=[fleet_v1_pb2.SimLamp(name=name, **fields) for name, fields in said["lamps"].items()],
        things=[fleet_v1_pb2.SimThing(name=name, **fields) for name, fields in said["things"].items()],
        walls=[fleet_v1_pb2.SimWall(begin=_point(begin), end=_point(end)) for begin, end in walls],
        line=[_point(point) for point in world.line],
    )


def _point(point: Point) -> fleet_v1_pb2.SimPoint:
    return fleet_v1_pb2.SimPoint(x_m=point[0], y_m=point[1])

"""Publishes the true state of the simulated cars: `<fleet>/<car>/sim/truth` at 10 Hz and on every change.

Publishes a world that is not empty as `<fleet>/@sim/world`: at 10 Hz while it changes, otherwise at 1 Hz.
Waits for a hub and never starts one. The simulator runs without a hub as well.
"""

import asyncio
import threading
import time
from collections.abc import Callable
from math import inf
from typing import Final

from gateway.sim.model.world import World
from gateway.sim.simulation import SimCar, Simulation
from gateway.sim.world_commands import WorldState
from schemas import keys
from schemas.bus import Bus, BusError, Publisher
from schemas.gen import fleet_v1_pb2
from schemas.geometry import Point
from schemas.identity import Service, service
from schemas.topics import TOPICS

TRUTH_INTERVAL_S: Final = 0.1
WORLD_REPEAT_INTERVAL_S: Final = 1.0
HUB_RETRY_DELAY_S: Final = 0.3
HUB_OPEN_TIMEOUT_S: Final = 0.3
# Cars may start before their gateways, which start the hub, so a missing hub is no fault at first.
HUB_WARNING_DELAY_S: Final = 10.0
"""Time without a hub after which the simulator prints a warning."""


class TruthPublisher:
    """Publishes every simulated car of a simulation as soon as there is a hub. A capture has no true state."""

    def __init__(
        self, simulation: Simulation, endpoint: str, fleet: str, warn: Callable[[str], object] = lambda _: None
    ) -> None:
        self._simulation = simulation
        self._endpoint = endpoint
        self._fleet = fleet
        self._warn = warn
        self._bus: Bus | None = None
        self._publishers: dict[str, Publisher] = {}

    async def run(self) -> None:
        """Publish until cancelled."""
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
                # Due times count from one origin, so that the rate does not drift. Times during a stall are left out.
                due = max(due + TRUTH_INTERVAL_S, loop.time())
                await asyncio.sleep(due - loop.time())
        finally:
            for car in self._simulation.cars.values():
                if self._put in car.watchers:
                    car.watchers.remove(self._put)
            if self._bus is not None:
                self._bus.close()

    def _world_publisher(self) -> Callable[[float], None]:
        """Return the function that publishes the world, unless the world is empty."""
        world, topic = self._simulation.world, TOPICS["@sim/world"]
        if self._bus is None or not (world.lively or world.lamps or world.walls or world.line):
            return lambda _: None
        key = keys.topic_key(self._fleet, keys.SIMULATOR, "world")
        publisher = self._bus.publisher(key, topic, keys.SIMULATOR)
        last, published_at = fleet_v1_pb2.World(), -inf

        def publish(now: float) -> None:
            nonlocal last, published_at
            message = world_message(world, self._simulation.world_as_it_is())
            if message == last and now - published_at < WORLD_REPEAT_INTERVAL_S:
                return
            last.CopyFrom(message)
            published_at = now
            publisher.put(message, time.time_ns())

        return publish

    async def _open(self, loop: asyncio.AbstractEventLoop) -> Bus:
        """Open the bus, with retries."""
        # Opening blocks, so it runs in a thread. The thread is a daemon, so that the simulator can end even if a hub
        # does not answer.
        warn_at = loop.time() + HUB_WARNING_DELAY_S
        while True:
            if loop.time() >= warn_at:
                warn_at = inf
                self._warn(
                    f"There is no hub at {self._endpoint} yet, so nobody can see the true state of the cars. "
                    "`gateway run` and `fleet up` start a hub; --no-truth needs none."
                )
            opened: asyncio.Future[Bus | None] = loop.create_future()
            thread = threading.Thread(target=self._try, args=(loop, opened), daemon=True)
            thread.start()
            try:
                bus = await opened
            except asyncio.CancelledError:
                # A daemon thread that is still in Zenoh's code when the interpreter ends would abort the process.
                thread.join(5 * HUB_OPEN_TIMEOUT_S)
                raise
            if bus is not None:
                return bus
            await asyncio.sleep(HUB_RETRY_DELAY_S)

    def _try(self, loop: asyncio.AbstractEventLoop, opened: "asyncio.Future[Bus | None]") -> None:
        try:
            bus = Bus.open(self._endpoint, timeout_s=HUB_OPEN_TIMEOUT_S, identity=service(Service.SIMULATOR))
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
            **pose._asdict(),
            mode=truth.mode.value,
            motor_left=truth.motor_left,
            motor_right=truth.motor_right,
            blocked=truth.blocked,
            fan=truth.fan,
            led=truth.led,
        )
        self._publishers[car.spec.name].put(message, time.time_ns())


def world_message(world: World, state: WorldState) -> fleet_v1_pb2.World:
    """Return the message of the world. `state` has its lamps and things, as the control channel reports them."""
    walls = [((x1, y1), (x2, y2)) for x1, y1, x2, y2 in world.walls]
    return fleet_v1_pb2.World(
        lamps=[fleet_v1_pb2.SimLamp(name=name, **fields) for name, fields in state["lamps"].items()],
        things=[fleet_v1_pb2.SimThing(name=name, **fields) for name, fields in state["things"].items()],
        walls=[fleet_v1_pb2.SimWall(begin=_point(begin), end=_point(end)) for begin, end in walls],
        line=[_point(point) for point in world.line],
    )


def _point(point: Point) -> fleet_v1_pb2.SimPoint:
    return fleet_v1_pb2.SimPoint(x_m=point[0], y_m=point[1])

"""What is so, published: `<fleet>/<car>/sim/truth` at 10 Hz and on every change, as long as there is a hub.

The simulator runs without a bus just as well; this waits for a hub, never starts one.
"""

import asyncio
import threading
import time
from typing import Final

from gateway.sim.shell import SimCar, Simulation
from schemas import keys
from schemas.bus import Bus, BusError, Publisher
from schemas.gen import fleet_v1_pb2
from schemas.topics import TOPICS

PERIOD_S: Final = 0.1
LOOK_AGAIN_S: Final = 0.3
OPEN_WITHIN_S: Final = 0.3


class TruthPublisher:
    """Publishes every car of a simulation once a hub is there."""

    def __init__(self, simulation: Simulation, endpoint: str, fleet: str) -> None:
        self._simulation = simulation
        self._endpoint = endpoint
        self._fleet = fleet
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
            due = loop.time()
            while True:
                for car in cars.values():
                    self._put(car)
                # From one origin, so that the rate does not drift; a stalled loop does not catch up.
                due = max(due + PERIOD_S, loop.time())
                await asyncio.sleep(due - loop.time())
        finally:
            for car in self._simulation.cars.values():
                if self._put in car.watchers:
                    car.watchers.remove(self._put)
            if self._bus is not None:
                self._bus.close()

    async def _open(self, loop: asyncio.AbstractEventLoop) -> Bus:
        """Opening blocks, so it has a thread; a daemon, since a hub that is not there must not hold up our end."""
        while True:
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

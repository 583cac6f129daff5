"""From the words of a car's description to a car in the world. Checking the words is spec.py's part."""

from gateway.sim.model.arduino import ArduinoCar
from gateway.sim.model.car_body import CarBody
from gateway.sim.model.firmware import Firmware, Rng
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.world import World

PLATFORMS = ("arduino", "stm32", "raspberry_pi")
OPTIONS = ("arm", "imu")


def build(
    platform: str,
    world: World,
    index: int,
    rng: Rng,
    *,
    options: frozenset[str] = frozenset(),
    transport: Transport = Transport.SERIAL,
    now: float = 0.0,
    name: str = "",
) -> Firmware:
    """Car number `index` of the world, at rest on its start pose, its program just started.

    `name`: what the world knows it by, if it has a place for it there or lets it carry something. `transport` matters
    to a Raspberry Pi only: an Arduino behind a Wi-Fi bridge still has its UART.
    """
    body = CarBody(world, world.start_pose(index, name), rng, now, name)
    car: Firmware
    if platform == "raspberry_pi":
        car = RaspberryPiCar(body, rng, transport=transport, options=options, now=now)
    else:
        car = ArduinoCar(body, rng, options=options, now=now)
    if world.lively:
        car.company = world.company
        world.company.join(car)
    return car

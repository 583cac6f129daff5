"""Builds a car in the world from a description that `car_spec` has checked."""

from gateway.sim.model.arduino import ArduinoCar
from gateway.sim.model.car_body import CarBody
from gateway.sim.model.course import CourseCar
from gateway.sim.model.firmware_base import Firmware, Rng
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.stm32 import Stm32Car
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.ugv import UGV_BUILDS, UgvCar
from gateway.sim.model.world import World
from schemas.words import Platform

PLATFORMS = ("arduino", "stm32", "raspberry_pi", "course", *UGV_BUILDS)


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
    traits: CarTraits | None = None,
) -> Firmware:
    """Return car number `index` of the world, at rest on its start pose, with its program just started.

    In the world file, the car with this `name` may have a start pose and things to carry. Only a Raspberry Pi uses
    `transport`, because an Arduino behind a Wi-Fi bridge still has its UART. If `traits` is None, the car has those of
    its platform. The course's program has no traits.
    """
    body = CarBody(world, world.start_pose(index, name), rng, now, name)
    car: Firmware
    match platform:
        case Platform.RASPBERRY_PI:
            car = RaspberryPiCar(body, rng, transport=transport, options=options, traits=traits, now=now)
        case "course":
            car = CourseCar(body, rng, transport=transport, now=now)
        case Platform.STM32:
            car = Stm32Car(body, rng, options=options, traits=traits, now=now)
        case _:
            car = ArduinoCar(body, rng, options=options, traits=traits, now=now)
    if world.lively:
        car.scheduler = world.scheduler
        world.scheduler.join(car)
    return car


def build_ugv(
    platform: str,
    world: World,
    index: int,
    rng: Rng,
    *,
    options: frozenset[str] = frozenset(),
    now: float = 0.0,
    name: str = "",
) -> UgvCar:
    """Return a car of Waveshare's UGV family, whose program has already run for a while without a gateway."""
    body = CarBody(world, world.start_pose(index, name), rng, now, name)
    car = UgvCar(UGV_BUILDS[platform], body, rng, options=options, now=now)
    if world.lively:
        car.scheduler = world.scheduler
        world.scheduler.join(car)
    return car

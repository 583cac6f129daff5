"""The world: geometry, sensors, a tracking car on its line, and an avoiding car without collisions."""

import random
from math import cos, hypot, pi, radians, sin

import pytest

from gateway.sim.model.car_body import CarBody
from gateway.sim.model.firmware_base import Pose
from gateway.sim.model.objects import Lamp
from gateway.sim.model.world import World
from schemas.geometry import RADIUS_M
from tests.gateway.sim.strangers import opening, opening_s, virtual


def body(world: World, x: float = 0.0, y: float = 0.0, degrees: float = 0.0) -> CarBody:
    return CarBody(world, Pose(x, y, radians(degrees)), random.Random(1))


@pytest.mark.parametrize("index", range(6))
async def test_tracking_car_follows_the_line_for_a_minute(index: int) -> None:
    world = World.room()
    car = virtual(world=world)
    car.car._body = CarBody(world, world.start_pose(index), random.Random(1))
    await car.write(opening(2))
    await car.wait(opening_s(2) + 0.1)
    travelled, turned, last = 0.0, 0.0, car.car.pose(car.now)
    for _ in range(600):
        await car.wait(0.1)
        pose = car.car.pose(car.now)
        travelled += hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        turned += (pose.heading_rad - last.heading_rad + pi) % (2 * pi) - pi
        assert any(
            world.on_line(
                pose.x_m + 0.08 * cos(pose.heading_rad) + left * cos(pose.heading_rad + pi / 2),
                pose.y_m + 0.08 * sin(pose.heading_rad) + left * sin(pose.heading_rad + pi / 2),
            )
            for left in (-0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06)
        )
        last = pose
    assert travelled > 10  # more than once around
    assert turned > 2 * pi


@pytest.mark.parametrize("seed", range(6))
async def test_avoiding_car_turns_away_from_walls(seed: int) -> None:
    world = World.room()
    car = virtual(world=world)
    car.car._body = CarBody(world, world.start_pose(seed), random.Random(seed))
    await car.write(opening(3))
    travelled, last = 0.0, car.car.pose(0)
    for _ in range(1800):
        await car.wait(0.1)
        pose = car.car.pose(car.now)
        travelled += hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        last = pose
        away = min(
            2.5 - abs(pose.x_m), 1.8 - abs(pose.y_m), hypot(max(0, abs(pose.x_m) - 0.25), max(0, abs(pose.y_m) - 0.25))
        )
        assert away > RADIUS_M
    assert travelled > 5


def test_every_ranging_in_the_room_has_an_echo() -> None:
    world, where = World.room(), random.Random(3)
    for _ in range(3000):
        x, y = where.uniform(-2.37, 2.37), where.uniform(-1.67, 1.67)
        if max(abs(x), abs(y)) < 0.38:
            continue
        assert body(world, x, y, where.uniform(0, 360)).range_cm(0, where.uniform(-90, 90)) is not None


def test_no_echo_in_open_or_at_grazing_angle() -> None:
    assert body(World.open_field()).range_cm(0, 0) is None
    assert body(World([(5.2, -9.0, 5.2, 9.0)])).range_cm(0, 0) is None
    assert body(World([(4.5, -9.0, 4.5, 9.0)])).range_cm(0, 0) == pytest.approx(440)
    grazed = World([(0.0, 0.3, 9.0, 0.3)])
    assert body(grazed, degrees=-10).range_cm(0, 0) is None
    assert body(grazed, degrees=-10).range_cm(0, 90) == pytest.approx(33, abs=3)


def test_dead_reckoning_is_exact_whatever_the_steps() -> None:
    for left, right, x, y, heading in (
        (255, 255, 1.0, 0.0, 0.0),
        (-255, -255, -1.0, 0.0, 0.0),
        (-51, 51, 0.0, 0.0, 2 * 0.1 / 0.1 * 2 / 2),
        (0, 102, 0.1 * sin(2.0), 0.1 * (1 - cos(2.0)), 2.0),
    ):
        for looks in (1, 7, 200):
            car = body(World())
            car.drive(0, left, right)
            for look in range(1, looks + 1):
                pose = car.pose(2 * look / looks)
            assert pose == pytest.approx((x, y, heading), abs=1e-9)


def test_wall_holds_a_car() -> None:
    car = body(World([(0.5, -1.0, 0.5, 1.0)]))
    car.drive(0, 255, 255)
    assert car.pose(10).x_m == pytest.approx(0.5 - RADIUS_M)


def test_sensors_tell_left_from_right() -> None:
    line = World(line=[(-1.0, 0.04), (1.0, 0.04)])
    assert body(line).line(0) == (True, False, False, False)
    assert body(line, degrees=180).line(0) == (False, False, False, True)
    wall = World([(0.05, 0.11, 0.4, 0.11)])
    assert body(wall).obstacle(0) == (True, False)
    assert body(World(lamps=[Lamp(0.5, 0.6)])).light(0) == (True, False)
    assert body(World(lamps=[Lamp(0.5, -0.6)])).light(0) == (False, True)
    assert body(World(lamps=[Lamp(1.0, 0.0)])).light(0) == (True, True)
    assert body(World(lamps=[Lamp(9.0, 0.0)])).light(0) == (False, False)
    assert body(line).range_cm(0, 0) is None


def test_tape_is_brighter_or_darker_than_the_floor() -> None:
    world = World.room()
    pose = world.start_pose(0)
    assert body(world, pose.x_m, pose.y_m).grayscale(0) != body(world, 0.0, 0.6).grayscale(0)


def test_any_number_of_cars_starts_apart_on_the_line() -> None:
    world = World.room()
    poses = [world.start_pose(index) for index in range(50)]
    assert all(world.on_line(pose.x_m, pose.y_m) for pose in poses)
    first = poses[:8]
    assert min(hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a in first for b in first if a is not b) > 0.5

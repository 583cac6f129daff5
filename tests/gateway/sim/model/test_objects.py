"""Lamps, objects and cars that meet: readings of the sensors, and collisions."""

import copy
import itertools
import random
from math import hypot, isfinite, pi

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from gateway.sim.model.car_body import SONAR_REACH_CM, CarBody
from gateway.sim.model.factory import build
from gateway.sim.model.firmware_base import Firmware, Pose
from gateway.sim.model.objects import Lamp, MovingObject
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.geometry import RADIUS_M, box, distance
from tests.gateway.sim.strangers import RUN, VirtualStranger, opening, opening_s

HOME = Pose(0.0, 0.0, 0.0)
HAIR_M = 1e-6


def before(x: float, y: float) -> World:
    """Return a world with a car in the middle, which looks along x, and another car."""
    return World(starts={"red": HOME, "green": Pose(x, y, 0.0)}, cars_meet=True)


def lit(lamp: Lamp, *, walls: bool = False, car: bool = False, thing: MovingObject | None = None) -> World:
    """Return a world with a car in the middle, a lamp, and possibly an object in between, at x = 0.4."""
    return World(
        [(0.4, -0.1, 0.4, 0.1)] if walls else (),
        lamps=[lamp],
        things=() if thing is None else (thing,),
        starts={"red": HOME, "green": Pose(0.4 if car else -5.0, 0.0, 0.0)},
        cars_meet=True,
    )


def cars(world: World, *names: str) -> dict[str, Firmware]:
    """Return cars that send readings from the opening of a mode on, so that tests see where they begin."""
    traits = CarTraits(first_reading_s=0.0)
    return {
        name: build("arduino", world, number, random.Random(number), name=name, traits=traits)
        for number, name in enumerate(names)
    }


async def opened(world: World, mode: int) -> VirtualStranger:
    """Open a mode on red, and wait for the first reading in this mode. Return red."""
    car = VirtualStranger(cars(world, "red", "green")["red"])
    await car.write(opening(mode))
    await car.wait(opening_s(mode) + 0.08)
    return car


# Mode 6 has HW only, inverted: 0 = object seen (docs/reference/protocol.md#placeholders).
FOLLOWING = [
    ("straight ahead, near", (0.30, 0.0), b"HW00", (200, 200)),
    ("straight ahead, 16 cm between the two", (0.42, 0.0), b"HW00", (200, 200)),
    ("straight ahead, too far", (0.60, 0.0), b"HW11", (0, 0)),
    ("left", (0.30, 0.22), b"HW01", (-200, 200)),
    ("right", (0.30, -0.22), b"HW10", (200, -200)),
    ("beside", (0.0, 0.30), b"HW11", (0, 0)),
    ("behind", (-0.30, 0.0), b"HW11", (0, 0)),
]


@pytest.mark.parametrize(("where", "at", "word", "motors"), FOLLOWING, ids=[row[0] for row in FOLLOWING])
async def test_following_a_car(where: str, at: tuple[float, float], word: bytes, motors: tuple[int, int]) -> None:
    car = await opened(before(*at), 6)
    assert word in car.received, where
    assert (car.truth.motor_left, car.truth.motor_right) == motors


@pytest.mark.parametrize(
    "thing",
    [
        MovingObject("post", 0.25, 0.0, radius_m=0.05),
        MovingObject("crate", 0.3, 0.0, width_m=0.2, depth_m=0.3, heading_rad=0.3),
    ],
    ids=["disc", "box"],
)
async def test_thing_is_followed_as_a_car_is(thing: MovingObject) -> None:
    car = await opened(lit(Lamp(9.0, 9.0), thing=thing), 6)
    assert b"HW00" in car.received
    assert (car.truth.motor_left, car.truth.motor_right) == (200, 200)


# Mode 5 has GM only, 1 = sees light (docs/reference/protocol.md#placeholders).
SEEKING = [
    ("ahead", lit(Lamp(0.8, 0.0)), b"GM11", (200, 200)),
    ("left", lit(Lamp(0.5, 0.6)), b"GM10", (0, 200)),
    ("right", lit(Lamp(0.5, -0.6)), b"GM01", (200, 0)),
    ("behind", lit(Lamp(-0.5, 0.0)), b"GM00", (0, 0)),
    ("off", lit(Lamp(0.8, 0.0, on=False)), b"GM00", (0, 0)),
    ("too far", lit(Lamp(1.6, 0.0)), b"GM00", (0, 0)),
    ("four times as bright, twice as far", lit(Lamp(2.9, 0.0, brightness=4.0)), b"GM11", (200, 200)),
    ("dim", lit(Lamp(0.8, 0.0, brightness=0.25)), b"GM00", (0, 0)),
    ("behind a wall", lit(Lamp(0.8, 0.0), walls=True), b"GM00", (0, 0)),
    ("overhead", lit(Lamp(0.8, 0.0, overhead=True), walls=True, car=True), b"GM11", (200, 200)),
    ("behind a car", lit(Lamp(0.8, 0.0), car=True), b"GM00", (0, 0)),
    ("behind a disc", lit(Lamp(0.8, 0.0), thing=MovingObject("post", 0.4, 0.0, radius_m=0.1)), b"GM00", (0, 0)),
    ("behind a box", lit(Lamp(0.8, 0.0), thing=MovingObject("b", 0.4, 0.0, width_m=0.1, depth_m=0.2)), b"GM00", (0, 0)),
    (
        "on that thing",
        lit(Lamp(0.0, 0.0, carried_by="post"), thing=MovingObject("post", 0.4, radius_m=0.1)),
        b"GM11",
        (200, 200),
    ),
    ("on the car before it", lit(Lamp(-0.1, 0.0, carried_by="green"), car=True), b"GM11", (200, 200)),
    ("on its own back", lit(Lamp(0.5, 0.0, carried_by="red")), b"GM00", (0, 0)),
    ("on a car that is not there", lit(Lamp(0.0, 0.0, carried_by="blue")), b"GM00", (0, 0)),
]


@pytest.mark.parametrize(("where", "world", "word", "motors"), SEEKING, ids=[row[0] for row in SEEKING])
async def test_seeking_a_lamp(where: str, world: World, word: bytes, motors: tuple[int, int]) -> None:
    car = await opened(copy.deepcopy(world), 5)
    assert word in car.received, where
    assert (car.truth.motor_left, car.truth.motor_right) == motors


async def test_mode_0_report_has_same_bits_not_inverted() -> None:
    starts = {"red": HOME, "green": Pose(0.30, -0.22, 0.0)}
    world = World([(2.0, -9.0, 2.0, 9.0)], lamps=[Lamp(0.5, 0.6)], starts=starts, cars_meet=True)
    car = VirtualStranger(cars(world, "red", "green")["red"])
    await car.wait(1.5)
    report = bytes(car.received[: car.received.index(b"#")])
    assert b",HW01,GM10" in report
    assert float(report.partition(b"CSB")[2].partition(b",")[0]) == pytest.approx(190, abs=1)


RANGES = [
    ("a car", before(1.0, 0.0), 0.0, 100 - 10 - 13),
    ("a car to the left", before(0.1, 1.0), 90.0, 100 - 13),
    ("touched", before(0.26, 0.0), 0.0, 3.0),
    ("a car beyond its reach", before(5.3, 0.0), 0.0, None),
    ("nothing ahead", before(-1.0, 0.0), 0.0, None),
    ("a disc", lit(Lamp(0, 0), thing=MovingObject("post", 2.1, 0.0, radius_m=0.5)), 0.0, 150.0),
    ("a box", lit(Lamp(0, 0), thing=MovingObject("box", 2.1, 0.0, width_m=1.0, depth_m=1.0)), 0.0, 150.0),
    ("a wall before a car", lit(Lamp(0, 0), walls=True, thing=MovingObject("p", 0.9, radius_m=0.1)), 0.0, 30.0),
    ("its own load", lit(Lamp(0, 0), thing=MovingObject("mast", 0.2, radius_m=0.05, carried_by="red")), 0.0, None),
    (
        "another's load",
        lit(Lamp(0, 0), car=True, thing=MovingObject("m", -0.2, radius_m=0.05, carried_by="green")),
        0.0,
        5.0,
    ),
    (
        "a box that sends the sound away",
        World(things=[MovingObject("b", 0.2, 0.4, width_m=2, depth_m=0.1)]),
        -5.0,
        None,
    ),
]


@pytest.mark.parametrize(("what", "world", "bearing", "cm"), RANGES, ids=[row[0] for row in RANGES])
def test_ranging(what: str, world: World, bearing: float, cm: float | None) -> None:
    world = copy.deepcopy(world)
    red = CarBody(world, HOME, random.Random(1), name="red")
    CarBody(world, world.start_pose(1, "green"), random.Random(1), name="green")
    assert red.range_cm(0.0, bearing) == (None if cm is None else pytest.approx(cm, abs=1.5)), what


def test_cars_that_do_not_meet_are_as_if_alone() -> None:
    world = World(starts={"red": HOME, "green": Pose(0.3, 0.0, 0.0)})
    red, green = (CarBody(world, world.start_pose(0, name), random.Random(1), name=name) for name in ("red", "green"))
    assert red.obstacle(0) == (False, False)
    assert red.range_cm(0, 0) is None
    red.drive(0, 255, 255)
    assert red.pose(2).x_m == pytest.approx(1.0)
    assert green.pose(2) == Pose(0.3, 0.0, 0.0)


def test_car_neither_drives_through_another_nor_pushes_it() -> None:
    world = before(1.0, 0.01)
    red, green = (CarBody(world, world.start_pose(0, name), random.Random(1), name=name) for name in ("red", "green"))
    red.drive(0, 255, 255)
    for tick in range(1, 31):
        at = red.pose(0.1 * tick)
        assert hypot(at.x_m - 1.0, at.y_m - 0.01) >= 2 * RADIUS_M - HAIR_M
    assert red.pose(1.6).x_m > 0.7
    assert green.pose(3.0) == Pose(1.0, 0.01, 0.0)


def test_two_that_meet_head_on_stand_against_each_other() -> None:
    world = World(starts={"red": HOME, "green": Pose(1.0, 0.0, pi)}, cars_meet=True)
    bodies = [CarBody(world, world.start_pose(0, name), random.Random(1), name=name) for name in ("red", "green")]
    for body in bodies:
        body.drive(0, 200, 200)
    red, green = (body.pose(5.0) for body in bodies)
    assert green.x_m - red.x_m == pytest.approx(2 * RADIUS_M, abs=HAIR_M)
    assert 0.2 < red.x_m < 0.6


def test_moving_thing_pushes_standing_car_not_through_wall() -> None:
    cart = MovingObject("cart", radius_m=0.1, path=((-1.0, 0.0), (9.0, 0.0)), speed_m_s=0.2)
    world = World([(0.5, -1.0, 0.5, 1.0)], things=[cart])
    car = CarBody(world, HOME, random.Random(1), name="red")
    assert car.pose(3.0) == HOME
    assert car.pose(5.0).x_m == pytest.approx(0.1 + RADIUS_M, abs=0.01)
    assert car.pose(40.0).x_m <= 0.5 - RADIUS_M + HAIR_M


def test_thing_follows_path_at_its_speed() -> None:
    square = MovingObject("cart", radius_m=0.1, path=((0, 0), (1, 0), (1, 1), (0, 1)), speed_m_s=0.5)
    for at_s, x, y in ((0, 0, 0), (1, 0.5, 0), (3, 1, 0.5), (7, 0, 0.5), (8, 0, 0), (9, 0.5, 0)):
        assert square.pose(at_s)[:2] == pytest.approx((x, y))
    assert square.faster(0.25, 1.0).pose(3.0)[:2] == pytest.approx((1, 0))
    assert square.faster(0.0, 3.0).pose(99.0)[:2] == pytest.approx((1, 0.5))
    assert square.put(5, 6).pose(9.0)[:2] == (5, 6)
    guide = replace(square, waits_for_m=0.3)
    assert guide.waiting(1.0, near=False).pose(5.0)[:2] == pytest.approx((0.5, 0))
    assert guide.waiting(1.0, near=False).waiting(5.0, near=True).pose(6.0)[:2] == pytest.approx((1, 0))


def test_meeting_cars_are_independent_of_order() -> None:
    seen = []
    for order in itertools.permutations(("red", "green", "blue")):
        world = World.room()
        lively = World(world.walls, world.line, cars_meet=True)
        crowd = cars(lively, "red", "green", "blue")
        for name, mode in (("red", 2), ("green", 3), ("blue", 6)):
            crowd[name].feed(opening(mode), 1.0)
        sent = {name: bytearray() for name in crowd}
        for step in range(1, 400):
            for name in order:
                sent[name] += b"".join(data for _, data in crowd[name].advance(1.0 + 0.05 * step))
        seen.append((sent, [(car.truth, list(car.motor_log)) for car in crowd.values()]))
    assert all(one == seen[0] for one in seen)


places = st.floats(-1.8, 1.8)
powers = st.integers(-255, 255)


@st.composite
def lively_worlds(draw: st.DrawFn) -> tuple[World, list[Pose]]:
    """Draw a room with objects, and cars with room around them."""
    sides = st.tuples(places, places, places, places).filter(
        lambda wall: hypot(wall[2] - wall[0], wall[3] - wall[1]) > 0.1
    )
    walls = [*box(0, 0, 4, 4), *draw(st.lists(sides, max_size=3))]
    starts: list[Pose] = []
    for _ in range(3):
        x, y = draw(places), draw(places)
        free = all(distance(x, y, wall) >= RADIUS_M for wall in walls)
        if free and all(hypot(x - other.x_m, y - other.y_m) >= 2 * RADIUS_M for other in starts):
            starts.append(Pose(x, y, draw(st.floats(-4, 4))))
    speed, carrier = draw(st.floats(0, 0.5)), draw(st.sampled_from(("", "car0", "car7")))
    path = tuple(draw(st.lists(st.tuples(places, places), min_size=2, max_size=4, unique=True)))
    things = [
        MovingObject(
            "disc",
            radius_m=draw(st.floats(0.02, 0.5)),
            path=path,
            speed_m_s=speed,
            waits_for_m=draw(st.just(0) | places.map(abs)),
        ),
        MovingObject(
            "box", draw(places), draw(places), width_m=0.4, depth_m=0.2, heading_rad=draw(places), carried_by=carrier
        ),
    ]
    lamps = [Lamp(draw(places), draw(places), 3.0, carried_by=draw(st.sampled_from(("", "disc", "box", "car0"))))]
    return World(walls, lamps=lamps, things=things[: draw(st.integers(0, 2))], cars_meet=draw(st.booleans())), starts


@settings(max_examples=60, deadline=None)
@given(lively_worlds(), st.lists(st.tuples(st.floats(0.0, 0.7), st.integers(0, 2), powers, powers), max_size=20))
def test_nobody_is_inside_a_wall_or_another(
    scene: tuple[World, list[Pose]], drives: list[tuple[float, int, int, int]]
) -> None:
    world, starts = scene
    bodies = [CarBody(world, pose, random.Random(1), name=f"car{number}") for number, pose in enumerate(starts)]
    now = 0.0
    for gap, number, left, right in drives:
        now += gap
        if number < len(bodies):
            bodies[number].drive(now, left, right)
        poses = [body.pose(now) for body in bodies]
        assert all(map(isfinite, itertools.chain(*poses)))
        if world.lively:
            for pose, wall in itertools.product(poses, world.walls):
                assert distance(pose.x_m, pose.y_m, wall) >= RADIUS_M - HAIR_M
        if world.cars_meet:
            for one, other in itertools.combinations(poses, 2):
                assert hypot(one.x_m - other.x_m, one.y_m - other.y_m) >= 2 * RADIUS_M - HAIR_M
                ends = one[:2], other[:2]
                assert world.clear(*ends, now=now) == world.clear(*reversed(ends), now=now)
        for body in bodies:
            cm = body.range_cm(now, 90.0 * (left / 255))
            assert cm is None or 0 <= cm <= SONAR_REACH_CM
            assert {*body.obstacle(now), *body.light(now)} <= {True, False}


@settings(max_examples=200, deadline=None)
@given(lively_worlds(), st.tuples(places, places), st.tuples(places, places), st.floats(0, 20))
def test_line_of_sight_is_symmetric(
    scene: tuple[World, list[Pose]], a: tuple[float, float], b: tuple[float, float], now: float
) -> None:
    world, starts = scene
    for number, pose in enumerate(starts):
        CarBody(world, pose, random.Random(1), name=f"car{number}")
    world.settle(now)
    assert world.clear(a, b, now=now) == world.clear(b, a, now=now)


async def test_lost_follower_finds_leader_put_before_it() -> None:
    world = lit(Lamp(9.0, 9.0), thing=MovingObject("post", 2.0, 0.0, radius_m=0.1))
    car = await opened(world, 6)
    assert not car.truth.driving
    world.put_thing("post", 0.3, None, car.now)
    await car.until(lambda truth: truth.driving)
    world.put_thing("post", None, 2.0, car.now)
    await car.until(lambda truth: not truth.driving)


async def test_lamp_is_switched_while_a_car_seeks_it() -> None:
    world = lit(Lamp(5.0, 0.0, reach_m=9.0, name="beacon"))
    car = await opened(world, 5)
    assert car.truth.driving
    world.change_lamp("beacon", on=False)
    await car.until(lambda truth: not truth.driving)
    world.change_lamp("beacon", on=True)
    await car.until(lambda truth: truth.driving)


async def test_general_frame_drives_in_a_lively_world_too() -> None:
    car = VirtualStranger(cars(before(3.0, 0.0), "red", "green")["red"])
    await car.write(RUN)
    await car.wait(2.0)
    assert car.car.pose(car.now).x_m == pytest.approx(150 / 255 * 0.5 * 2, abs=0.03)

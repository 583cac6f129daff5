"""A row of cars: one seeks a lamp, the others follow. Real controllers and programs on virtual time."""

from collections.abc import Callable
from itertools import pairwise
from math import hypot

import pytest

from fleet.examples import EXAMPLES
from gateway.control.commands import SetMode, Stop
from gateway.sim.model.objects import Lamp, MovingObject
from gateway.sim.model.world import World
from gateway.sim.world_file import WorldSpec, read_world
from schemas.geometry import RADIUS_M
from schemas.words import Mode, Verdict
from tests.support.virtual import Pair

ROW = ("red", "green", "blue")
WORLD = (EXAMPLES / "worlds" / "follow.yaml").read_text()
NEAR_M = 0.45
"""Maximum distance between the middles of neighbors. Beyond 0.42 m, a follower's infrared loses the car ahead."""
LOOK_S = 0.1
STEP_S = 0.01
"""Time step in which all cars of one world move."""


def spec() -> WorldSpec:
    return read_world(WORLD, "follow.yaml", ROW)


class Row:
    """Cars of one world with their controllers, on one clock."""

    def __init__(self, world: World, *, seed: int = 1) -> None:
        self.world = world
        self.pairs = {name: Pair(seed=seed + number, world=world, name=name) for number, name in enumerate(ROW)}
        for pair in self.pairs.values():
            pair.connect()
        self.until(
            lambda: all(
                pair.control.driver.model.known and pair.control.driver.model.mode.inferred is not None
                for pair in self.pairs.values()
            ),
            30.0,
        )

    @property
    def now(self) -> float:
        return self.pairs["red"].now

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            for pair in self.pairs.values():
                pair.run(STEP_S)

    def until(self, so: Callable[[], bool], seconds: float) -> None:
        end = self.now + seconds
        while not so():
            assert self.now < end
            self.run(STEP_S)

    def go(self, *, late_s: float = 0.0) -> None:
        """Bring red into light seeking, then the others into following. Wait until all modes are open."""
        for name, mode in zip(ROW, (Mode.LIGHT_SEEKING, Mode.FOLLOWING, Mode.FOLLOWING), strict=True):
            self.pairs[name].ask(SetMode(mode))
            self.run(late_s)
        self.until(lambda: all(pair.car.truth.mode is not Mode.MANUAL for pair in self.pairs.values()), 10.0)
        self.run(4.0)

    def places(self) -> list[tuple[float, float]]:
        return [pair.car.pose(self.now)[:2] for pair in self.pairs.values()]

    def gaps(self) -> list[float]:
        return [hypot(a[0] - b[0], a[1] - b[1]) for a, b in pairwise(self.places())]


@pytest.mark.parametrize(("seed", "late_s"), [(1, 0.0), pytest.param(2, 0.3, marks=pytest.mark.soak), (3, 0.7)])
def test_two_follow_leader_seeking_lamp_for_a_minute(seed: int, late_s: float) -> None:
    row = Row(spec().world(), seed=seed)
    began = row.places()
    row.go(late_s=late_s)
    way, last = [0.0] * 3, row.places()
    for _ in range(600):
        row.run(LOOK_S)
        gaps, places = row.gaps(), row.places()
        assert min(gaps) >= 2 * RADIUS_M - 1e-6
        assert max(gaps) <= NEAR_M
        way = [one + hypot(a[0] - b[0], a[1] - b[1]) for one, a, b in zip(way, places, last, strict=True)]
        last = places
    for begun, ended in zip(began, last, strict=True):
        assert hypot(begun[0] - ended[0], begun[1] - ended[1]) > 1.0  # around a corner by now
    assert all(pair.control.driver.model.mode.verdict is Verdict.CONFIRMED for pair in row.pairs.values())
    assert min(way) > 1.8


def test_row_stands_without_light_of_leader() -> None:
    row = Row(spec().world())
    row.go()
    row.world.change_lamp("beacon", on=False)
    row.run(2.0)
    stood = row.places()
    row.run(10.0)
    assert row.places() == stood
    row.world.change_lamp("beacon", on=True)
    row.run(10.0)
    assert all(hypot(a[0] - b[0], a[1] - b[1]) > 0.1 for a, b in zip(row.places(), stood, strict=True))


def test_leader_that_a_person_stops_stops_the_row() -> None:
    row = Row(spec().world())
    row.go()
    row.run(3.0)
    row.pairs["red"].ask(Stop())
    row.run(3.0)
    stood = row.places()
    row.run(10.0)
    now = row.places()
    assert now[0] == stood[0]
    assert all(hypot(a[0] - b[0], a[1] - b[1]) < 0.03 for a, b in zip(now, stood, strict=True))
    assert max(row.gaps()) <= NEAR_M


def test_nobody_follows_cars_that_do_not_meet() -> None:
    follow = spec()
    row = Row(World(follow.walls, (), follow.lamps, things=follow.things, starts=follow.starts))
    began = row.places()
    row.go()
    row.run(10.0)
    assert row.places()[1:] == began[1:]
    assert row.places()[0] != began[0]


def test_lamp_on_a_cars_back_leads_the_next() -> None:
    follow = spec()
    lamps = (*follow.lamps, Lamp(-0.13, 0.0, reach_m=3.0, name="tail", carried_by="red"))
    row = Row(World(follow.walls, (), lamps, things=follow.things, starts=follow.starts, cars_meet=True))
    row.pairs["red"].ask(SetMode(Mode.LIGHT_SEEKING))
    row.pairs["green"].ask(SetMode(Mode.LIGHT_SEEKING))
    row.run(10.0)
    for _ in range(300):
        row.run(LOOK_S)
        assert row.gaps()[0] <= 0.6
    assert row.places()[1][0] > 1.0


def test_follower_follows_a_thing_on_a_path() -> None:
    post = MovingObject("post", radius_m=0.1, path=((0.35, 0.0), (3.0, 0.0)), speed_m_s=0.1, waits_for_m=0.37)
    starts = {name: pose._replace(y_m=2.0) for name, pose in spec().starts.items()}
    starts["green"] = starts["green"]._replace(x_m=0.0, y_m=0.0)
    row = Row(World(things=[post], starts=starts, cars_meet=True))
    row.pairs["green"].ask(SetMode(Mode.FOLLOWING))
    row.run(15.0)
    green = row.places()[1]
    assert green[0] > 0.8
    assert abs(green[1]) < 0.2

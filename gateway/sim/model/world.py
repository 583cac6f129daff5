"""The ONE flat world that all cars of a simulator share: walls, a taped line, lamps, things and the bodies of the cars.

A thing is a disc or a box that stands, moves or is carried. `car_body` has the sensors. A world is lively if it has
things or a carried lamp, or if cars meet. In a lively world, all cars are moved together, in ticks of STEP_S. In a
plain world, a car is moved only when its state is needed. Units and axes are those of REP-103: meters, x forward,
y left, angles counter-clockwise.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import atan2, ceil, cos, floor, hypot, sin
from typing import Final, Protocol

from msgspec.structs import replace

from gateway.sim.model.firmware_base import Pose
from gateway.sim.model.objects import Lamp, MovingObject, carried
from gateway.sim.model.scheduler import EventScheduler
from schemas.geometry import (
    RADIUS_M,
    Hit,
    Point,
    Segment,
    apart,
    box,
    distance,
    foot,
    loop,
    nearest,
    ray_to_circle,
    reach,
)

STEP_S: Final = 0.04
"""Maximum time between two collision checks, and the tick of a lively world."""
TAPE_M: Final = 0.025
_BUCKET_M: Final = 0.25
_PUSH_ROUNDS: Final = 3
"""Maximum number of rounds. In each round, a car is pushed out of one obstacle after the other."""
_TOLERANCE_M: Final = 1e-9
_START_GRID_M: Final = 0.4
"""Distance between the start places that the world chooses for cars without one in the world file."""
_START_REACH_M: Final = 4.0
"""Maximum of |x| and |y| of a start place of the grid, if there are no walls."""


class WorldBody(Protocol):
    """A car in the world."""

    @property
    def name(self) -> str:
        """The name of the car."""

    @property
    def place(self) -> Pose:
        """The pose after the last move."""

    @property
    def driving(self) -> bool:
        """True if a motor is on."""

    def glide(self, now: float) -> None:
        """Move the car as far as it drives until `now`, which is at most one tick after its last move."""


class World:
    """The walls and the line, which never change, and the lamps, things and cars, which do."""

    def __init__(
        self,
        walls: Iterable[Segment] = (),
        line: Sequence[Point] = (),
        lamps: Iterable[Lamp] = (),
        *,
        things: Iterable[MovingObject] = (),
        starts: Mapping[str, Pose] | None = None,
        cars_meet: bool = False,
    ) -> None:
        self.walls = tuple(walls)
        self.line = tuple(line)
        """A closed polyline. Empty if there is no line."""
        self.lamps = tuple(lamps)
        self.things = tuple(things)
        self.cars_meet = cars_meet
        """True if cars see each other and block each other's way."""
        self.lively = cars_meet or bool(self.things) or any(lamp.carried_by for lamp in self.lamps)
        """True if cars meet, or if the world has things or a carried lamp."""
        self.scheduler = EventScheduler()
        self.bodies: list[WorldBody] = []
        self._starts = dict(starts or {})
        self._began = 0.0
        self._tick = 0
        # Computed once: the sensors need these a thousand times per second of simulated time.
        self._rays = tuple((x1, y1, x2 - x1, y2 - y1, hypot(x2 - x1, y2 - y1)) for x1, y1, x2, y2 in self.walls)
        self._touching = tuple((wall, reach(wall, RADIUS_M)) for wall in self.walls)
        self._near: dict[tuple[int, int], list[Segment]] = {}
        self._length = 0.0
        for (x1, y1), (x2, y2) in zip(self.line, (*self.line[1:], *self.line[:1]), strict=True):
            self._length += hypot(x2 - x1, y2 - y1)
            low_x, high_x = sorted((x1, x2))
            low_y, high_y = sorted((y1, y2))
            for column in range(floor((low_x - TAPE_M) / _BUCKET_M), floor((high_x + TAPE_M) / _BUCKET_M) + 1):
                for row in range(floor((low_y - TAPE_M) / _BUCKET_M), floor((high_y + TAPE_M) / _BUCKET_M) + 1):
                    self._near.setdefault((column, row), []).append((x1, y1, x2, y2))

    @classmethod
    def room(cls) -> "World":
        """Return a room of 5.0 x 3.6 m with a box and a line loop. In such a small room every ranging has an echo."""
        walls = (*box(0.0, 0.0, 5.0, 3.6), *box(0.0, 0.0, 0.5, 0.5))
        return cls(walls, loop(1.7, 1.05, 0.6))

    @classmethod
    def open_field(cls) -> "World":
        """Return an empty world, in which no ranging ever has an echo."""
        return cls()

    def start_pose(self, index: int, name: str = "") -> Pose:
        """Return the start pose of a car: its own from the world file, or a place on the line that depends on `index`.

        Without a line, this place is on the y axis. In a lively world, a car without a place of its own starts where
        there is room, if there is such a place.
        """
        if name in self._starts:
            return self._starts[name]
        pose = self._spread(index)
        if not self.lively:
            return pose
        return next((each for each in (pose, *self._grid()) if self._free(each)), pose)

    def _grid(self) -> list[Pose]:
        """Return start places, the innermost first."""
        xs = [x for wall in self.walls for x in wall[::2]] or [-_START_REACH_M, _START_REACH_M]
        ys = [y for wall in self.walls for y in wall[1::2]] or [-_START_REACH_M, _START_REACH_M]
        spots = [
            Pose(_START_GRID_M * column, _START_GRID_M * row, 0.0)
            for column in range(ceil(min(xs) / _START_GRID_M), floor(max(xs) / _START_GRID_M) + 1)
            for row in range(ceil(min(ys) / _START_GRID_M), floor(max(ys) / _START_GRID_M) + 1)
        ]
        return sorted(spots, key=lambda pose: hypot(pose.x_m, pose.y_m))

    def _free(self, pose: Pose) -> bool:
        """Return True if a car can start there. The place must be empty.

        If the world file has start places, a car at one of them must see this place.
        """
        x, y, _ = pose
        cars = (*self._starts.values(), *(body.place for body in self.bodies)) if self.cars_meet else ()
        return (
            all(distance(x, y, wall) >= RADIUS_M for wall in self.walls)
            and all(thing.depth(at, x, y, RADIUS_M) <= 0 for thing, at in self.solids(None, self._began))
            and all(hypot(x - car.x_m, y - car.y_m) >= 2 * RADIUS_M for car in cars)
            and (not self._starts or any(self._reachable(pose, start) for start in self._starts.values()))
        )

    def _reachable(self, pose: Pose, other: Pose) -> bool:
        sight: Segment = (*pose[:2], *other[:2])
        return all(apart(sight, wall) > _TOLERANCE_M for wall in self.walls)

    def _spread(self, index: int) -> Pose:
        if not self.line:
            return Pose(0.0, float(index), 0.0)
        # Multiples of the golden ratio keep any number of cars apart.
        left = (index * 0.6180339887 % 1.0) * self._length
        for (x1, y1), (x2, y2) in zip(self.line, (*self.line[1:], *self.line[:1]), strict=True):
            length = hypot(x2 - x1, y2 - y1)
            if left <= length:
                share = left / length
                return Pose(x1 + share * (x2 - x1), y1 + share * (y2 - y1), atan2(y2 - y1, x2 - x1))
            left -= length
        return Pose(*self.line[0], 0.0)

    # Walls and line.

    def on_line(self, x: float, y: float) -> bool:
        """Return True if a point lies on the tape."""
        near = self._near.get((floor(x / _BUCKET_M), floor(y / _BUCKET_M)), ())
        return any(distance(x, y, segment) <= TAPE_M / 2 for segment in near)

    def ray(self, x: float, y: float, angle: float, steepest: float = 0.0) -> float | None:
        """Return the distance to the first wall, or None.

        A wall reflects only if the cosine of the angle between the ray and the normal of the wall is at least
        `steepest`.
        """
        best = self._wall(x, y, cos(angle), sin(angle))
        return None if best is None or best[1] < steepest else best[0]

    def _wall(self, x: float, y: float, dx: float, dy: float) -> Hit | None:
        best: Hit | None = None
        for x1, y1, wx, wy, length in self._rays:
            cross = dx * wy - dy * wx
            if abs(cross) < 1e-12:
                continue
            along = ((x1 - x) * wy - (y1 - y) * wx) / cross
            share = ((x1 - x) * dy - (y1 - y) * dx) / cross
            if along >= 0 and 0 <= share <= 1 and (best is None or along < best[0]):
                best = (along, abs(cross) / length)
        return best

    def push_out(self, x: float, y: float) -> Point:
        """Return the place near x, y to which the walls, one after the other, push a car that overlaps them."""
        for wall, (low_x, low_y, high_x, high_y) in self._touching:
            if not (low_x < x < high_x and low_y < y < high_y):
                continue
            fx, fy = foot(x, y, wall)
            away = hypot(x - fx, y - fy)
            if 0 < away < RADIUS_M:
                x, y = fx + (x - fx) * RADIUS_M / away, fy + (y - fy) * RADIUS_M / away
        return x, y

    # Moving things and cars.

    def join(self, body: WorldBody, now: float) -> None:
        """Add a car to the world."""
        if self.lively:
            if not self.bodies:
                self._began, self._tick = now, 0
            self.bodies.append(body)

    def settle(self, now: float) -> None:
        """Move all cars together, one tick after the other, up to the last tick that is not after `now`."""
        last = floor((now - self._began) / STEP_S)
        if last <= self._tick:
            return
        if not any(body.driving for body in self.bodies) and not any(thing.moves for thing in self.things):
            self._tick = last - 1
        while self._tick < last:
            self._tick += 1
            at = self._began + self._tick * STEP_S
            for body in self.bodies:
                body.glide(at)
            if any(thing.waits_for_m for thing in self.things):
                self.things = tuple(self._waiting(thing, at) for thing in self.things)

    def _waiting(self, thing: MovingObject, now: float) -> MovingObject:
        x, y, _ = thing.pose(now - self._began)
        places = [body.place for body in self.bodies]
        near = any(hypot(place.x_m - x, place.y_m - y) <= thing.waits_for_m for place in places)
        return thing.waiting(now - self._began, near=near)

    def others(self, me: WorldBody | None) -> Iterator[WorldBody]:
        """Yield the cars that a car can meet."""
        return (body for body in self.bodies if body is not me) if self.cars_meet else iter(())

    def carrier(self, name: str) -> WorldBody | None:
        """Return a car by its name. None if it does not exist."""
        return next((body for body in self.bodies if body.name == name), None)

    def where(self, thing: MovingObject, now: float) -> Pose | None:
        """Return the pose of a thing. None if the car that carries it does not exist."""
        pose = thing.pose(now - self._began)
        if not thing.carried_by:
            return pose
        car = self.carrier(thing.carried_by)
        return None if car is None else carried(car.place, pose.x_m, pose.y_m, pose.heading_rad)

    def shines(self, lamp: Lamp, now: float) -> Point | None:
        """Return the place of a lamp. None if its carrier does not exist."""
        if not lamp.carried_by:
            return lamp.x_m, lamp.y_m
        thing = next((each for each in self.things if each.name == lamp.carried_by), None)
        car = self.carrier(lamp.carried_by)
        base = self.where(thing, now) if thing is not None else None if car is None else car.place
        return None if base is None else carried(base, lamp.x_m, lamp.y_m)[:2]

    def solids(self, me: WorldBody | None, now: float) -> Iterator[tuple[MovingObject, Pose]]:
        """Yield the things that a car can meet, without those that it carries."""
        for thing in self.things:
            if me is None or thing.carried_by != me.name:
                pose = self.where(thing, now)
                if pose is not None:
                    yield thing, pose

    def make_room(self, me: WorldBody, x: float, y: float, now: float) -> Point:
        """Return the nearest free place for a car that moves to x, y. A jammed car stays in place."""
        things = [
            (thing, pose)
            for thing, pose in self.solids(me, now)
            if hypot(x - pose.x_m, y - pose.y_m) < 2 * RADIUS_M + thing.extent_m
        ]
        cars = [
            (other.place.x_m, other.place.y_m)
            for other in self.others(me)
            if hypot(x - other.place.x_m, y - other.place.y_m) < 4 * RADIUS_M
        ]
        target = x, y
        for _ in range(_PUSH_ROUNDS):
            before = x, y
            for ox, oy in cars:
                away = hypot(x - ox, y - oy)
                if 0 < away < 2 * RADIUS_M:
                    x, y = ox + (x - ox) * 2 * RADIUS_M / away, oy + (y - oy) * 2 * RADIUS_M / away
            for thing, pose in things:
                x, y = thing.pushed(pose, x, y, RADIUS_M)
            x, y = self.push_out(x, y)
            if (x, y) == before:
                break
        old = me.place
        if (x, y) == target and not cars:
            return x, y  # nothing in the way
        if self._passes(old.x_m, old.y_m, x, y, cars):
            return x, y
        return old.x_m, old.y_m

    def _passes(self, old_x: float, old_y: float, x: float, y: float, cars: list[Point]) -> bool:
        """Return True if a car may move there: through no wall, and no deeper into a wall or a car."""
        for wall, (low_x, low_y, high_x, high_y) in self._touching:
            if max(old_x, x) < low_x or min(old_x, x) > high_x or max(old_y, y) < low_y or min(old_y, y) > high_y:
                continue
            after = distance(x, y, wall)
            if after < min(RADIUS_M, distance(old_x, old_y, wall)) - _TOLERANCE_M:
                return False
            if (old_x, old_y) != (x, y) and apart((old_x, old_y, x, y), wall) <= _TOLERANCE_M:
                return False
        return all(
            hypot(x - ox, y - oy) >= min(2 * RADIUS_M, hypot(old_x - ox, old_y - oy)) - _TOLERANCE_M for ox, oy in cars
        )

    # Sight.

    def met(self, me: WorldBody | None, x: float, y: float, angle: float, reach_m: float, now: float) -> Hit | None:
        """Return the first hit of a ray on a thing or car within `reach_m`. All cars must have moved up to `now`."""
        dx, dy = cos(angle), sin(angle)
        hits: list[Hit | None] = []
        for other in self.others(me):
            place = other.place
            if hypot(place.x_m - x, place.y_m - y) <= reach_m + RADIUS_M:
                hits.append(ray_to_circle(x, y, dx, dy, (place.x_m, place.y_m), RADIUS_M))
        for thing, pose in self.solids(me, now):
            if hypot(pose.x_m - x, pose.y_m - y) <= reach_m + thing.extent_m:
                hits.append(thing.met(pose, x, y, dx, dy))
        hit = nearest(hits)
        return hit if hit is not None and hit[0] <= reach_m else None

    def clear(self, a: Point, b: Point, without: Iterable[str] = (), *, now: float = 0.0) -> bool:
        """Return True if nothing stands between two points. The result does not depend on their order.

        `without` has the names of cars and things to ignore, with what they carry.
        """
        a, b = sorted((a, b))
        sight: Segment = (*a, *b)
        if a == b:
            return True
        if any(apart(sight, wall) <= _TOLERANCE_M for wall in self.walls):
            return False
        ignored = set(without)
        for other in self.others(None):
            if other.name not in ignored and distance(other.place.x_m, other.place.y_m, sight) < RADIUS_M:
                return False
        for thing, pose in self.solids(None, now):
            if thing.name in ignored or thing.carried_by in ignored - {""}:
                continue
            if thing.radius_m:
                if distance(pose.x_m, pose.y_m, sight) < thing.radius_m:
                    return False
            elif any(apart(sight, side) <= _TOLERANCE_M for side in thing.sides(pose)):
                return False
        return True

    # Changes at run time.

    def advance(self, now: float) -> None:
        """Run every program and move every car up to `now`, before a change or a query."""
        self.scheduler.run(now)
        self.settle(now)
        for body in self.bodies:
            body.glide(now)

    def change_lamp(self, name: str, **fields: float | bool) -> None:
        """Change fields of a lamp."""
        self.lamps = tuple(
            # `world_commands` has checked the names and types.
            replace(lamp, **fields) if lamp.name == name else lamp
            for lamp in self.lamps
        )

    def speed_thing(self, name: str, speed_m_s: float, now: float) -> None:
        """Set the speed of a thing on a path."""
        at_s = now - self._began
        self.things = tuple(each.faster(speed_m_s, at_s) if each.name == name else each for each in self.things)

    def put_thing(self, name: str, x_m: float | None, y_m: float | None, now: float) -> None:
        """Move a thing to a place, where it stays. None leaves a coordinate unchanged.

        The place of a carried thing is in the frame of its car.
        """

        def put(thing: MovingObject) -> MovingObject:
            pose = thing.pose(now - self._began)
            return thing.put(pose.x_m if x_m is None else x_m, pose.y_m if y_m is None else y_m)

        self.things = tuple(put(each) if each.name == name else each for each in self.things)

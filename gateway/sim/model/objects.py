"""The lamps and things in the world, which cars see, bump into and follow. Pure values.

Times are seconds since the start of the world.
"""

from bisect import bisect_right
from itertools import accumulate, pairwise
from math import cos, hypot, sin, sqrt
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from gateway.sim.model.firmware_base import Pose
from schemas.geometry import (
    Hit,
    Point,
    Segment,
    foot,
    in_turned_box,
    nearest,
    ray_to_circle,
    ray_to_segment,
    turned_box,
)

FAR_M: Final = 100.0
"""Maximum of x and y in a world."""
# The top speed of a car. A much faster thing would jump over a car between two ticks.
FASTEST_M_S: Final = 0.5
"""Maximum speed of a thing."""


class Lamp(Struct, frozen=True):
    """A light that a sensor sees from up to `seen_from_m` away."""

    x_m: float
    y_m: float
    reach_m: float = 1.5
    """Range at a brightness of 1. A lamp that is four times as bright has twice the range."""
    brightness: float = 1.0
    on: bool = True
    overhead: bool = False
    """True if the lamp hangs above everything, so that nothing hides it."""
    name: str = ""
    carried_by: str = ""
    """Name of the thing or car that carries the lamp. Then x (ahead) and y (left) are in the frame of this carrier."""

    @property
    def seen_from_m(self) -> float:
        """The current range, or 0 if the lamp is off."""
        return self.reach_m * sqrt(self.brightness) if self.on else 0.0


class MovingObject(Struct, frozen=True):
    """A disc, or a box if it has no radius. It stands, moves along a path, or is carried by a car."""

    name: str
    x_m: float = 0.0
    y_m: float = 0.0
    radius_m: float = 0.0
    width_m: float = 0.0
    """Width of a box, which is its size along x if its heading is 0."""
    depth_m: float = 0.0
    heading_rad: float = 0.0
    path: tuple[Point, ...] = ()
    """A closed polyline on which the thing moves. It replaces x and y. A path there and back includes both ways."""
    speed_m_s: float = 0.0
    carried_by: str = ""
    """Name of the car that carries the thing. Then x (ahead) and y (left) are in the frame of this car."""
    waits_for_m: float = 0.0
    """The thing moves only while a car is within this distance of its middle. If 0, it always moves."""
    from_m: float = 0.0
    """How far along its path the thing was at the time `since_s`."""
    since_s: float = 0.0
    going: bool = True
    """False while the thing waits."""

    @property
    def moves(self) -> bool:
        """True if the thing moves along a path."""
        return bool(self.path) and self.speed_m_s > 0

    @property
    def extent_m(self) -> float:
        """The distance from the middle of the thing to its farthest point."""
        return self.radius_m or hypot(self.width_m, self.depth_m) / 2

    def pose(self, at_s: float) -> Pose:
        """Return the pose of the thing. The pose of a carried thing is in the frame of its car."""
        if not self.path:
            return Pose(self.x_m, self.y_m, self.heading_rad)
        ends = _ends(self.path)
        along = self.along_m(at_s)
        part = min(bisect_right(ends, along), len(self.path) - 1)
        (x1, y1), (x2, y2) = self.path[part], self.path[(part + 1) % len(self.path)]
        length = hypot(x2 - x1, y2 - y1)
        share = 1 - (ends[part] - along) / length if length > 0 else 0.0
        return Pose(x1 + share * (x2 - x1), y1 + share * (y2 - y1), self.heading_rad)

    def along_m(self, at_s: float) -> float:
        """Return the position along the path, or 0 without a path."""
        if not self.path:
            return 0.0
        length = _ends(self.path)[-1]
        gone = self.speed_m_s * (at_s - self.since_s) if self.going else 0.0
        return (self.from_m + gone) % length if length > 0 else 0.0

    def faster(self, speed_m_s: float, at_s: float) -> "MovingObject":
        """Return the thing with another speed from this time on."""
        return replace(self, from_m=self.along_m(at_s), since_s=at_s, speed_m_s=speed_m_s)

    def waiting(self, at_s: float, *, near: bool) -> "MovingObject":
        """Return the thing as it is from this time on: it moves if a car is near, and waits otherwise."""
        if not self.waits_for_m or near == self.going:
            return self
        return replace(self, from_m=self.along_m(at_s), since_s=at_s, going=near)

    def put(self, x_m: float, y_m: float) -> "MovingObject":
        """Return the thing at another place, off its path."""
        return replace(self, x_m=x_m, y_m=y_m, path=(), speed_m_s=0.0)

    def met(self, pose: Pose, x: float, y: float, dx: float, dy: float) -> Hit | None:
        """Return the hit of a ray from x, y on the thing at `pose`, or None."""
        if self.radius_m:
            return ray_to_circle(x, y, dx, dy, (pose.x_m, pose.y_m), self.radius_m)
        if self._inside(pose, x, y):
            return (0.0, 1.0)
        return nearest(ray_to_segment(x, y, dx, dy, side) for side in self.sides(pose))

    def sides(self, pose: Pose) -> tuple[Segment, ...]:
        """Return the sides of a box."""
        return turned_box(pose.x_m, pose.y_m, pose.heading_rad, self.width_m, self.depth_m)

    def depth(self, pose: Pose, x: float, y: float, radius: float) -> float:
        """Return how deep a disc at x, y overlaps the thing. If negative, it is the distance between them."""
        if self.radius_m:
            return radius + self.radius_m - hypot(x - pose.x_m, y - pose.y_m)
        fx, fy = self._nearest(pose, x, y)
        away = hypot(x - fx, y - fy)
        return radius + away if self._inside(pose, x, y) else radius - away

    def pushed(self, pose: Pose, x: float, y: float, radius: float) -> Point:
        """Return the place nearest to x, y at which a disc does not overlap the thing."""
        depth = self.depth(pose, x, y, radius)
        if depth <= 0:
            return x, y
        if self.radius_m:
            fx, fy = pose.x_m, pose.y_m
        else:
            fx, fy = self._nearest(pose, x, y)
            if self._inside(pose, x, y):
                depth = -depth
        away = hypot(x - fx, y - fy)
        if away == 0:
            return x + depth, y
        return x + (x - fx) / away * depth, y + (y - fy) / away * depth

    def _nearest(self, pose: Pose, x: float, y: float) -> Point:
        feet = [foot(x, y, side) for side in self.sides(pose)]
        return min(feet, key=lambda point: hypot(x - point[0], y - point[1]))

    def _inside(self, pose: Pose, x: float, y: float) -> bool:
        return in_turned_box(x - pose.x_m, y - pose.y_m, pose.heading_rad, self.width_m, self.depth_m)


def _ends(path: tuple[Point, ...]) -> list[float]:
    """Return the position along a closed path at which each part ends."""
    return list(accumulate(hypot(x2 - x1, y2 - y1) for (x1, y1), (x2, y2) in pairwise((*path, path[0]))))


def carried(carrier: Pose, ahead: float, left: float, turn: float = 0.0) -> Pose:
    """Return the pose of something at a place in its carrier's frame."""
    c, s = cos(carrier.heading_rad), sin(carrier.heading_rad)
    return Pose(carrier.x_m + ahead * c - left * s, carrier.y_m + ahead * s + left * c, carrier.heading_rad + turn)

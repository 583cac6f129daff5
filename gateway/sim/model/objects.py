"""What stands or moves in the world besides cars: lamps, and things to see, to bump into and to follow. Pure values.

A change makes another value; what a lamp or a thing does to a car is world.py's part. Times are seconds since the
world began.
"""

from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from math import cos, hypot, sin, sqrt
from typing import Final

from gateway.sim.model.firmware import Pose
from gateway.sim.model.geometry import Hit, Point, Segment, foot, nearest, ray_to_circle, ray_to_segment, turned_box

FAR_M: Final = 100.0
"""No place in a world is farther from its middle, in x or in y."""
FASTEST_M_S: Final = 0.5
"""Of a thing: a car's own top speed. A much faster one would step over a car between two ticks."""


@dataclass(frozen=True, slots=True)
class Lamp:
    """A light that a sensor sees from up to `reach_m` away."""

    x_m: float
    y_m: float
    reach_m: float = 1.5
    """With a brightness of 1; four times as bright is seen from twice as far."""
    brightness: float = 1.0
    on: bool = True
    overhead: bool = False
    """Hangs higher than everything: nothing throws a shadow."""
    name: str = ""
    carried_by: str = ""
    """A thing or a car, in whose frame x (ahead) and y (left) then are."""

    @property
    def seen_from_m(self) -> float:
        """From how far away it is seen now; 0 if it is off."""
        return self.reach_m * sqrt(self.brightness) if self.on else 0.0


@dataclass(frozen=True, slots=True)
class MovingObject:
    """A disc, or a box if it has no radius. It stands, moves along a path, or is carried by a car."""

    name: str
    x_m: float = 0.0
    y_m: float = 0.0
    radius_m: float = 0.0
    width_m: float = 0.0
    """Of a box: along x, when its heading is 0."""
    depth_m: float = 0.0
    heading_rad: float = 0.0
    path: tuple[Point, ...] = ()
    """A closed polyline; a thing with one has no place of its own. There and back: the points back, too."""
    speed_m_s: float = 0.0
    carried_by: str = ""
    """A car, in whose frame x (ahead) and y (left) then are."""
    waits_for_m: float = 0.0
    """It goes on only while a car is within so far from its middle; 0: it waits for nobody."""
    from_m: float = 0.0
    """Where on its path it was at `since_s`."""
    since_s: float = 0.0
    going: bool = True
    """False while it waits."""

    @property
    def moves(self) -> bool:
        """Whether it goes along its path by itself."""
        return bool(self.path) and self.speed_m_s > 0

    @property
    def extent_m(self) -> float:
        """From its middle to the farthest of it."""
        return self.radius_m or hypot(self.width_m, self.depth_m) / 2

    def pose(self, at_s: float) -> Pose:
        """Where it is; of a carried thing: in the car's frame."""
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
        """How far along its path it is; 0 without one."""
        if not self.path:
            return 0.0
        length = _ends(self.path)[-1]
        gone = self.speed_m_s * (at_s - self.since_s) if self.going else 0.0
        return (self.from_m + gone) % length if length > 0 else 0.0

    def faster(self, speed_m_s: float, at_s: float) -> "MovingObject":
        """The same with another speed from now on."""
        return replace(self, from_m=self.along_m(at_s), since_s=at_s, speed_m_s=speed_m_s)

    def waiting(self, at_s: float, *, near: bool) -> "MovingObject":
        """The same when the nearest car is, or is not, as near as it waits for."""
        if not self.waits_for_m or near == self.going:
            return self
        return replace(self, from_m=self.along_m(at_s), since_s=at_s, going=near)

    def put(self, x_m: float, y_m: float) -> "MovingObject":
        """The same elsewhere, where it stays: it has left its path."""
        return replace(self, x_m=x_m, y_m=y_m, path=(), speed_m_s=0.0)

    def met(self, pose: Pose, x: float, y: float, dx: float, dy: float) -> Hit | None:
        """Where a ray meets it when it is at `pose`."""
        if self.radius_m:
            return ray_to_circle(x, y, dx, dy, (pose.x_m, pose.y_m), self.radius_m)
        if self._inside(pose, x, y):
            return (0.0, 1.0)
        return nearest(ray_to_segment(x, y, dx, dy, side) for side in self.sides(pose))

    def sides(self, pose: Pose) -> tuple[Segment, ...]:
        """Of a box."""
        return turned_box(pose.x_m, pose.y_m, pose.heading_rad, self.width_m, self.depth_m)

    def depth(self, pose: Pose, x: float, y: float, radius: float) -> float:
        """How deep a disc at x, y is in it; negative: how far away it is."""
        if self.radius_m:
            return radius + self.radius_m - hypot(x - pose.x_m, y - pose.y_m)
        fx, fy = self._nearest(pose, x, y)
        away = hypot(x - fx, y - fy)
        return radius + away if self._inside(pose, x, y) else radius - away

    def pushed(self, pose: Pose, x: float, y: float, radius: float) -> Point:
        """Where a disc that overlaps it has to be so that it does not."""
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
        c, s = cos(pose.heading_rad), sin(pose.heading_rad)
        dx, dy = x - pose.x_m, y - pose.y_m
        return abs(dx * c + dy * s) < self.width_m / 2 and abs(dy * c - dx * s) < self.depth_m / 2


def _ends(path: tuple[Point, ...]) -> list[float]:
    """How far along a closed path each of its parts ends."""
    return list(accumulate(hypot(x2 - x1, y2 - y1) for (x1, y1), (x2, y2) in pairwise((*path, path[0]))))


def carried(carrier: Pose, ahead: float, left: float, turn: float = 0.0) -> Pose:
    """Where something is that is carried at a place in its carrier's frame."""
    c, s = cos(carrier.heading_rad), sin(carrier.heading_rad)
    return Pose(carrier.x_m + ahead * c - left * s, carrier.y_m + ahead * s + left * c, carrier.heading_rad + turn)

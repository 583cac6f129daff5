"""The ONE flat world that all cars of a simulator share: walls, a taped line, lamps; and each car's body in it.

Poses are integrated in closed form, lazily, whenever someone looks; a car at rest costs nothing. Cars do not see
or touch each other. REP-103: metres, x forward, y left, angles counter-clockwise.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import atan2, ceil, cos, degrees, floor, hypot, pi, radians, sin
from typing import Final, TypeAlias

from gateway.sim.core.firmware import Pose, Rng

Point: TypeAlias = tuple[float, float]
Segment: TypeAlias = tuple[float, float, float, float]

TOP_SPEED_M_S: Final = 0.5
"""Of a wheel at PWM 255."""
TRACK_M: Final = 0.20
"""Effective distance of the wheels; wider than the car's, since four wheels skid when they turn."""
RADIUS_M: Final = 0.13
STEP_S: Final = 0.04
"""Longest stretch of driving between two looks for a wall."""

SONAR_AT_M: Final = 0.10
SONAR_REACH_CM: Final = 499.0
"""Just below the 500 cm from which the car's own program throws a reading away."""
SONAR_CONE: Final = tuple(radians(degree) for degree in (-15.0, -7.5, 0.0, 7.5, 15.0))
SONAR_STEEPEST: Final = cos(radians(76))
"""A wall hit at a flatter angle than this reflects the sound away."""
INFRARED_REACH_M: Final = 0.20
LINE_SENSORS: Final = ((0.08, 0.040), (0.08, 0.010), (0.08, -0.010), (0.08, -0.040))
"""Ahead and left of the axle's middle, m: left-outer .. right-outer."""
TAPE_M: Final = 0.025
LAMP_SIDE: Final = radians(30)
LAMP_CONE: Final = radians(50)
_BUCKET_M: Final = 0.25

FLOOR_GRAY: Final = 214
TAPE_GRAY: Final = 740


@dataclass(frozen=True, slots=True)
class Lamp:
    """A light that a sensor sees from up to `reach_m` away."""

    x_m: float
    y_m: float
    reach_m: float = 1.5


class World:
    """Walls, line and lamps; nothing in it moves."""

    def __init__(self, walls: Iterable[Segment] = (), line: Sequence[Point] = (), lamps: Iterable[Lamp] = ()) -> None:
        self.walls = tuple(walls)
        self.line = tuple(line)
        """A closed polyline; empty for none."""
        self.lamps = tuple(lamps)
        # What is asked for a thousand times a second of simulated time is worked out once.
        self._rays = tuple((x1, y1, x2 - x1, y2 - y1, hypot(x2 - x1, y2 - y1)) for x1, y1, x2, y2 in self.walls)
        self._touching = tuple((wall, _reach(wall, RADIUS_M)) for wall in self.walls)
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
        """A room of 5.0 x 3.6 m, a box in its middle, a loop of line: small enough that every ranging has an echo."""
        walls = (*_box(0.0, 0.0, 5.0, 3.6), *_box(0.0, 0.0, 0.5, 0.5))
        return cls(walls, _loop(1.7, 1.05, 0.6))

    @classmethod
    def open_field(cls) -> "World":
        """Nothing at all: no ranging ever has an echo."""
        return cls()

    def start_pose(self, index: int) -> Pose:
        """Where car number `index` begins: on the line, along it; the cars spread over its length."""
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

    def on_line(self, x: float, y: float) -> bool:
        """Whether a point lies on the tape."""
        near = self._near.get((floor(x / _BUCKET_M), floor(y / _BUCKET_M)), ())
        return any(_distance(x, y, segment) <= TAPE_M / 2 for segment in near)

    def ray(self, x: float, y: float, angle: float, steepest: float = 0.0) -> float | None:
        """Distance to the first wall; `steepest`: least cosine to its normal that sends something back."""
        dx, dy = cos(angle), sin(angle)
        best: tuple[float, float] | None = None
        for x1, y1, wx, wy, length in self._rays:
            cross = dx * wy - dy * wx
            if abs(cross) < 1e-12:
                continue
            along = ((x1 - x) * wy - (y1 - y) * wx) / cross
            share = ((x1 - x) * dy - (y1 - y) * dx) / cross
            if along >= 0 and 0 <= share <= 1 and (best is None or along < best[0]):
                best = (along, abs(cross) / length)
        return None if best is None or best[1] < steepest else best[0]

    def push_out(self, x: float, y: float) -> Point:
        """The nearest place at which a car does not overlap a wall."""
        for wall, (low_x, low_y, high_x, high_y) in self._touching:
            if not (low_x < x < high_x and low_y < y < high_y):
                continue
            fx, fy = _foot(x, y, wall)
            away = hypot(x - fx, y - fy)
            if 0 < away < RADIUS_M:
                x, y = fx + (x - fx) * RADIUS_M / away, fy + (y - fy) * RADIUS_M / away
        return x, y


class CarBody:
    """One car in the world."""

    def __init__(self, world: World, pose: Pose, rng: Rng, now: float = 0.0) -> None:
        self._world = world
        self._x, self._y, self._heading = pose
        self._now = now
        self._left = self._right = 0
        self._battery = 7.6 + 0.7 * rng.random()
        self._started = now

    def drive(self, now: float, left: int, right: int) -> None:
        """From `now` on the motors have these PWM values."""
        self._move(now)
        self._left, self._right = left, right

    def pose(self, now: float) -> Pose:
        """The true pose; heading in -pi..pi."""
        self._move(now)
        return Pose(self._x, self._y, (self._heading + pi) % (2 * pi) - pi)

    def _wheels(self) -> tuple[float, float]:
        return TOP_SPEED_M_S * self._left / 255, TOP_SPEED_M_S * self._right / 255

    def _move(self, now: float) -> None:
        span = now - self._now
        if span <= 0:
            return
        self._now = now
        if self._left == self._right == 0:
            return
        left, right = self._wheels()
        speed, turn = (left + right) / 2, (right - left) / TRACK_M
        steps = 1 if speed == 0 else ceil(span / STEP_S)
        step = span / steps
        for _ in range(steps):
            heading = self._heading + turn * step
            if abs(turn) < 1e-9:
                x = self._x + speed * step * cos(heading)
                y = self._y + speed * step * sin(heading)
            else:
                radius = speed / turn
                x = self._x + radius * (sin(heading) - sin(self._heading))
                y = self._y - radius * (cos(heading) - cos(self._heading))
            self._x, self._y = self._world.push_out(x, y)
            self._heading = heading

    def _at(self, ahead: float, left: float) -> Point:
        c, s = cos(self._heading), sin(self._heading)
        return self._x + ahead * c - left * s, self._y + ahead * s + left * c

    def range_cm(self, now: float, bearing_deg: float) -> float | None:
        """The nearest echo within the cone, from the sensor at the car's front."""
        self._move(now)
        x, y = self._at(SONAR_AT_M, 0.0)
        middle = self._heading + radians(bearing_deg)
        rays = (self._world.ray(x, y, middle + offset, SONAR_STEEPEST) for offset in SONAR_CONE)
        nearest = min((distance for distance in rays if distance is not None), default=None)
        return None if nearest is None or nearest * 100 > SONAR_REACH_CM else nearest * 100

    def line(self, now: float) -> tuple[bool, bool, bool, bool]:
        """What the four line sensors see."""
        self._move(now)
        if not self._world.line:
            return (False, False, False, False)
        seen = [self._world.on_line(*self._at(ahead, left)) for ahead, left in LINE_SENSORS]
        return (seen[0], seen[1], seen[2], seen[3])

    def obstacle(self, now: float) -> tuple[bool, bool]:
        """Infrared, looking ahead and 20 degrees outwards."""
        self._move(now)
        seen = []
        for side in (1, -1):
            x, y = self._at(0.10, 0.06 * side)
            distance = self._world.ray(x, y, self._heading + side * radians(20))
            seen.append(distance is not None and distance <= INFRARED_REACH_M)
        return (seen[0], seen[1])

    def light(self, now: float) -> tuple[bool, bool]:
        """Whether a lamp stands before the left and the right light sensor."""
        self._move(now)
        seen = [False, False]
        for lamp in self._world.lamps:
            dx, dy = lamp.x_m - self._x, lamp.y_m - self._y
            if hypot(dx, dy) <= lamp.reach_m:
                bearing = atan2(dy, dx) - self._heading
                for index, side in enumerate((LAMP_SIDE, -LAMP_SIDE)):
                    off = (bearing - side + pi) % (2 * pi) - pi
                    seen[index] = seen[index] or abs(off) <= LAMP_CONE
        return (seen[0], seen[1])

    def grayscale(self, now: float) -> int:
        """The floor under the car's middle: high on the tape."""
        self._move(now)
        return TAPE_GRAY if self._world.line and self._world.on_line(self._x, self._y) else FLOOR_GRAY

    def battery_v(self, now: float) -> float:
        """Falls by 0.3 V an hour and sags by up to 0.25 V under load; not below 6.4, where its electronics cut off."""
        load = 0.25 * (abs(self._left) + abs(self._right)) / 510
        return max(6.4, self._battery - 0.3 * (now - self._started) / 3600 - load)

    def yaw_rate_deg_s(self, now: float) -> float:
        """How fast the car turns."""
        self._move(now)
        left, right = self._wheels()
        return degrees((right - left) / TRACK_M)


def _box(x: float, y: float, width: float, depth: float) -> tuple[Segment, ...]:
    w, d = width / 2, depth / 2
    corners = [(x - w, y - d), (x + w, y - d), (x + w, y + d), (x - w, y + d)]
    return tuple((*a, *b) for a, b in zip(corners, (*corners[1:], corners[0]), strict=True))


def _loop(half_x: float, half_y: float, radius: float) -> list[Point]:
    """A rectangle with round corners, counter-clockwise, from the middle of its lower side."""
    points: list[Point] = [(0.0, -half_y)]
    corners = ((1, -1, -90), (1, 1, 0), (-1, 1, 90), (-1, -1, 180))
    for sx, sy, start in corners:
        cx, cy = sx * (half_x - radius), sy * (half_y - radius)
        for part in range(13):
            angle = radians(start + 90 * part / 12)
            points.append((cx + radius * cos(angle), cy + radius * sin(angle)))
    return points


def _reach(segment: Segment, away: float) -> Segment:
    """The rectangle outside which nothing is within `away` of a segment: low x, low y, high x, high y."""
    x1, y1, x2, y2 = segment
    return min(x1, x2) - away, min(y1, y2) - away, max(x1, x2) + away, max(y1, y2) + away


def _foot(x: float, y: float, segment: Segment) -> Point:
    x1, y1, x2, y2 = segment
    wx, wy = x2 - x1, y2 - y1
    share = min(1.0, max(0.0, ((x - x1) * wx + (y - y1) * wy) / (wx * wx + wy * wy)))
    return x1 + share * wx, y1 + share * wy


def _distance(x: float, y: float, segment: Segment) -> float:
    fx, fy = _foot(x, y, segment)
    return hypot(x - fx, y - fy)

"""One car's body in the `world`: moves by its motors and reads its sensors."""

from math import atan2, ceil, cos, degrees, hypot, pi, radians, sin
from typing import Final

from gateway.sim.model.firmware_base import Pose, Rng
from gateway.sim.model.world import STEP_S, World
from schemas.geometry import Point

TOP_SPEED_M_S: Final = 0.5
"""Speed of a wheel at PWM 255."""
TRACK_M: Final = 0.20
"""Effective distance of the wheels. It is larger than the real one, because four wheels skid in a turn."""

SONAR_AT_M: Final = 0.10
SONAR_REACH_CM: Final = 499.0
"""Just below 500 cm: the car's own program discards a reading of 500 cm or more."""
SONAR_CONE: Final = tuple(radians(degree) for degree in (-15.0, -7.5, 0.0, 7.5, 15.0))
SONAR_STEEPEST: Final = cos(radians(76))
"""Cosine of the largest angle to a surface's normal at which there is an echo. At a larger angle, the sound is
reflected away."""
INFRARED_REACH_M: Final = 0.20
INFRARED_SIDE: Final = radians(20)
# For cars and things. A wall is detected only in the middle of the cone, so that recorded avoidance runs do not change.
INFRARED_CONE: Final = tuple(radians(degree) for degree in (-30.0, -15.0, 0.0, 15.0, 30.0))
LINE_SENSORS: Final = ((0.08, 0.040), (0.08, 0.010), (0.08, -0.010), (0.08, -0.040))
"""Positions ahead and left of the axle's middle, m: left-outer .. right-outer."""
LAMP_SIDE: Final = radians(30)
LAMP_CONE: Final = radians(50)

CUT_OFF_V: Final = 6.4
"""Voltage at which the electronics cut off."""
FLOOR_GRAY: Final = 214
TAPE_GRAY: Final = 740


class CarBody:
    """One car in the world."""

    def __init__(self, world: World, pose: Pose, rng: Rng, now: float = 0.0, name: str = "") -> None:
        self._world = world
        self._name = name
        self._x, self._y, self._heading = pose
        self._now = now
        self._left = self._right = 0
        self._battery = 7.6 + 0.7 * rng.random()
        self._started = now
        self._drain: tuple[float, float] | None = None
        """The time when the battery begins to run empty, and the time when it is empty. None if it does not."""
        world.join(self, now)

    @property
    def name(self) -> str:
        """The name of the car, or an empty text if the world needs none."""
        return self._name

    @property
    def place(self) -> Pose:
        """The pose after the last move."""
        return Pose(self._x, self._y, self._heading)

    @property
    def driving(self) -> bool:
        """True if a motor is on."""
        return self._left != 0 or self._right != 0

    def drive(self, now: float, left: int, right: int) -> None:
        """Set the PWM values of the motors from `now` on."""
        self._move(now)
        self._left, self._right = left, right

    def pose(self, now: float) -> Pose:
        """Return the true pose. Its heading is in -pi..pi."""
        self._move(now)
        return Pose(self._x, self._y, (self._heading + pi) % (2 * pi) - pi)

    def _wheels(self) -> tuple[float, float]:
        return TOP_SPEED_M_S * self._left / 255, TOP_SPEED_M_S * self._right / 255

    def glide(self, now: float) -> None:
        """Move as far as there is room until `now`, which is at most one tick after the last move.

        For a lively world only (see `World.lively`).
        """
        span = now - self._now
        if span <= 0:
            return
        self._now = now
        x, y = self._x, self._y
        if self.driving:
            x, y, heading = self._driven(span)
        elif not self._world.things:
            return
        else:
            heading = self._heading
        self._x, self._y = self._world.make_room(self, x, y, now)
        self._heading = heading

    def _move(self, now: float) -> None:
        if self._world.lively:
            self._world.settle(now)
            self.glide(now)
            return
        span = now - self._now
        if span <= 0:
            return
        self._now = now
        if self._left == self._right == 0:
            return
        left, right = self._wheels()
        steps = 1 if left + right == 0 else ceil(span / STEP_S)
        step = span / steps
        for _ in range(steps):
            x, y, self._heading = self._driven(step)
            self._x, self._y = self._world.push_out(x, y)

    def _driven(self, span: float) -> tuple[float, float, float]:
        """Return x, y and heading after this time if nothing is in the way."""
        left, right = self._wheels()
        speed, turn = (left + right) / 2, (right - left) / TRACK_M
        heading = self._heading + turn * span
        if abs(turn) < 1e-9:
            return self._x + speed * span * cos(heading), self._y + speed * span * sin(heading), heading
        radius = speed / turn
        x = self._x + radius * (sin(heading) - sin(self._heading))
        y = self._y - radius * (cos(heading) - cos(self._heading))
        return x, y, heading

    def _look(self, now: float) -> None:
        """Move this car on to `now`, and in a lively world all cars."""
        self._move(now)
        if self._world.lively:
            for other in self._world.bodies:
                other.glide(now)

    def _at(self, ahead: float, left: float) -> Point:
        c, s = cos(self._heading), sin(self._heading)
        return self._x + ahead * c - left * s, self._y + ahead * s + left * c

    def range_cm(self, now: float, bearing_deg: float) -> float | None:
        """Return the distance of the nearest echo within the cone, from the sensor at the car's front."""
        self._look(now)
        x, y = self._at(SONAR_AT_M, 0.0)
        middle = self._heading + radians(bearing_deg)
        rays = (self._echo(x, y, middle + offset, now) for offset in SONAR_CONE)
        nearest = min((distance for distance in rays if distance is not None), default=None)
        return None if nearest is None or nearest * 100 > SONAR_REACH_CM else nearest * 100

    def _echo(self, x: float, y: float, angle: float, now: float) -> float | None:
        """Return the distance from which a beam of sound returns. None without echo."""
        wall = self._world.ray(x, y, angle, SONAR_STEEPEST)
        if not self._world.lively:
            return wall
        # A wall that reflects the sound away still hides everything behind it.
        first = self._world.ray(x, y, angle)
        hit = self._world.met(self, x, y, angle, SONAR_REACH_CM / 100 if first is None else first, now)
        if hit is None:
            return wall
        return hit[0] if hit[1] >= SONAR_STEEPEST else None

    def line(self, now: float) -> tuple[bool, bool, bool, bool]:
        """Return one value for each of the four line sensors: True if it sees the line."""
        self._move(now)
        if not self._world.line:
            return (False, False, False, False)
        seen = [self._world.on_line(*self._at(ahead, left)) for ahead, left in LINE_SENSORS]
        return (seen[0], seen[1], seen[2], seen[3])

    def obstacle(self, now: float) -> tuple[bool, bool]:
        """Return one value for each infrared sensor, turned 20 degrees outward: True if it sees an obstacle."""
        self._look(now)
        seen = []
        for side in (1, -1):
            x, y = self._at(0.10, 0.06 * side)
            middle = self._heading + side * INFRARED_SIDE
            distance = self._world.ray(x, y, middle)
            sees = distance is not None and distance <= INFRARED_REACH_M
            if self._world.lively and not sees:
                sees = any(self._glimpse(x, y, middle + offset, now) for offset in INFRARED_CONE)
            seen.append(sees)
        return (seen[0], seen[1])

    def _glimpse(self, x: float, y: float, angle: float, now: float) -> bool:
        """Return True if a car or a thing reflects infrared light, with no wall in front of it."""
        hit = self._world.met(self, x, y, angle, INFRARED_REACH_M, now)
        if hit is None:
            return False
        wall = self._world.ray(x, y, angle)
        return wall is None or hit[0] <= wall

    def light(self, now: float) -> tuple[bool, bool]:
        """Return one value for the left and one for the right light sensor: True if it sees a lamp."""
        self._look(now)
        seen = [False, False]
        for lamp in self._world.lamps:
            if not lamp.on or (lamp.carried_by and lamp.carried_by == self._name):
                continue
            at = self._world.shines(lamp, now)
            if at is None:
                continue
            dx, dy = at[0] - self._x, at[1] - self._y
            if hypot(dx, dy) > lamp.seen_from_m or not (
                lamp.overhead or self._world.clear((self._x, self._y), at, {self._name, lamp.carried_by}, now=now)
            ):
                continue
            bearing = atan2(dy, dx) - self._heading
            for index, side in enumerate((LAMP_SIDE, -LAMP_SIDE)):
                off = (bearing - side + pi) % (2 * pi) - pi
                seen[index] = seen[index] or abs(off) <= LAMP_CONE
        return (seen[0], seen[1])

    def grayscale(self, now: float) -> int:
        """Return the grayscale of the floor under the car's middle. It is higher on the tape."""
        self._move(now)
        return TAPE_GRAY if self._world.line and self._world.on_line(self._x, self._y) else FLOOR_GRAY

    def battery_v(self, now: float) -> float:
        """Return the battery voltage, at least CUT_OFF_V."""
        # It falls by 0.3 V per hour, and by up to 0.25 V under load.
        load = 0.25 * (abs(self._left) + abs(self._right)) / 510
        volts = self._battery - 0.3 * (now - self._started) / 3600 - load
        if self._drain is not None:
            begin, end = self._drain
            volts -= (volts - CUT_OFF_V) * min(1.0, (now - begin) / max(end - begin, 1e-9))
        return max(CUT_OFF_V, volts)

    def drain(self, now: float, in_s: float) -> None:
        """Let the battery run empty within a time."""
        self._drain = now, now + in_s

    def yaw_rate_deg_s(self, now: float) -> float:
        """Return the yaw rate."""
        self._move(now)
        left, right = self._wheels()
        return degrees((right - left) / TRACK_M)

"""Where the cars are, and the floor under them, as a map shows it. Pure.

The place of a simulated car is the truth from its simulator. The place of a real car is what somebody has measured
(`sensor/pose`). A car without either has no place, because commands do not tell where a car is. Times: s of one clock,
which the caller chooses.
"""

import math
from collections import deque
from collections.abc import Container, Iterable
from typing import Any, Final

from msgspec import Struct, field

from schemas.topics import TOPICS

TRUTH: Final = TOPICS["sim/truth"]
POSE: Final = TOPICS["sensor/pose"]
WORLD: Final = TOPICS["@sim/world"]
PLACE_TOPICS: Final = (TRUTH.name, POSE.name)
TRAIL_S: Final = 30.0
"""Length of a trail (the recent path of a car), live and at a moment of a recording."""
TRAIL_STEP_S: Final = 0.25
"""Minimum time between two points of a trail."""
TRAIL_STEP_M: Final = 0.01
"""Minimum distance between two points of a trail, so that a car that stands still adds none."""
SHOWN_S: Final = 30.0
"""Time for which the last place of a car is shown, with its age."""
MAX_CORNERS: Final = 2000
"""Maximum number of walls, corners of the line, and things of a floor. A world file may have a tenth of each."""
_MAX_MAP_NAME_LENGTH: Final = 64
_Points = list[tuple[int, float, float]]


class Place(Struct, frozen=True):
    """One known place of a car. `frame` is empty for the truth about a simulated car."""

    x_m: float
    y_m: float
    heading_rad: float
    frame: str
    at: float
    xy_std_m: float | None = None

    @property
    def is_true(self) -> bool:
        """True if the place comes from a simulator, False if somebody measured it."""
        return not self.frame

    def is_stale(self, now: float) -> bool:
        """Return True if a newer place should have come by now."""
        return now - self.at > ((TRUTH if self.is_true else POSE).stale_after_s or math.inf)


class MapView(Struct):
    """The newest place of each car with its trail, and the newest floor."""

    _places: dict[str, Place] = field(default_factory=dict)
    _trails: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)
    _world: Any = None
    _world_at: float = -math.inf

    def on_message(self, car: str, topic: str, message: Any, at: float) -> None:
        """Handle a message of PLACE_TOPICS, or the world. Other messages change nothing."""
        match topic:
            case TRUTH.name:
                self._put(car, Place(message.x_m, message.y_m, message.heading_rad, "", at))
            case POSE.name:
                before = self._places.get(car)
                if before is not None and before.is_true and not before.is_stale(at):
                    return  # the truth from a simulator is better than any measurement
                std = message.xy_std_m if message.HasField("xy_std_m") else None
                frame = message.frame[:_MAX_MAP_NAME_LENGTH] or "map"
                self._put(car, Place(message.x_m, message.y_m, message.heading_rad, frame, at, std))
            case WORLD.name:
                self._world, self._world_at = message, at
            case _:
                return

    def _put(self, car: str, place: Place) -> None:
        before = self._places.get(car)
        self._places[car] = place
        if before is not None and before.frame != place.frame:
            self._trails.pop(car, None)  # the new place has another origin
        trail = self._trails.setdefault(car, deque())
        while trail and abs(place.at - trail[0][0]) > TRAIL_S:  # `abs`, because the clock may be set back
            trail.popleft()
        if trail:
            at, x_m, y_m = trail[-1]
            if place.at - at < TRAIL_STEP_S or math.hypot(place.x_m - x_m, place.y_m - y_m) < TRAIL_STEP_M:
                return
        trail.append((place.at, place.x_m, place.y_m))

    def keep(self, cars: Container[str]) -> None:
        """Forget all cars but these: anybody on the bus may invent some."""
        for found in (self._places, self._trails):
            for car in [car for car in found if car not in cars]:
                del found[car]

    def places(self, now: float) -> dict[str, list[Any]]:
        """Return the place of each car as JSON: x, y (m), heading (rad), frame, error of x, y (m), age if stale (s)."""
        return {
            car: [
                round(place.x_m, 3),
                round(place.y_m, 3),
                round(place.heading_rad, 3),
                place.frame,
                None if place.xy_std_m is None else round(place.xy_std_m, 3),
                int(now - place.at) if place.is_stale(now) else None,
            ]
            for car, place in sorted(self._places.items())
            if now - place.at <= SHOWN_S
        }

    def trails(self, now: float, since: float = -math.inf) -> dict[str, _Points]:
        """Return the points of each car's trail after a time. A point is its time (ms), x and y (m)."""
        begin = max(since, now - TRAIL_S)
        found = {
            car: [(round(at * 1e3), round(x_m, 3), round(y_m, 3)) for at, x_m, y_m in trail if at > begin]
            for car, trail in sorted(self._trails.items())
        }
        return {car: points for car, points in found.items() if points}

    def world(self, now: float) -> dict[str, Any] | None:
        """Return the floor of a simulation as JSON values, or None if no simulation has reported it lately."""
        world = self._world
        if world is None or now - self._world_at > (WORLD.stale_after_s or math.inf):
            return None
        return {
            "walls": [
                [wall.begin.x_m, wall.begin.y_m, wall.end.x_m, wall.end.y_m] for wall in world.walls[:MAX_CORNERS]
            ],
            "line": [[point.x_m, point.y_m] for point in world.line[:MAX_CORNERS]],
            "lamps": [
                [lamp.name[:_MAX_MAP_NAME_LENGTH], round(lamp.x_m, 3), round(lamp.y_m, 3), lamp.on]
                for lamp in world.lamps[:MAX_CORNERS]
            ],
            "things": [
                [thing.name[:_MAX_MAP_NAME_LENGTH], *(round(each, 3) for each in _shape(thing))]
                for thing in world.things[:MAX_CORNERS]
            ],
        }


def _shape(thing: Any) -> Iterable[float]:
    """Return x, y, heading, radius, width and depth of a thing. If the radius is 0, the thing is a box."""
    return thing.x_m, thing.y_m, thing.heading_rad, thing.radius_m, thing.width_m, thing.depth_m

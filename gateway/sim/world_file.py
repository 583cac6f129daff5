"""Builds a world from a world file, after `schemas.world_check` has checked the file. Pure.

Distances in meters, speeds in m/s, angles in the file in degrees counter-clockwise from x. The fields are in
`schemas.world_fields`.
"""

from collections.abc import Mapping, Sequence
from math import radians

from msgspec import Struct

from gateway.sim.model.firmware_base import Pose
from gateway.sim.model.objects import Lamp, MovingObject
from gateway.sim.model.world import World
from schemas.geometry import Point, Segment, loop
from schemas.world_check import check_world, walls_of
from schemas.world_fields import LineEntry, ThingEntry


class WorldSpec(Struct, frozen=True):
    """The content of a world file. A World changes while it runs, so each run creates a new one from this."""

    walls: tuple[Segment, ...]
    line: tuple[Point, ...]
    lamps: tuple[Lamp, ...]
    things: tuple[MovingObject, ...]
    starts: Mapping[str, Pose]
    cars_meet: bool

    def world(self) -> World:
        """Return a new world."""
        return World(
            self.walls, self.line, self.lamps, things=self.things, starts=self.starts, cars_meet=self.cars_meet
        )


def read_world(text: str, source: str, cars: Sequence[str] | None = None) -> WorldSpec:
    """Return the world in a text. Raises BadFile with every fault, if any (see `check_world`)."""
    entry = check_world(text, source, cars)
    return WorldSpec(
        walls_of(entry),
        _line(entry.line),
        tuple(Lamp(name=name, **each.model_dump()) for name, each in entry.lamps.items()),
        tuple(_thing(name, each) for name, each in entry.things.items()),
        {name: Pose(each.x_m, each.y_m, radians(each.heading_deg)) for name, each in entry.cars.items()},
        cars_meet=entry.cars_meet,
    )


def _line(line: Sequence[Point] | LineEntry) -> tuple[Point, ...]:
    if isinstance(line, LineEntry):
        return tuple(loop(line.width_m / 2, line.depth_m / 2, line.radius_m))
    return tuple(line)


def _thing(name: str, entry: ThingEntry) -> MovingObject:
    path = tuple(entry.path)
    back = path[-2:0:-1]  # without both ends, which are in `path` once
    return MovingObject(
        name,
        entry.x_m,
        entry.y_m,
        radius_m=entry.radius_m,
        width_m=entry.width_m,
        depth_m=entry.depth_m,
        heading_rad=radians(entry.heading_deg),
        path=(*path, *back) if entry.there_and_back else path,
        speed_m_s=entry.speed_m_s,
        waits_for_m=entry.waits_for_m,
        carried_by=entry.carried_by,
    )

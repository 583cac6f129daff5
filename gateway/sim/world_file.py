"""Reads a world file (YAML 1.2) and checks what no single field shows: shapes, places and carriers. Pure.

Distances in meters, speeds in m/s, angles in degrees counter-clockwise from x. schemas/world.py
has the fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import hypot, radians
from typing import Final

from gateway.sim.model.firmware import Pose
from gateway.sim.model.geometry import Point, Segment, box, distance, loop
from gateway.sim.model.objects import Lamp, MovingObject
from gateway.sim.model.world import RADIUS_M, World
from schemas.world import LampEntry, LineEntry, ThingEntry, WorldEntry
from schemas.yaml_document.document import Document, Entry
from schemas.yaml_document.messages import Where

MIN_SIZE_M: Final = 0.02
"""Minimum length of a wall."""


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """The content of a world file. A World changes while it runs, so each run creates its own."""

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
    """Return the world in a text; raise BadFile with every fault.

    `source`: the name of the file in errors. `cars`: the cars that can carry something; None: any car.
    """
    document = Document(text, source)
    # Other faults are searched in what remains without the faulty values.
    entry = document.validate(WorldEntry) or document.validate_partial(WorldEntry, {})
    spec = _WorldParser(document, entry, cars).read() if entry is not None else None
    document.raise_faults()
    assert spec is not None  # else there was a fault
    return spec


class _WorldParser:
    def __init__(self, document: Document, entry: WorldEntry, cars: Sequence[str] | None) -> None:
        self._document = document
        self._entry = entry
        self._cars = cars

    def read(self) -> WorldSpec:
        entry = self._entry
        walls: list[Segment] = []
        if "room" in entry.model_fields_set:
            walls += box(0.0, 0.0, entry.room.width_m, entry.room.depth_m)
        for each in entry.boxes:
            walls += box(each.x_m, each.y_m, each.width_m, each.depth_m)
        for index, (x1, y1, x2, y2) in enumerate(entry.walls):
            walls.append((x1, y1, x2, y2))
            if hypot(x2 - x1, y2 - y1) < MIN_SIZE_M:
                self._document.report(("walls", index), f"is shorter than {MIN_SIZE_M:g} m: write [x1, y1, x2, y2]")
        line = self._line()
        things = tuple(self._thing(name, each) for name, each in entry.things.items())
        lamps = tuple(self._lamp(name, each) for name, each in entry.lamps.items())
        starts = {name: Pose(each.x_m, each.y_m, radians(each.heading_deg)) for name, each in entry.cars.items()}
        self._check_starts(starts, walls, things)
        return WorldSpec(tuple(walls), line, lamps, things, starts, cars_meet=entry.cars_meet)

    def _given(self, where: Where, entry: Entry) -> set[str]:
        """Return the names of the fields in the file, also of those with a faulty value."""
        faulty = {name for name in type(entry).model_fields if self._document.is_faulty((*where, name))}
        return entry.model_fields_set | faulty

    def _line(self) -> tuple[Point, ...]:
        line = self._entry.line
        if isinstance(line, LineEntry):
            most = min(line.width_m, line.depth_m) / 2
            if line.radius_m > most:
                words = f"{line.radius_m:g} is not allowed: up to half of the shorter side, {most:g}"
                self._document.report(("line", "radius_m"), words)
            return tuple(loop(line.width_m / 2, line.depth_m / 2, line.radius_m))
        if line and len(set(line)) < 3:
            self._document.report(("line",), "is a closed loop: at least 3 points [x, y]")
        return tuple(line)

    def _thing(self, name: str, entry: ThingEntry) -> MovingObject:
        report, where = self._document.report, ("things", name)
        given = self._given(where, entry)
        sides = {"width_m", "depth_m"} & given
        if ("radius_m" in given) == bool(sides):
            report(where, "is a disc or a box: write radius_m, or width_m and depth_m")
        elif len(sides) == 1:
            report((*where, "depth_m" if "width_m" in given else "width_m"), "is missing: a box has both")
        path = tuple(entry.path)
        if path and len(set(path)) < 2:
            report((*where, "path"), "has at least 2 points [x, y] that differ")
        if entry.there_and_back:
            path = (*path, *path[-2:0:-1])
        for other in ("x_m", "y_m", "carried_by"):
            if {"path", other} <= given:
                report((*where, other), "is not allowed beside a path: the path gives its place")
        for other in ("speed_m_s", "there_and_back", "waits_for_m"):
            if "path" not in given and other in given:
                report((*where, other), "is not allowed without a path")
        if "path" not in given:
            self._check_place(where, given, "where it stands, or a path, or carried_by")
        if entry.carried_by:
            self._check_carrier(where, entry.carried_by)
        return MovingObject(
            name,
            entry.x_m,
            entry.y_m,
            radius_m=entry.radius_m,
            width_m=entry.width_m,
            depth_m=entry.depth_m,
            heading_rad=radians(entry.heading_deg),
            path=path,
            speed_m_s=entry.speed_m_s,
            waits_for_m=entry.waits_for_m,
            carried_by=entry.carried_by,
        )

    def _lamp(self, name: str, entry: LampEntry) -> Lamp:
        where = ("lamps", name)
        self._check_place(where, self._given(where, entry), "where it stands, or carried_by")
        if entry.carried_by and not self._is_thing(entry.carried_by):
            self._check_carrier(where, entry.carried_by)
        return Lamp(name=name, **entry.model_dump())

    def _is_thing(self, name: str) -> bool:
        return name in self._entry.things or self._document.is_faulty(("things", name))

    def _check_place(self, where: Where, given: set[str], needed: str) -> None:
        for name in ("x_m", "y_m"):
            if not {name, "carried_by"} & given:
                self._document.report((*where, name), f"is missing: {needed}")

    def _check_carrier(self, where: Where, name: str) -> None:
        if self._cars is not None and name not in self._cars:
            words = f"no car or thing {name!r} is simulated here: use {', '.join(self._cars) or 'a --car'}"
            self._document.report((*where, "carried_by"), words)

    def _check_starts(
        self, starts: Mapping[str, Pose], walls: Sequence[Segment], things: Sequence[MovingObject]
    ) -> None:
        report, room, boxes = self._document.report, self._entry.room, self._entry.boxes
        # A thing with a fault of its own may not be where the file wants it.
        solid = [each for each in things if not (each.carried_by or self._is_faulty(("things", each.name)))]
        for name, pose in starts.items():
            x, y, where = pose.x_m, pose.y_m, ("cars", name)
            inside = any(abs(x - b.x_m) < b.width_m / 2 and abs(y - b.y_m) < b.depth_m / 2 for b in boxes)
            if "room" in self._entry.model_fields_set and (abs(x) > room.width_m / 2 or abs(y) > room.depth_m / 2):
                report(where, "begins outside the room")
            elif inside or any(distance(x, y, wall) < RADIUS_M for wall in walls):
                report(where, f"begins in a wall: at least {RADIUS_M:g} m from each")
            for thing in solid:
                if thing.depth(thing.pose(0.0), x, y, RADIUS_M) > 0:
                    report(where, f"begins in {thing.name}, a thing: at least {RADIUS_M:g} m from it")
        for (one, first), (other, second) in combinations(starts.items(), 2):
            away = hypot(first.x_m - second.x_m, first.y_m - second.y_m)
            if self._entry.cars_meet and away < 2 * RADIUS_M:
                words = f"begins {away:.2g} m from {one}: at least {2 * RADIUS_M:g} m, or write cars_meet: false"
                report(("cars", other), words)

    def _is_faulty(self, where: Where) -> bool:
        return self._document.is_faulty(where) or self._document.faulty_within(where)

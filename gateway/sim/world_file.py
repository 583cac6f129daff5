"""Reads a world file (YAML 1.2): checks its fields, their ranges, and contradictions between them. Pure.

Distances in meters, speeds in m/s, angles in degrees counter-clockwise from x. schemas/world.py
has the fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import hypot, radians
from typing import Final

import yaml

from gateway.sim.model.firmware import Pose
from gateway.sim.model.geometry import Point, Segment, box, distance, loop
from gateway.sim.model.objects import FAR_M, FASTEST_M_S, Lamp, MovingObject
from gateway.sim.model.world import RADIUS_M, World
from gateway.sim.yaml_reader import MarkedYaml
from schemas import keys
from schemas.world import BoxEntry, LampEntry, LineEntry, RoomEntry, StartEntry, ThingEntry, WorldEntry
from schemas.yaml_document.document import Entry

MIN_SIZE_M: Final = 0.02
MAX_ITEMS: Final = 200
"""Maximum of walls, boxes, things or lamps, and of the points of a path or line."""


def _fields(entry: type[Entry]) -> dict[str, bool]:
    """Return the names of the fields of an entry, True for a required one."""
    return {name: field.is_required() for name, field in entry.model_fields.items()}


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
    """Return the world in a text; raise BadWorld with every fault.

    `source`: the name of the file in errors. `cars`: the cars that can carry something; None: any car.
    """
    return _WorldParser(MarkedYaml(text, source), cars).read()


class _WorldParser:
    def __init__(self, marks: MarkedYaml, cars: Sequence[str] | None) -> None:
        self._marks = marks
        self._cars = cars
        self._walls: list[Segment] = []
        self._boxes: list[tuple[float, float, float, float]] = []
        self._room: tuple[float, float] | None = None

    def read(self) -> WorldSpec:
        marks = self._marks
        top = marks.fields(marks.root, "", _fields(WorldEntry))
        if "room" in top:
            parts = marks.fields(top["room"], "room", _fields(RoomEntry))
            room = self._size(parts, "width_m", "room"), self._size(parts, "depth_m", "room")
            if not marks.faulty:  # otherwise every car would start outside the room as well
                self._room = room
                self._walls += box(0.0, 0.0, *room)
        for field, node in self._few(top, "boxes"):
            parts = marks.fields(node, field, _fields(BoxEntry))
            x, y = self._place(parts, "x_m", field), self._place(parts, "y_m", field)
            self._boxes.append((x, y, self._size(parts, "width_m", field), self._size(parts, "depth_m", field)))
            self._walls += box(*self._boxes[-1])
        for field, node in self._few(top, "walls"):
            wall = marks.numbers(node, field, 4, -FAR_M, FAR_M)
            if wall is None:
                continue
            x1, y1, x2, y2 = wall
            if hypot(x2 - x1, y2 - y1) >= MIN_SIZE_M:
                self._walls.append((x1, y1, x2, y2))
            else:
                marks.complain(node, field, f"is shorter than {MIN_SIZE_M:g} m: write [x1, y1, x2, y2]")
        line = self._line(top["line"]) if "line" in top else ()
        things = {name: self._thing(name, node) for name, node in self._named(top, "things").items()}
        lamps = tuple(self._lamp(name, node, things) for name, node in self._named(top, "lamps").items())
        meet = marks.yes(top["cars_meet"], "cars_meet") if "cars_meet" in top else True
        starts = self._starts(top, tuple(things.values()), meet=meet)
        marks.end()
        return WorldSpec(tuple(self._walls), line, lamps, tuple(things.values()), starts, cars_meet=meet)

    # Parts.

    def _line(self, node: yaml.Node) -> tuple[Point, ...]:
        marks = self._marks
        if isinstance(node, yaml.SequenceNode):
            points = self._points(node, "line")
            if len(set(points)) < 3:
                marks.complain(node, "line", "is a closed loop: at least 3 points [x, y]")
            return points
        parts = marks.fields(node, "line", _fields(LineEntry))
        width, depth, radius = (self._size(parts, name, "line") for name in ("width_m", "depth_m", "radius_m"))
        if radius > min(width, depth) / 2:
            marks.complain(
                parts.get("radius_m", node),
                "line.radius_m",
                f"{radius:g} is not allowed: up to half of the shorter side, {min(width, depth) / 2:g}",
            )
        return tuple(loop(width / 2, depth / 2, radius))

    def _thing(self, name: str, node: yaml.Node) -> MovingObject:
        marks, field = self._marks, f"things.{name}"
        parts = marks.fields(node, field, _fields(ThingEntry))
        disc, boxed = "radius_m" in parts, {"width_m", "depth_m"} <= parts.keys()
        if isinstance(node, yaml.MappingNode) and disc == bool({"width_m", "depth_m"} & parts.keys()):
            marks.complain(node, field, "is a disc or a box: write radius_m, or width_m and depth_m")
        elif isinstance(node, yaml.MappingNode) and not disc and not boxed:
            lacks = "depth_m" if "width_m" in parts else "width_m"
            marks.complain(node, f"{field}.{lacks}", "is missing: a box has both")
        path = self._points(parts["path"], f"{field}.path") if "path" in parts else ()
        if "path" in parts and len(set(path)) < 2:
            marks.complain(parts["path"], f"{field}.path", "has at least 2 points [x, y] that differ")
        if "there_and_back" in parts and marks.yes(parts["there_and_back"], f"{field}.there_and_back"):
            path = (*path, *path[-2:0:-1])
        for other in ("x_m", "y_m", "carried_by"):
            if "path" in parts and other in parts:
                marks.complain(parts[other], f"{field}.{other}", "is not allowed beside a path, which is where it is")
        for other in ("speed_m_s", "there_and_back", "waits_for_m"):
            if "path" not in parts and other in parts:
                marks.complain(parts[other], f"{field}.{other}", "is not allowed without a path")
        if "path" not in parts and "carried_by" not in parts and isinstance(node, yaml.MappingNode):
            for other in ("x_m", "y_m"):
                if other not in parts:
                    marks.complain(node, f"{field}.{other}", "is missing: where it stands, or a path, or carried_by")
        speed, waits = (
            marks.number(parts[each], f"{field}.{each}", 0, most) if each in parts else 0.0
            for each, most in (("speed_m_s", FASTEST_M_S), ("waits_for_m", FAR_M))
        )
        return MovingObject(
            name,
            self._place(parts, "x_m", field),
            self._place(parts, "y_m", field),
            radius_m=self._size(parts, "radius_m", field) if disc else 0.0,
            width_m=self._size(parts, "width_m", field) if boxed else 0.0,
            depth_m=self._size(parts, "depth_m", field) if boxed else 0.0,
            heading_rad=self._heading(parts, field),
            path=path,
            speed_m_s=speed,
            waits_for_m=waits,
            carried_by=self._carrier(parts["carried_by"], f"{field}.carried_by") if "carried_by" in parts else "",
        )

    def _lamp(self, name: str, node: yaml.Node, things: Mapping[str, MovingObject]) -> Lamp:
        marks, field = self._marks, f"lamps.{name}"
        parts = marks.fields(node, field, _fields(LampEntry))
        carried_by = ""
        if "carried_by" in parts:
            carried_by = marks.word(parts["carried_by"], f"{field}.carried_by")
            if carried_by not in things:
                carried_by = self._carrier(parts["carried_by"], f"{field}.carried_by")
        elif isinstance(node, yaml.MappingNode):
            for other in ("x_m", "y_m"):
                if other not in parts:
                    marks.complain(node, f"{field}.{other}", "is missing: where it stands, or carried_by")
        reach = marks.number(parts["reach_m"], f"{field}.reach_m", 0, FAR_M, above=True) if "reach_m" in parts else 1.5
        bright = marks.number(parts["brightness"], f"{field}.brightness", 0, 100) if "brightness" in parts else 1.0
        return Lamp(
            self._place(parts, "x_m", field),
            self._place(parts, "y_m", field),
            reach_m=reach,
            brightness=bright,
            on=marks.yes(parts["on"], f"{field}.on") if "on" in parts else True,
            overhead="overhead" in parts and marks.yes(parts["overhead"], f"{field}.overhead"),
            name=name,
            carried_by=carried_by,
        )

    def _starts(self, top: Mapping[str, yaml.Node], things: tuple[MovingObject, ...], *, meet: bool) -> dict[str, Pose]:
        marks, found, nodes = self._marks, {}, self._named(top, "cars")
        for name, node in nodes.items():
            field = f"cars.{name}"
            parts = marks.fields(node, field, _fields(StartEntry))
            x, y = (self._place(parts, at, field) for at in ("x_m", "y_m"))
            pose = Pose(x, y, self._heading(parts, field))
            if not parts.keys() >= {"x_m", "y_m"}:
                continue
            found[name] = pose
            inside = any(abs(x - bx) < w / 2 and abs(y - by) < d / 2 for bx, by, w, d in self._boxes)
            if self._room is not None and (abs(x) > self._room[0] / 2 or abs(y) > self._room[1] / 2):
                marks.complain(node, field, "begins outside the room")
            elif inside or any(distance(x, y, wall) < RADIUS_M for wall in self._walls):
                marks.complain(node, field, f"begins in a wall: at least {RADIUS_M:g} m from each")
            for thing in things:
                at = thing.pose(0.0)
                # A thing without an extent has a fault of its own.
                if thing.extent_m and not thing.carried_by and thing.depth(at, pose.x_m, pose.y_m, RADIUS_M) > 0:
                    marks.complain(node, field, f"begins in {thing.name}, a thing: at least {RADIUS_M:g} m from it")
        for (one, first), (other, second) in combinations(found.items(), 2):
            away = hypot(first.x_m - second.x_m, first.y_m - second.y_m)
            if meet and away < 2 * RADIUS_M:
                words = f"begins {away:.2g} m from {one}: at least {2 * RADIUS_M:g} m, or write cars_meet: false"
                marks.complain(nodes[other], f"cars.{other}", words)
        return found

    # Values.

    def _few(self, top: Mapping[str, yaml.Node], name: str) -> list[tuple[str, yaml.Node]]:
        items = self._marks.items(top[name], name) if name in top else []
        if len(items) > MAX_ITEMS:
            self._marks.complain(items[MAX_ITEMS][1], name, f"has {len(items)} of them: at most {MAX_ITEMS}")
        return items[:MAX_ITEMS]

    def _named(self, top: Mapping[str, yaml.Node], name: str) -> dict[str, yaml.Node]:
        found = self._marks.entries(top[name], name) if name in top else {}
        if len(found) > MAX_ITEMS:
            self._marks.complain(top[name], name, f"has {len(found)} of them: at most {MAX_ITEMS}")
        for each, node in found.items():
            try:
                keys.check_name(each, "name")
            except keys.BadKey as error:
                self._marks.complain(node, name, str(error))
        return dict(list(found.items())[:MAX_ITEMS])

    def _points(self, node: yaml.Node, field: str) -> tuple[Point, ...]:
        items = self._marks.items(node, field)
        if len(items) > MAX_ITEMS:
            self._marks.complain(items[MAX_ITEMS][1], field, f"has {len(items)} points: at most {MAX_ITEMS}")
        points = []
        for name, each in items[:MAX_ITEMS]:
            point = self._marks.numbers(each, name, 2, -FAR_M, FAR_M)
            if point is not None:
                points.append((point[0], point[1]))
        return tuple(points)

    def _place(self, parts: Mapping[str, yaml.Node], name: str, field: str) -> float:
        return self._marks.number(parts[name], f"{field}.{name}", -FAR_M, FAR_M) if name in parts else 0.0

    def _size(self, parts: Mapping[str, yaml.Node], name: str, field: str) -> float:
        if name not in parts:
            return 1.0  # `fields` has reported it
        return self._marks.number(parts[name], f"{field}.{name}", MIN_SIZE_M, FAR_M)

    def _heading(self, parts: Mapping[str, yaml.Node], field: str) -> float:
        if "heading_deg" not in parts:
            return 0.0
        return radians(self._marks.number(parts["heading_deg"], f"{field}.heading_deg", -360, 360))

    def _carrier(self, node: yaml.Node, field: str) -> str:
        name = self._marks.word(node, field)
        if name and self._cars is not None and name not in self._cars:
            words = f"no car or thing {name!r} is simulated here: use {', '.join(self._cars) or 'a --car'}"
            self._marks.complain(node, field, words)
        return name

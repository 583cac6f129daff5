"""Checks a world file (YAML 1.2): each field alone, then how the fields fit together. Pure.

Distances in meters, speeds in m/s, angles in degrees counter-clockwise from x. `world_fields` has the fields. The
simulator builds a world from a file that passes. `fleet check` only reports whether it passes.
"""

from collections.abc import Sequence
from itertools import combinations
from math import hypot, radians
from typing import Final

from schemas.geometry import RADIUS_M, Point, Segment, box, distance, in_turned_box, turned_box
from schemas.world_fields import LampEntry, LineEntry, ThingEntry, WorldEntry
from schemas.yaml_document.document import Document, Entry
from schemas.yaml_document.fault_words import Where

MIN_SIZE_M: Final = 0.02
"""Minimum length of a wall."""


def check_world(text: str, source: str, cars: Sequence[str] | None = None) -> WorldEntry:
    """Return the fields of the world in a text. Raises BadFile with every fault, if any.

    `source` is the name of the file in errors. `cars` are the cars that can carry something. With None, any car can.
    """
    document = Document(text, source)
    # Look for further faults in the values that are valid.
    entry = document.validate(WorldEntry) or document.validate_partial(WorldEntry, {})
    if entry is not None:
        _WorldCheck(document, entry, cars).check()
    document.raise_faults()
    assert entry is not None  # else there was a fault
    return entry


def walls_of(entry: WorldEntry) -> tuple[Segment, ...]:
    """Return the walls of a world: those of its room and its boxes, then the single ones."""
    room = entry.room if "room" in entry.model_fields_set else None
    found = [] if room is None else list(box(0.0, 0.0, room.width_m, room.depth_m))
    for each in entry.boxes:
        found += box(each.x_m, each.y_m, each.width_m, each.depth_m)
    return (*found, *entry.walls)


class _WorldCheck:
    """Reports the faults of one world to its document."""

    def __init__(self, document: Document, entry: WorldEntry, cars: Sequence[str] | None) -> None:
        self._document = document
        self._entry = entry
        self._cars = cars

    def check(self) -> None:
        for index, (x1, y1, x2, y2) in enumerate(self._entry.walls):
            if hypot(x2 - x1, y2 - y1) < MIN_SIZE_M:
                words = f"is shorter than {MIN_SIZE_M:g} m (a wall is [x1, y1, x2, y2])"
                self._document.report(("walls", index), words)
        self._check_line()
        for name, thing in self._entry.things.items():
            self._check_thing(name, thing)
        for name, lamp in self._entry.lamps.items():
            self._check_lamp(name, lamp)
        self._check_starts()

    def _given(self, where: Where, entry: Entry) -> set[str]:
        """Return the names of the fields that the file has, including fields with a faulty value."""
        faulty = {name for name in type(entry).model_fields if self._document.is_faulty((*where, name))}
        return entry.model_fields_set | faulty

    def _check_line(self) -> None:
        line = self._entry.line
        if isinstance(line, LineEntry):
            most = min(line.width_m, line.depth_m) / 2
            if line.radius_m > most:
                words = f"{line.radius_m:g} is not allowed: up to half of the shorter side, {most:g}"
                self._document.report(("line", "radius_m"), words)
        elif line and len(set(line)) < 3:
            self._document.report(("line",), "needs at least 3 different points [x, y], because it is a closed loop")

    def _check_thing(self, name: str, entry: ThingEntry) -> None:
        report, where = self._document.report, ("things", name)
        given = self._given(where, entry)
        sides = {"width_m", "depth_m"} & given
        if ("radius_m" in given) == bool(sides):
            report(where, "must be a disc or a box: write radius_m, or width_m and depth_m")
        elif len(sides) == 1:
            report((*where, "depth_m" if "width_m" in given else "width_m"), "is missing: a box needs both")
        if entry.path and len(set(entry.path)) < 2:
            report((*where, "path"), "needs at least 2 different points [x, y]")
        for other in ("x_m", "y_m", "carried_by"):
            if {"path", other} <= given:
                report((*where, other), "is not allowed beside a path: the path gives its place")
        for other in ("speed_m_s", "there_and_back", "waits_for_m"):
            if "path" not in given and other in given:
                report((*where, other), "is not allowed without a path")
        if "path" not in given:
            self._check_place(where, given, "write where it stands, or a path, or carried_by")
        if entry.carried_by:
            self._check_carrier(where, entry.carried_by, "car")

    def _check_lamp(self, name: str, entry: LampEntry) -> None:
        where = ("lamps", name)
        self._check_place(where, self._given(where, entry), "write where it stands, or carried_by")
        if entry.carried_by and not self._is_thing(entry.carried_by):
            self._check_carrier(where, entry.carried_by, "car or thing")

    def _is_thing(self, name: str) -> bool:
        return name in self._entry.things or self._document.is_faulty(("things", name))

    def _check_place(self, where: Where, given: set[str], needed: str) -> None:
        for name in ("x_m", "y_m"):
            if not {name, "carried_by"} & given:
                self._document.report((*where, name), f"is missing: {needed}")

    def _check_carrier(self, where: Where, name: str, kind: str) -> None:
        if self._cars is not None and name not in self._cars:
            todo = f"use {', '.join(self._cars)}" if self._cars else "add a car with --car"
            self._document.report((*where, "carried_by"), f"no {kind} {name!r} is simulated here: {todo}")

    def _check_starts(self) -> None:
        report, entry, walls = self._document.report, self._entry, walls_of(self._entry)
        # A thing with a fault is skipped: its place may be wrong.
        solid = {
            name: each
            for name, each in entry.things.items()
            if not (each.carried_by or self._is_faulty(("things", name)))
        }
        for name, start in entry.cars.items():
            x, y, where = start.x_m, start.y_m, ("cars", name)
            inside = any(abs(x - b.x_m) < b.width_m / 2 and abs(y - b.y_m) < b.depth_m / 2 for b in entry.boxes)
            room = entry.room if "room" in entry.model_fields_set else None
            if room is not None and (abs(x) > room.width_m / 2 or abs(y) > room.depth_m / 2):
                report(where, "begins outside the room")
            elif inside or any(distance(x, y, wall) < RADIUS_M for wall in walls):
                report(where, f"begins in a wall: keep at least {RADIUS_M:g} m from every wall")
            for thing in (each for each in solid if _is_in(solid[each], x, y)):
                report(where, f"begins in {thing}, a thing: keep at least {RADIUS_M:g} m from it")
        for (one, first), (other, second) in combinations(entry.cars.items(), 2):
            away = hypot(first.x_m - second.x_m, first.y_m - second.y_m)
            if entry.cars_meet and away < 2 * RADIUS_M:
                words = f"begins {away:.2g} m from {one}: keep at least {2 * RADIUS_M:g} m, or write cars_meet: false"
                report(("cars", other), words)

    def _is_faulty(self, where: Where) -> bool:
        return self._document.is_faulty(where) or self._document.faulty_within(where)


def _is_in(thing: ThingEntry, x: float, y: float) -> bool:
    """Return True if a car at x, y overlaps a thing where the thing begins."""
    place: Point = thing.path[0] if thing.path else (thing.x_m, thing.y_m)
    dx, dy = x - place[0], y - place[1]
    if thing.radius_m:
        return hypot(dx, dy) < RADIUS_M + thing.radius_m
    form = (radians(thing.heading_deg), thing.width_m, thing.depth_m)
    return in_turned_box(dx, dy, *form) or any(
        distance(dx, dy, side) < RADIUS_M for side in turned_box(0.0, 0.0, *form)
    )

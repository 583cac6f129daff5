"""What is drawn from several messages or fields at once: ways, LEDs, the world, marks of commands, roles.

Chunks pass through; those of a few topics are followed by others that are made of them. What was seen is noted on the
way, because the layout is made of it.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import cos, sin
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import pyarrow.compute as pc  # type: ignore[import-untyped]  # likewise
import rerun as rr
import rerun.chunk as rrc

from fleet.replay import panels
from fleet.replay.colors import OFF, Rgb, colour, rgb
from fleet.replay.rerun.lenses import component, numbers, triples
from fleet.replay.rerun.staleness import LOGGED, PUBLISHED, StaleStates
from schemas import keys, messages
from schemas.topics import COMMANDS

TIMELINES: Final = (LOGGED, PUBLISHED)
MARK_S: Final = 0.4
"""How long the mark of a command is, if nothing comes after it."""
_ASKED: Final = "asked"
_QUEUED: Final = "queued"
_CARRIED_OUT: Final = frozenset({"sent", "complete"})
_LED: Final = "led"
LED: Final = COMMANDS["led"]
_THING_M: Final = 0.2
"""Height at which things are drawn; the world has none."""
_LAMP: Final = (255, 225, 90)
_THING: Final = (170, 140, 110)
_WALL: Final = (150, 155, 165)
_TAPE: Final = (220, 220, 220)
_Times = dict[str, Any]
_MANY: Final = 256
"""Colours of LEDs that get a colour of their own in the lanes."""


class Drawing:
    """What has been seen of a session; `limit`: of each car's way so many points are kept, None: all."""

    def __init__(self, limit: int | None = None) -> None:
        self._limit = limit
        self._ways: dict[str, Any] = {}
        self._parts: dict[str, list[Any]] = {}
        self._still: dict[str, Any] = {}
        self._ends = StaleStates()
        self._asked: dict[str, str] = {}
        """Colours of LEDs that were asked for, by the command's id, until it is known what became of it."""
        self._drawn: dict[str, Callable[[str, Any, _Times], Iterator[Any]]] = {
            panels.TRUTH: self._truth,
            panels.WORLD: self._world,
            panels.COMMANDS: self._commands,
            panels.ASSIGNMENT: self._roles,
        }
        self.held: Counter[str] = Counter()
        """Messages by key."""
        self.leds: set[str] = set()
        self.lanes: set[tuple[str, str]] = set()
        """(entity, name) of the lanes that were drawn."""
        self.corners: list[tuple[float, float]] = []
        """Of the simulated world's walls."""
        self.span_ns: tuple[int, int] | None = None
        """When the first and the last message were published, ns since the epoch; None: nothing came."""

    def follow(self, chunks: Iterable[Any]) -> Iterator[Any]:
        """Pass the chunks on, each followed by what is drawn of it."""
        for chunk in chunks:
            yield chunk
            if chunk.is_static:
                continue
            key = panels.key_of(chunk.entity_path)
            self.held[key] += chunk.num_rows
            batch = chunk.to_record_batch()
            topic = panels.topic_of(key)
            if PUBLISHED in batch.schema.names:
                self._widen(batch.column(PUBLISHED))
                self._ends.heard(chunk.entity_path, topic, batch)
            draw = self._drawn.get(topic)
            if draw is None:
                continue
            if component(topic) in batch.schema.names:
                times = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in TIMELINES}
                yield from draw(chunk.entity_path, batch.column(component(topic)).flatten(), times)

    def _widen(self, published: Any) -> None:
        ends = pc.min_max(published.cast(pa.int64())).as_py()
        if ends["min"] is not None:
            first, last = self.span_ns or (ends["min"], ends["max"])
            self.span_ns = min(first, ends["min"]), max(last, ends["max"])

    def contents(self) -> panels.Contents:
        """What there was."""
        return panels.contents(frozenset(self.held))

    def ends(self) -> Iterator[Any]:
        """Ends of lanes of which nothing was heard any more, as far as is known by now; each once."""
        if self.span_ns is not None:
            yield from self._ends.chunks(self.span_ns[1])

    def still(self) -> Iterator[Any]:
        """Each simulated car's way as one line, its colour and its name: static, so seen at any time."""
        contents = self.contents()
        for index, car in enumerate(contents.cars):
            key = keys.topic_key(contents.fleet, car, panels.TRUTH)
            way = self._way(key)
            if way is None:
                continue
            strip = rr.LineStrips3D.columns(
                strips=[triples(way[:, 0], way[:, 1])], colors=_tints([colour(car, index)]), radii=[0.012]
            )
            name = rr.Arrows3D.columns(
                colors=_tints([colour(car, index)]), radii=[0.035], labels=[car], show_labels=[True]
            )
            yield rrc.Chunk.from_columns(f"{panels.entity(key)}/way", indexes=[], columns=strip)
            yield rrc.Chunk.from_columns(panels.entity(key), indexes=[], columns=name)

    def ground(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """The lowest and the highest x and y, m, of the walls and of where cars were; None if none was simulated."""
        ways = [way for key in list(self._parts) if (way := self._way(key)) is not None]
        if not ways:
            return None
        every = np.concatenate([*ways, *([np.array(self.corners)] if self.corners else [])])
        low, high = every.min(axis=0), every.max(axis=0)
        return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))

    def _way(self, key: str) -> Any:
        parts = self._parts.get(key)
        if not parts:
            return None
        if len(parts) > 1:
            whole = np.concatenate(parts)
            self._parts[key] = parts = [whole if self._limit is None else whole[-self._limit :]]
        return parts[0]

    def _truth(self, path: str, truths: Any, times: _Times) -> Iterator[Any]:
        x, y, leds = numbers(truths, "x_m"), numbers(truths, "y_m"), truths.field(_LED).dictionary_encode()
        self._parts.setdefault(panels.key_of(path), []).append(np.stack([x, y], axis=1))
        seen = leds.dictionary.to_pylist()
        self._note(seen)
        tints = _tints(rgb(each) for each in seen)[leds.indices.to_numpy(zero_copy_only=False)]
        discs = rr.Points3D.columns(positions=triples(x, y), colors=tints, radii=np.full(len(x), 0.07))
        yield rrc.Chunk.from_columns(f"{path}/{_LED}", indexes=_indexes(times), columns=discs)

    def _note(self, leds: Iterable[str]) -> None:
        if len(self.leds) < _MANY:
            self.leds.update(leds)

    def _world(self, path: str, worlds: Any, times: _Times) -> Iterator[Any]:
        rows = worlds.to_pylist()
        yield from self._unmoving(path, rows[-1])
        lamps = [row["lamps"] or [] for row in rows]
        if any(lamps):
            every = [lamp for row in lamps for lamp in row]
            points = rr.Points3D.columns(
                positions=[(lamp["x_m"], lamp["y_m"], 0.02) for lamp in every],
                colors=_tints(_LAMP if lamp["on"] else OFF for lamp in every),
                radii=[0.06] * len(every),
                labels=[lamp["name"] for lamp in every],
            )
            points = points.partition([len(row) for row in lamps])
            yield rrc.Chunk.from_columns(f"{path}/lamps", indexes=_indexes(times), columns=points)
        things = [row["things"] or [] for row in rows]
        if any(things):
            every = [thing for row in things for thing in row]
            boxes = rr.Boxes3D.columns(
                centers=[(thing["x_m"], thing["y_m"], 0.0) for thing in every],
                half_sizes=[_half_size(thing) for thing in every],
                quaternions=[_about_z(thing["heading_rad"]) for thing in every],
                colors=_tints([_THING] * len(every)),
                labels=[thing["name"] for thing in every],
            )
            boxes = boxes.partition([len(row) for row in things])
            yield rrc.Chunk.from_columns(f"{path}/things", indexes=_indexes(times), columns=boxes)

    def _unmoving(self, path: str, world: Any) -> Iterator[Any]:
        """Walls and the taped line: once, and again if they are others."""
        walls = [[_point(wall["begin"]), _point(wall["end"])] for wall in world["walls"] or ()]
        line = [_point(each) for each in world["line"] or ()]
        strips = {
            "walls": (walls, _WALL, 0.03),
            "line": ([[*line, line[0]]] if line else [], _TAPE, 0.0125),
        }
        for name, (shapes, tint, radius) in strips.items():
            if not shapes or self._still.get(name) == shapes:
                continue
            self._still[name] = shapes
            drawn = rr.LineStrips3D.columns(
                strips=shapes, colors=_tints([tint] * len(shapes)), radii=[radius] * len(shapes)
            ).partition([len(shapes)])
            yield rrc.Chunk.from_columns(f"{path}/{name}", indexes=[], columns=drawn)
        self.corners = [(x, y) for wall in walls for x, y, _ in wall]

    def _commands(self, path: str, events: Any, times: _Times) -> Iterator[Any]:
        rows = events.to_pylist()
        marks = [f"{row['verb']} {row['phase']}" for row in rows]
        yield self._lane(path, panels.MARKS.name, *_with_ends(times, marks))
        done = [(place, led) for place, row in enumerate(rows) if row["verb"] == _LED and (led := self._led(row))]
        if done:
            places, leds = [place for place, _ in done], [led for _, led in done]
            self._note(leds)
            yield self._lane(path, panels.LED_ASKED.name, {name: at[places] for name, at in times.items()}, leds)

    def _led(self, event: dict[str, Any]) -> str:
        """The colour if this says that a command for an LED was sent; what it was it said when it was asked."""
        if event["phase"] == _ASKED:
            if len(self._asked) < _MANY:
                self._asked[event["id"]] = _led_asked(event)
            return ""
        if event["phase"] == _QUEUED:
            return ""
        asked = self._asked.pop(event["id"], "")
        return asked if event["phase"] in _CARRIED_OUT else ""

    def _roles(self, path: str, assignments: Any, times: _Times) -> Iterator[Any]:
        rows = assignments.to_pylist()
        roles = [{car: role["name"] for role in row["roles"] or () for car in role["cars"] or ()} for row in rows]
        for car in sorted(set().union(*roles)):
            yield self._lane(path, f"{panels.ROLE.name} {car}", times, [each.get(car) for each in roles])

    def _lane(self, path: str, name: str, times: _Times, states: Sequence[str | None]) -> Any:
        self.lanes.add((path, name))
        columns = rr.AnyValues.columns(**{name: pa.array(states, pa.string())})
        return rrc.Chunk.from_columns(path, indexes=_indexes(times), columns=columns)


def _tints(colours: Iterable[Rgb]) -> Any:
    """As 0xRRGGBBAA: Rerun takes four triples for one colour of four parts."""
    return np.array([int.from_bytes((*each, 255), "big") for each in colours], dtype=np.uint32)


def _indexes(times: _Times) -> list[Any]:
    return [rr.TimeColumn(name, timestamp=at) for name, at in times.items()]


def _with_ends(times: _Times, marks: list[str]) -> tuple[_Times, list[str | None]]:
    """Each mark ends after MARK_S, unless another begins before."""
    length = np.timedelta64(int(MARK_S * 1e9), "ns")
    clock = times[TIMELINES[0]]
    ends = [place for place in range(len(marks)) if place + 1 == len(marks) or clock[place + 1] - clock[place] > length]
    return (
        {name: np.concatenate([at, at[ends] + length]) for name, at in times.items()},
        [*marks, *[None] * len(ends)],
    )


def _led_asked(event: dict[str, Any]) -> str:
    """The colour that was asked for, as `sim/truth` has it; empty if that is not known."""
    try:
        asked: Any = messages.parse(LED, event["request"], event["request_encoding"])
    except messages.BadPayload:
        return ""
    return f"#{asked.r:02x}{asked.g:02x}{asked.b:02x}" if asked.r or asked.g or asked.b else "off"


def _point(point: dict[str, float]) -> tuple[float, float, float]:
    return point["x_m"], point["y_m"], 0.0


def _half_size(thing: dict[str, float]) -> tuple[float, float, float]:
    return thing["radius_m"] or thing["width_m"] / 2, thing["radius_m"] or thing["depth_m"] / 2, _THING_M / 2


def _about_z(angle_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, sin(angle_rad / 2), cos(angle_rad / 2)

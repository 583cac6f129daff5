"""Draws what needs several messages or fields at once: paths, LEDs, the world, marks of commands, roles.

A chunk is a batch of Rerun data. All chunks pass through unchanged. After chunks of a few topics, `Drawing` inserts
chunks derived from them. It also collects what the session contains, for the layout.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import product
from math import cos, sin
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import pyarrow.compute as pc  # type: ignore[import-untyped]  # likewise
import rerun as rr
import rerun.chunk as rrc

from fleet.recording.tools.summary import MARK_TOPIC_NAME
from fleet.replay import panels
from fleet.replay.rerun.lenses import OTHER_FIELDS, component, is_drawn, numbers, triples
from fleet.replay.rerun.staleness import LOG_TIMELINE, PUBLISH_TIMELINE, StaleStates
from fleet.replay.state_colors import OFF, rgb
from schemas import keys, messages
from schemas.colors import Rgb, car_color
from schemas.commands import COMMANDS, Verb
from schemas.words import Phase

TIMELINES: Final = (LOG_TIMELINE, PUBLISH_TIMELINE)
MAX_MARK_S: Final = 0.4
"""Maximum length of the mark of a command."""
_CARRIED_OUT: Final = frozenset({Phase.SENT, Phase.COMPLETE})
_LED: Final = "led"
LED_MESSAGE: Final = COMMANDS[Verb.LED].message
_THING_M: Final = 0.2
"""Height with which things are drawn. They have no height of their own, because the simulated world is flat."""
_LAMP_COLOR: Final = (255, 225, 90)
_THING_COLOR: Final = (170, 140, 110)
_WALL_COLOR: Final = (150, 155, 165)
_TAPE_COLOR: Final = (220, 220, 220)
MAX_NS: Final = 2**63
"""Times in Rerun are smaller than this."""
MAX_NUMBER: Final = float(np.finfo(np.float32).max)
"""Rerun draws places and sizes as float32. What has a larger number, or one that is not finite, has no place: any
program can publish it."""
_PLACE: Final = ("x_m", "y_m")
_SHAPE: Final = ("heading_rad", "radius_m", "width_m", "depth_m")
_Times = dict[str, Any]
_MAX_LEDS: Final = 256
"""Maximum number of LED colors that tracks can show, and of LED commands that await their outcome."""


class Drawing:
    """Derives chunks from those of a session, and collects what the session contains.

    `limit` is the maximum number of points per path. None means no limit. `car_colors` are the colors of the cars in
    the fleet file.
    """

    def __init__(self, limit: int | None = None, car_colors: Mapping[str, Rgb] | None = None) -> None:
        self._limit = limit
        self._car_colors = car_colors or {}
        self._parts: dict[str, list[Any]] = {}
        self._static: dict[str, Any] = {}
        self._ends = StaleStates()
        self._requested: dict[str, str] = {}
        """Colors of LED commands by command id, until their outcome."""
        self._drawers: dict[str, Callable[[str, Any, _Times], Iterator[Any]]] = {
            panels.TRUTH: self._truth,
            panels.POSE: self._pose,
            panels.WORLD: self._world,
            panels.COMMAND_TOPIC: self._commands,
            panels.ASSIGNMENT: self._roles,
        }
        self.counts: Counter[str] = Counter()
        """Drawn messages by key."""
        self.leds: set[str] = set()
        self.tracks: set[tuple[str, str]] = set()
        """(entity, name) of the derived tracks."""
        self.corners: list[tuple[float, float]] = []
        """Corners of the walls of the simulated world."""
        self.span_ns: tuple[int, int] | None = None
        """Publish times of the first and last message, ns since the epoch. None without messages."""

    def follow(self, chunks: Iterable[Any]) -> Iterator[Any]:
        """Yield each chunk, followed by the chunks derived from it."""
        for chunk in chunks:
            yield chunk
            if chunk.is_static:
                continue
            key = panels.key_of(chunk.entity_path)
            batch = chunk.to_record_batch()
            topic = panels.topic_of(key)
            if not is_drawn(topic, batch.schema.names):
                continue  # a stray message must not end a track, or make a tab for a car
            self.counts[key] += chunk.num_rows
            if PUBLISH_TIMELINE in batch.schema.names:
                self._extend_span(batch.column(PUBLISH_TIMELINE))
                self._ends.add(chunk.entity_path, topic, batch)
            draw = self._drawers.get(topic)
            if draw is None:
                continue
            if component(topic) in batch.schema.names:
                times = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in TIMELINES}
                with suppress(*OTHER_FIELDS):
                    yield from list(draw(chunk.entity_path, batch.column(component(topic)).flatten(), times))

    def _extend_span(self, published: Any) -> None:
        ends = pc.min_max(published.cast(pa.int64())).as_py()
        if ends["min"] is not None:
            first, last = self.span_ns or (ends["min"], ends["max"])
            self.span_ns = min(first, ends["min"]), max(last, ends["max"])

    def color(self, car: str, index: int) -> Rgb:
        """Return the color of a car."""
        return self._car_colors.get(car) or car_color(car, index)

    def contents(self) -> panels.Contents:
        """Return the contents of the session so far."""
        return panels.contents(frozenset(self.counts))

    def ends(self) -> Iterator[Any]:
        """Yield the ends of the tracks that are stale by now. Each end is yielded once."""
        if self.span_ns is not None:
            yield from self._ends.chunks(self.span_ns[1])

    def static(self) -> Iterator[Any]:
        """Yield the path, color and name of each car whose place is known.

        They are static data, so they are visible at any time.
        """
        contents = self.contents()
        for (index, car), topic in product(enumerate(contents.cars), (panels.TRUTH, panels.POSE)):
            key = keys.topic_key(contents.fleet, car, topic)
            points = self._car_path(key)
            if points is None:
                continue
            strip = rr.LineStrips3D.columns(
                strips=[triples(points[:, 0], points[:, 1])], colors=_tints([self.color(car, index)]), radii=[0.012]
            )
            name = rr.Arrows3D.columns(
                colors=_tints([self.color(car, index)]), radii=[0.035], labels=[car], show_labels=[True]
            )
            yield rrc.Chunk.from_columns(f"{panels.entity(key)}/way", indexes=[], columns=strip)
            yield rrc.Chunk.from_columns(panels.entity(key), indexes=[], columns=name)

    def added_marks(
        self, marks: Iterable[Mapping[str, Any]], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Any]:
        """Yield the marks of session.json that no message has, because they were added after the recording.

        start_ns, end_ns (excluded): the time span that is shown, in ns since the epoch. None means no limit.
        """
        found: list[tuple[int, str]] = []
        for mark in marks:
            with suppress(ValueError, OverflowError):  # the time may have been written by hand, and wrong
                at_ns = round(datetime.fromisoformat(str(mark.get("time"))).timestamp() * 1000) * 1_000_000
                if "added" in mark and (start_ns or 0) <= at_ns < (end_ns or MAX_NS):
                    found.append((at_ns, str(mark.get("text"))))
        if found:
            key = keys.topic_key(self.contents().fleet, keys.RECORDER, MARK_TOPIC_NAME.partition("/")[2])
            self.counts[key] += len(found)
            at = np.array([ns for ns, _ in found], dtype="datetime64[ns]")
            columns = rr.TextLog.columns(text=[text for _, text in found], level=["INFO"] * len(found))
            indexes = _indexes(dict.fromkeys(TIMELINES, at))
            yield rrc.Chunk.from_columns(panels.entity(key), indexes=indexes, columns=columns)

    def ground(self, topic: str) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Return the lowest and highest x and y of the paths of a topic in meters, or None if it has none.

        For the truth, the walls count, too. Measured poses have another origin, so there the walls would mislead.
        """
        of_topic = [key for key in self._parts if panels.topic_of(key) == topic]
        paths = [points for key in of_topic if (points := self._car_path(key)) is not None]
        if not paths:
            return None
        corners = self.corners if topic == panels.TRUTH else []
        every = np.concatenate([*paths, *([np.array(corners)] if corners else [])])
        low, high = every.min(axis=0), every.max(axis=0)
        return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))

    def _car_path(self, key: str) -> Any:
        parts = self._parts.get(key)
        if not parts:
            return None
        if len(parts) > 1:
            whole = np.concatenate(parts)
            self._parts[key] = parts = [whole if self._limit is None else whole[-self._limit :]]
        return parts[0]

    def _pose(self, path: str, poses: Any, times: _Times) -> Iterator[Any]:  # noqa: ARG002 - a lens draws the arrow
        self._extend_path(path, numbers(poses, "x_m"), numbers(poses, "y_m"))
        return iter(())

    def _extend_path(self, path: str, x: Any, y: Any) -> None:
        points = np.stack([x, y], axis=1)
        placed = points[(np.abs(points) <= MAX_NUMBER).all(axis=1)]
        if len(placed):
            self._parts.setdefault(panels.key_of(path), []).append(placed)

    def _truth(self, path: str, truths: Any, times: _Times) -> Iterator[Any]:
        x, y, leds = numbers(truths, "x_m"), numbers(truths, "y_m"), truths.field(_LED).dictionary_encode()
        self._extend_path(path, x, y)
        seen = leds.dictionary.to_pylist()
        tints = _tints(rgb(each) for each in seen)[leds.indices.to_numpy(zero_copy_only=False)]
        self._add_leds(seen)
        discs = rr.Points3D.columns(positions=triples(x, y), colors=tints, radii=np.full(len(x), 0.07))
        yield rrc.Chunk.from_columns(f"{path}/{_LED}", indexes=_indexes(times), columns=discs)

    def _add_leds(self, leds: Iterable[str]) -> None:
        if len(self.leds) < _MAX_LEDS:
            self.leds.update(leds)

    def _world(self, path: str, worlds: Any, times: _Times) -> Iterator[Any]:
        rows = worlds.to_pylist()
        yield from self._static_world(path, rows[-1])
        lamps = [_placed(row["lamps"], *_PLACE) for row in rows]
        if any(lamps):
            every = [lamp for row in lamps for lamp in row]
            points = rr.Points3D.columns(
                positions=[(lamp["x_m"], lamp["y_m"], 0.02) for lamp in every],
                colors=_tints(_LAMP_COLOR if lamp["on"] else OFF for lamp in every),
                radii=[0.06] * len(every),
                labels=[lamp["name"] for lamp in every],
            )
            points = points.partition([len(row) for row in lamps])
            yield rrc.Chunk.from_columns(f"{path}/lamps", indexes=_indexes(times), columns=points)
        things = [_placed(row["things"], *_PLACE, *_SHAPE) for row in rows]
        if any(things):
            every = [thing for row in things for thing in row]
            boxes = rr.Boxes3D.columns(
                centers=[(thing["x_m"], thing["y_m"], 0.0) for thing in every],
                half_sizes=[_half_size(thing) for thing in every],
                quaternions=[_about_z(thing["heading_rad"]) for thing in every],
                colors=_tints([_THING_COLOR] * len(every)),
                labels=[thing["name"] for thing in every],
            )
            boxes = boxes.partition([len(row) for row in things])
            yield rrc.Chunk.from_columns(f"{path}/things", indexes=_indexes(times), columns=boxes)

    def _static_world(self, path: str, world: Any) -> Iterator[Any]:
        """Yield the walls and the taped line once, and again if they change."""
        ends = [_placed([wall["begin"], wall["end"]], *_PLACE) for wall in world["walls"] or ()]
        walls = [[_point(begin), _point(end)] for begin, end in (each for each in ends if len(each) == 2)]
        line = [_point(each) for each in _placed(world["line"], *_PLACE)]
        strips = {
            "walls": (walls, _WALL_COLOR, 0.03),
            "line": ([[*line, line[0]]] if line else [], _TAPE_COLOR, 0.0125),
        }
        for name, (shapes, tint, radius) in strips.items():
            if not shapes or self._static.get(name) == shapes:
                continue
            self._static[name] = shapes
            columns = rr.LineStrips3D.columns(
                strips=shapes, colors=_tints([tint] * len(shapes)), radii=[radius] * len(shapes)
            ).partition([len(shapes)])
            yield rrc.Chunk.from_columns(f"{path}/{name}", indexes=[], columns=columns)
        self.corners = [(x, y) for wall in walls for x, y, _ in wall]

    def _commands(self, path: str, events: Any, times: _Times) -> Iterator[Any]:
        rows = events.to_pylist()
        marks = [f"{row['verb']} {row['phase']}" for row in rows]
        yield self._track(path, panels.COMMAND_TRACK.name, *_with_ends(times, marks))
        done = [(place, led) for place, row in enumerate(rows) if row["verb"] == Verb.LED and (led := self._led(row))]
        if done:
            places, leds = [place for place, _ in done], [led for _, led in done]
            self._add_leds(leds)
            yield self._track(path, panels.LED_REQUESTED.name, {name: at[places] for name, at in times.items()}, leds)

    def _led(self, event: dict[str, Any]) -> str:
        """Return the color if this event reports an LED command as sent.

        The color itself is in the first event of the command.
        """
        if event["phase"] == Phase.ASKED:
            if len(self._requested) < _MAX_LEDS:
                self._requested[event["id"]] = _led_color(event)
            return ""
        if event["phase"] == Phase.QUEUED:
            return ""
        requested = self._requested.pop(event["id"], "")
        return requested if event["phase"] in _CARRIED_OUT else ""

    def _roles(self, path: str, assignments: Any, times: _Times) -> Iterator[Any]:
        rows = assignments.to_pylist()
        roles = [{car: role["name"] for role in row["roles"] or () for car in role["cars"] or ()} for row in rows]
        for car in sorted(set().union(*roles)):
            yield self._track(path, f"{panels.ROLE.name} {car}", times, [each.get(car) for each in roles])

    def _track(self, path: str, name: str, times: _Times, states: Sequence[str | None]) -> Any:
        self.tracks.add((path, name))
        columns = rr.AnyValues.columns(**{name: pa.array(states, pa.string())})
        return rrc.Chunk.from_columns(path, indexes=_indexes(times), columns=columns)


def _tints(colors: Iterable[Rgb]) -> Any:
    """Return colors as 0xRRGGBBAA.

    As bytes they would be ambiguous: Rerun would read four RGB colors as three RGBA colors.
    """
    return np.array([int.from_bytes((*each, 255), "big") for each in colors], dtype=np.uint32)


def _indexes(times: _Times) -> list[Any]:
    return [rr.TimeColumn(name, timestamp=at) for name, at in times.items()]


def _with_ends(times: _Times, marks: list[str]) -> tuple[_Times, list[str | None]]:
    """End each mark after MAX_MARK_S, unless another mark begins earlier."""
    length = np.timedelta64(int(MAX_MARK_S * 1e9), "ns")
    clock = times[TIMELINES[0]]
    ends = [place for place in range(len(marks)) if place + 1 == len(marks) or clock[place + 1] - clock[place] > length]
    return (
        {name: np.concatenate([at, at[ends] + length]) for name, at in times.items()},
        [*marks, *[None] * len(ends)],
    )


def _led_color(event: dict[str, Any]) -> str:
    """Return the color of an LED command in the format of `sim/truth`, or an empty text if unknown."""
    try:
        requested: Any = messages.parse(LED_MESSAGE, event["request"], event["request_encoding"])
    except messages.BadPayload:
        return ""
    return (
        f"#{requested.r:02x}{requested.g:02x}{requested.b:02x}" if requested.r or requested.g or requested.b else "off"
    )


def _placed(parts: Iterable[dict[str, Any] | None] | None, *names: str) -> list[dict[str, Any]]:
    """Return those parts of a world that are there, and of which all these numbers can be drawn."""
    return [part for part in parts or () if part is not None and all(_is_drawable(part[name]) for name in names)]


def _is_drawable(value: Any) -> bool:
    return isinstance(value, float) and abs(value) <= MAX_NUMBER


def _point(point: dict[str, float]) -> tuple[float, float, float]:
    return point["x_m"], point["y_m"], 0.0


def _half_size(thing: dict[str, float]) -> tuple[float, float, float]:
    return thing["radius_m"] or thing["width_m"] / 2, thing["radius_m"] or thing["depth_m"] / 2, _THING_M / 2


def _about_z(angle_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, sin(angle_rad / 2), cos(angle_rad / 2)

"""Builds the layout of a session in Rerun's viewer: a tab for the fleet and one per car, without empty views."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from fleet.replay import panels, state_colors
from fleet.replay.panels import Curve, Panel, StateTrack
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import component
from fleet.replay.rerun.staleness import PUBLISH_TIMELINE
from schemas import keys
from schemas.colors import Rgb
from schemas.topics import TOPICS

_THRESHOLDS: Final[Mapping[panels.Derivation, Rgb]] = {
    panels.Derivation.LOW: (224, 160, 48),
    panels.Derivation.CRITICAL: (217, 83, 79),
}
_MIN_EYE_HEIGHT_M: Final = 1.5
_MIN_WORLD_ASPECT: Final = 1.5
"""Minimum ratio of width to height of the view of the world if text views are below it."""
_LEDS: Final = frozenset({panels.LED_REQUESTED.name, panels.LED_TRUE.name})

_FLOORS: Final[Mapping[str, str]] = {
    panels.TRUTH: "World, from above (simulated cars)",
    panels.POSE: "Map, from above (measured poses)",
}
"""The views of the floor, by the topic that says where cars are."""

_Ground = tuple[tuple[float, float], tuple[float, float]]
_View = rrb.View | rrb.Container
_Overrides = dict[Any, list[Any]]
"""Visualizers by entity. Any, because Rerun's own mapping type is invariant."""


def layout(drawing: Drawing, tab: str = "", last_s: float | None = None) -> rrb.Blueprint:
    """Return the layout for the contents of a drawing. tab: the car whose tab is in front.

    Empty means the tab of the fleet. last_s: the time span before the cursor that is in view. None means the whole
    time.
    """
    session = drawing.contents()
    builder = _RerunLayout(drawing, _axis(drawing.span_ns, last_s))
    tabs = [
        builder.fleet_tab({topic: drawing.ground(topic) for topic in _FLOORS}),
        *(builder.car_tab(car) for car in session.cars),
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=1 + list(session.cars).index(tab) if tab else 0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=PUBLISH_TIMELINE),
        auto_views=False,
        auto_layout=False,
    )


class _RerunLayout:
    """Builder of the tabs of one session."""

    def __init__(self, drawing: Drawing, axis: rrb.TimeAxis) -> None:
        self._session = drawing.contents()
        self._leds = state_colors.leds(drawing.leds)
        self._drawn = drawing.tracks
        self._color = drawing.color
        self._axis = axis

    def fleet_tab(self, grounds: Mapping[str, _Ground | None]) -> _View:
        """Return the tab of the fleet: a page of its cars and a page of its services. `grounds` are by topic."""
        session = self._session
        texts = [view for name, ours, theirs in panels.FLEET_TEXTS if (view := self._fleet_text(name, ours, theirs))]
        if panels.PLAN_TOPIC in session.services:
            plan = panels.entity(f"{session.fleet}/{panels.PLAN_TOPIC}")
            texts.append(rrb.TextDocumentView(origin=plan, contents=[plan], name="Plan"))
        wide = _MIN_WORLD_ASPECT if texts else 1.0
        floors = [self._floor(topic, *ground, wide) for topic, ground in grounds.items() if ground is not None]
        left: list[_View] = [rrb.Tabs(*floors, active_tab=0)] if len(floors) > 1 else [*floors]
        if texts:
            left.append(rrb.Tabs(*texts, active_tab=0))
        right: list[_View] = []
        tracks = [view for name, each in panels.FLEET_TRACKS if (view := self._fleet_tracks(name, each))]
        if tracks:
            right.append(rrb.Tabs(*tracks, active_tab=0))
        for name, curve in panels.FLEET_CURVES:
            overrides = {
                self._entity(car, curve.topic): [_curve(curve, car, self._color(car, index))]
                for index, (car, topics) in enumerate(session.cars.items())
                if curve.topic in topics
            }
            if overrides:
                right.append(self._curves(name, overrides))
        # Tracks of every car need more height than curves, which share one view.
        shares = [3 if isinstance(view, rrb.Tabs) else 1 for view in right]
        columns = [
            rrb.Vertical(*column, row_shares=parts)
            for column, parts in ((left, [1] * len(left)), (right, shares))
            if column
        ]
        services = [view for panel in panels.SERVICE_PANELS if (view := self._panel("", panel))]
        return _two_pages("Fleet", rrb.Horizontal(*columns, name="Cars"), services, "Services")

    def car_tab(self, car: str) -> _View:
        """Return the tab of a car: a page of its main panels and a page of the others."""
        tracks, others = self._column(car, tracks=True), self._column(car, tracks=False)
        more = [view for panel in panels.MORE_PANELS if (view := self._panel(car, panel))]
        columns = [column for column in (tracks, others) if column is not None]
        return _two_pages(car, rrb.Horizontal(*columns, name="Car"), more, "More")

    def _column(self, car: str, *, tracks: bool) -> rrb.Vertical | None:
        """Return one column of a car's first page: the panels with tracks, or the panels without."""
        chosen = [panel for panel in panels.MAIN_PANELS if bool(panel.tracks) == tracks]
        views = [(view, 1 + self._track_count(car, panel)) for panel in chosen if (view := self._panel(car, panel))]
        return rrb.Vertical(*(view for view, _ in views), row_shares=[share for _, share in views]) if views else None

    def _track_count(self, car: str, panel: Panel) -> int:
        return sum(self._has_track(car, track) for track in panel.tracks)

    def _entity(self, car: str, topic: str) -> str:
        """Return the entity of a topic. The topic of a service begins with its name and has no car."""
        if topic.startswith("@"):
            return panels.entity(f"{self._session.fleet}/{topic}")
        return panels.entity(keys.topic_key(self._session.fleet, car, topic))

    def _has(self, car: str, topic: str) -> bool:
        if topic.startswith("@"):
            return topic in self._session.services
        return topic in self._session.cars.get(car, ())

    def _has_track(self, car: str, track: StateTrack) -> bool:
        if track.drawn:
            return (self._entity(car, track.topic), _name(track, car)) in self._drawn
        return self._has(car, track.topic)

    def _fleet_text(self, name: str, ours: Iterable[str], theirs: Iterable[str]) -> rrb.View | None:
        entities = [self._entity(car, topic) for topic in ours for car in self._session.cars if self._has(car, topic)]
        entities += [self._entity("", topic) for topic in theirs if self._has("", topic)]
        return _text(name, entities) if entities else None

    def _fleet_tracks(self, name: str, tracks: Iterable[StateTrack]) -> rrb.View | None:
        overrides: _Overrides = {}
        for car in self._session.cars:
            for track in tracks:
                if self._has_track(car, track):
                    overrides.setdefault(self._entity(car, track.topic), []).append(self._track(track, car))
        return self._tracks(name, overrides) if overrides else None

    def _panel(self, car: str, panel: Panel) -> rrb.View | None:
        """Return the view of a car's panel, or None if there is no data for it. An empty `car` means a service."""
        if panel.texts:
            texts = [self._entity(car, topic) for topic in panel.texts if self._has(car, topic)]
            return _text(panel.name, texts) if texts else None
        overrides: _Overrides = {}
        alone = sum(curve.derivation is None for curve in panel.curves) == 1
        for curve in panel.curves:
            if self._has(car, curve.topic):
                own = self._color(car, sorted(self._session.cars).index(car)) if alone and car else None
                rgb = _THRESHOLDS.get(curve.derivation, own) if curve.derivation is not None else own
                overrides.setdefault(self._entity(car, curve.topic), []).append(_curve(curve, curve.name, rgb))
        for track in panel.tracks:
            if self._has_track(car, track):
                overrides.setdefault(self._entity(car, track.topic), []).append(self._track(track, car))
        if not overrides:
            return None
        return self._tracks(panel.name, overrides) if panel.tracks else self._curves(panel.name, overrides)

    def _track(self, track: StateTrack, car: str) -> rrb.Visualizer:
        tints = (
            self._leds
            if track.name in _LEDS
            else state_colors.MARK_COLORS
            if track == panels.COMMAND_TRACK
            else state_colors.STATE_COLORS
        )
        style = rr.StateConfiguration(values=list(tints), colors=np.array(list(tints.values()), dtype=np.uint32))
        source = VisualizerComponentMapping(
            "StateChange:state", ComponentSourceKind.SourceComponent, source_component=_name(track, car)
        )
        return style.visualizer(mappings=[source])

    def _curves(self, name: str, overrides: _Overrides) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin="/",
            contents=list(overrides),
            name=name,
            overrides=overrides,
            plot_legend=rrb.PlotLegend(visible=True),
            axis_x=self._axis,
        )

    def _tracks(self, name: str, overrides: _Overrides) -> rrb.StateTimelineView:
        return rrb.StateTimelineView(
            origin="/", contents=list(overrides), name=name, overrides=overrides, time_view=self._axis
        )

    def _floor(self, topic: str, low: tuple[float, float], high: tuple[float, float], wide: float) -> rrb.Spatial3DView:
        session = self._session
        contents = [f"{self._entity(car, topic)}/**" for car, topics in session.cars.items() if topic in topics]
        if topic == panels.TRUTH and panels.WORLD in session.services:
            contents.append(f"{self._entity('', panels.WORLD)}/**")
        x, y = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
        size = max(high[1] - low[1], (high[0] - low[0]) / wide)
        # Not straight down: Rerun's camera is undefined if it looks along its up vector.
        eye = rrb.EyeControls3D(
            position=(x, y - 0.01, max(_MIN_EYE_HEIGHT_M, 1.2 * size)), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
        )
        return rrb.Spatial3DView(origin="/", contents=contents, name=_FLOORS[topic], eye_controls=eye)


def _axis(span_ns: tuple[int, int] | None, last_s: float | None) -> rrb.TimeAxis:
    """Return the time axis.

    It is not linked with other views, because linked axes ignore the range and show one minute.
    """
    at = rr.TimeRangeBoundary
    if last_s is not None:
        return rrb.TimeAxis(view_range=rr.TimeRange(at.cursor_relative(seconds=-last_s), at.cursor_relative()))
    if span_ns is None or span_ns[0] == span_ns[1]:
        return rrb.TimeAxis()
    return rrb.TimeAxis(view_range=rr.TimeRange(at.absolute(nanos=span_ns[0]), at.absolute(nanos=span_ns[1])))


def _name(track: StateTrack, car: str) -> str:
    """Return the component of a track. Roles have one component per car on one entity."""
    return f"{track.name} {car}" if track == panels.ROLE else track.name


def _two_pages(name: str, first: rrb.Container, others: list[rrb.View], what: str) -> rrb.Container:
    if others:
        return rrb.Tabs(first, rrb.Grid(*others, name=what), name=name, active_tab=0)
    return rrb.Tabs(first, name=name)


def _curve(curve: Curve, name: str, rgb: Rgb | None) -> rrb.Visualizer:
    derived = curve.derivation is not None
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component=curve.name if derived else component(curve.topic),
        selector="." if derived else f".{curve.field}",
    )
    if TOPICS[curve.topic].family == "sensor" and not derived:
        # Points, no line: some modes send no readings, and a line across the gap would look like measurements.
        points = rr.SeriesPoints(names=name, marker_sizes=4.0, markers="circle", colors=rgb)
        return points.visualizer(mappings=[source])
    width = 1.0 if curve.derivation in _THRESHOLDS else 2.0
    line = rr.SeriesLines(names=name, widths=width, colors=rgb)
    return line.visualizer(mappings=[source])


def _text(name: str, entities: list[str]) -> rrb.TextLogView:
    columns = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.TextLogView(
        origin="/",
        contents=entities,
        name=name,
        columns=rrb.TextLogColumns(timeline_columns=[PUBLISH_TIMELINE], text_log_columns=columns),
    )

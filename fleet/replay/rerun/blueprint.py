"""The layout of a session in Rerun's viewer: a tab for the fleet and one per car, only with views that have data."""

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from fleet.replay import colors
from fleet.replay import panels as mapping
from fleet.replay.colors import Rgb, colour
from fleet.replay.panels import Contents, Curve, Panel, StateTrack
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import component
from fleet.replay.rerun.staleness import PUBLISHED
from schemas import keys
from schemas.topics import TOPICS

_THRESHOLDS: Final[Mapping[mapping.How, Rgb]] = {mapping.How.LOW: (224, 160, 48), mapping.How.CRITICAL: (217, 83, 79)}
_LEAST_HEIGHT_M: Final = 1.5
_WIDE: Final = 1.5
"""With lines of text below it the world's view is so many times as wide as it is high, at least."""
_LEDS: Final = frozenset({mapping.LED_ASKED.name, mapping.LED_TRUE.name})

_View = rrb.View | rrb.Container
_Shown = dict[Any, list[Any]]
"""Visualizers by entity; Any, because Rerun's mapping is invariant in a union of its own."""


def layout(drawing: Drawing, tab: str = "", last_s: float | None = None) -> rrb.Blueprint:
    """The layout of what a drawing has seen; `tab`: the car whose tab is in front, none: the fleet's.

    `last_s`: of curves and lanes the last seconds before the cursor are in view; None: the whole time.
    """
    session = drawing.contents()
    shown = _RerunLayout(session, colors.leds(drawing.leds), drawing.lanes, _axis(drawing.span_ns, last_s))
    tabs = [shown.fleet_tab(drawing.ground()), *(shown.car_tab(car) for car in session.cars)]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=1 + list(session.cars).index(tab) if tab else 0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=PUBLISHED),
        auto_views=False,
        auto_layout=False,
    )


class _RerunLayout:
    """The tabs of one session."""

    def __init__(
        self, session: Contents, leds: Mapping[str, int], drawn: AbstractSet[tuple[str, str]], axis: rrb.TimeAxis
    ) -> None:
        self._session = session
        self._leds = leds
        self._drawn = drawn
        self._axis = axis

    def fleet_tab(self, ground: tuple[tuple[float, float], tuple[float, float]] | None) -> _View:
        """The fleet at a glance, and beside it its services."""
        session = self._session
        texts = [view for name, ours, theirs in mapping.FLEET_TEXTS if (view := self._fleet_text(name, ours, theirs))]
        if mapping.PLAN in session.services:
            plan = mapping.entity(f"{session.fleet}/{mapping.PLAN}")
            texts.append(rrb.TextDocumentView(origin=plan, contents=[plan], name="Plan"))
        wide = _WIDE if texts else 1.0
        left: list[_View] = [self._world(*ground, wide)] if ground is not None else []
        if texts:
            left.append(rrb.Tabs(*texts, active_tab=0))
        right: list[_View] = []
        lanes = [view for name, each in mapping.FLEET_LANES if (view := self._fleet_lanes(name, each))]
        if lanes:
            right.append(rrb.Tabs(*lanes, active_tab=0))
        for name, curve in mapping.FLEET_CURVES:
            shown = {
                self._entity(car, curve.topic): [_curve(curve, car, colour(car, index))]
                for index, (car, topics) in enumerate(session.cars.items())
                if curve.topic in topics
            }
            if shown:
                right.append(self._curves(name, shown))
        # The lanes of every car need room; the curves share a view.
        shares = [3 if isinstance(view, rrb.Tabs) else 1 for view in right]
        columns = [
            rrb.Vertical(*column, row_shares=parts)
            for column, parts in ((left, [1] * len(left)), (right, shares))
            if column
        ]
        services = [view for panel in mapping.SERVICE_PANELS if (view := self._panel("", panel))]
        return _two_pages("Fleet", rrb.Horizontal(*columns, name="Cars"), services, "Services")

    def car_tab(self, car: str) -> _View:
        """One car: what matters most, and beside it the rest."""
        lanes, others = self._column(car, lanes=True), self._column(car, lanes=False)
        more = [view for panel in mapping.MORE_PANELS if (view := self._panel(car, panel))]
        columns = [column for column in (lanes, others) if column is not None]
        return _two_pages(car, rrb.Horizontal(*columns, name="Car"), more, "More")

    def _column(self, car: str, *, lanes: bool) -> rrb.Vertical | None:
        """Half of a car's first page: what is lanes, each panel as high as it has some, or what is none."""
        panels = [panel for panel in mapping.MAIN_PANELS if bool(panel.lanes) == lanes]
        shown = [(view, 1 + self._lane_count(car, panel)) for panel in panels if (view := self._panel(car, panel))]
        return rrb.Vertical(*(view for view, _ in shown), row_shares=[share for _, share in shown]) if shown else None

    def _lane_count(self, car: str, panel: Panel) -> int:
        return sum(self._has_lane(car, lane) for lane in panel.lanes)

    def _entity(self, car: str, topic: str) -> str:
        """The entity of a topic: a service's has its own name in front, and no car."""
        if topic.startswith("@"):
            return mapping.entity(f"{self._session.fleet}/{topic}")
        return mapping.entity(keys.topic_key(self._session.fleet, car, topic))

    def _has(self, car: str, topic: str) -> bool:
        if topic.startswith("@"):
            return topic in self._session.services
        return topic in self._session.cars.get(car, ())

    def _has_lane(self, car: str, lane: StateTrack) -> bool:
        if lane.drawn:
            return (self._entity(car, lane.topic), _name(lane, car)) in self._drawn
        return self._has(car, lane.topic)

    def _fleet_text(self, name: str, ours: Iterable[str], theirs: Iterable[str]) -> rrb.View | None:
        shown = [self._entity(car, topic) for topic in ours for car in self._session.cars if self._has(car, topic)]
        shown += [self._entity("", topic) for topic in theirs if self._has("", topic)]
        return _text(name, shown) if shown else None

    def _fleet_lanes(self, name: str, lanes: Iterable[StateTrack]) -> rrb.View | None:
        shown: _Shown = {}
        for car in self._session.cars:
            for lane in lanes:
                if self._has_lane(car, lane):
                    shown.setdefault(self._entity(car, lane.topic), []).append(self._lane(lane, car))
        return self._lanes(name, shown) if shown else None

    def _panel(self, car: str, panel: Panel) -> rrb.View | None:
        """One view of a car; of a service with an empty name."""
        if panel.texts:
            texts = [self._entity(car, topic) for topic in panel.texts if self._has(car, topic)]
            return _text(panel.name, texts) if texts else None
        shown: _Shown = {}
        alone = sum(curve.how is None for curve in panel.curves) == 1
        for curve in panel.curves:
            if self._has(car, curve.topic):
                own = colour(car, sorted(self._session.cars).index(car)) if alone and car else None
                rgb = _THRESHOLDS.get(curve.how, own) if curve.how is not None else own
                shown.setdefault(self._entity(car, curve.topic), []).append(_curve(curve, curve.name, rgb))
        for lane in panel.lanes:
            if self._has_lane(car, lane):
                shown.setdefault(self._entity(car, lane.topic), []).append(self._lane(lane, car))
        if not shown:
            return None
        return self._lanes(panel.name, shown) if panel.lanes else self._curves(panel.name, shown)

    def _lane(self, lane: StateTrack, car: str) -> rrb.Visualizer:
        tints = self._leds if lane.name in _LEDS else colors.MARKS if lane == mapping.MARKS else colors.STATES
        style = rr.StateConfiguration(values=list(tints), colors=np.array(list(tints.values()), dtype=np.uint32))
        source = VisualizerComponentMapping(
            "StateChange:state", ComponentSourceKind.SourceComponent, source_component=_name(lane, car)
        )
        return style.visualizer(mappings=[source])

    def _curves(self, name: str, shown: _Shown) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin="/",
            contents=list(shown),
            name=name,
            overrides=shown,
            plot_legend=rrb.PlotLegend(visible=True),
            axis_x=self._axis,
        )

    def _lanes(self, name: str, shown: _Shown) -> rrb.StateTimelineView:
        return rrb.StateTimelineView(origin="/", contents=list(shown), name=name, overrides=shown, time_view=self._axis)

    def _world(self, low: tuple[float, float], high: tuple[float, float], wide: float) -> rrb.Spatial3DView:
        session = self._session
        contents = [
            f"{self._entity(car, mapping.TRUTH)}/**" for car, topics in session.cars.items() if mapping.TRUTH in topics
        ]
        if mapping.WORLD in session.services:
            contents.append(f"{self._entity('', mapping.WORLD)}/**")
        x, y = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
        size = max(high[1] - low[1], (high[0] - low[0]) / wide)
        # Not straight down: Rerun's eye has no sides when it looks along its own up.
        eye = rrb.EyeControls3D(
            position=(x, y - 0.01, max(_LEAST_HEIGHT_M, 1.2 * size)), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
        )
        name = "World, from above (simulated cars)"
        return rrb.Spatial3DView(origin="/", contents=contents, name=name, eye_controls=eye)


def _axis(span_ns: tuple[int, int] | None, last_s: float | None) -> rrb.TimeAxis:
    """The time in view; not linked with other views, since linked ones ignore it and show a minute."""
    at = rr.TimeRangeBoundary
    if last_s is not None:
        return rrb.TimeAxis(view_range=rr.TimeRange(at.cursor_relative(seconds=-last_s), at.cursor_relative()))
    if span_ns is None or span_ns[0] == span_ns[1]:
        return rrb.TimeAxis()
    return rrb.TimeAxis(view_range=rr.TimeRange(at.absolute(nanos=span_ns[0]), at.absolute(nanos=span_ns[1])))


def _name(lane: StateTrack, car: str) -> str:
    """The component of a lane: of roles there is one for each car, on one entity."""
    return f"{lane.name} {car}" if lane == mapping.ROLE else lane.name


def _two_pages(name: str, first: rrb.Container, others: list[rrb.View], what: str) -> rrb.Container:
    if others:
        return rrb.Tabs(first, rrb.Grid(*others, name=what), name=name, active_tab=0)
    return rrb.Tabs(first, name=name)


def _curve(curve: Curve, name: str, rgb: Rgb | None) -> rrb.Visualizer:
    made = curve.how is not None
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component=curve.name if made else component(curve.topic),
        selector="." if made else f".{curve.field}",
    )
    if TOPICS[curve.topic].family == "sensor" and not made:
        # Readings stop for as long as a mode does not send them: a line across that would look like a measurement.
        points = rr.SeriesPoints(names=name, marker_sizes=4.0, markers="circle", colors=rgb)
        return points.visualizer(mappings=[source])
    width = 1.0 if curve.how in _THRESHOLDS else 2.0
    line = rr.SeriesLines(names=name, widths=width, colors=rgb)
    return line.visualizer(mappings=[source])


def _text(name: str, entities: list[str]) -> rrb.TextLogView:
    columns = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.TextLogView(
        origin="/",
        contents=entities,
        name=name,
        columns=rrb.TextLogColumns(timeline_columns=[PUBLISHED], text_log_columns=columns),
    )

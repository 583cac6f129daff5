"""The layout of a session in Rerun's viewer: a tab for the fleet and one per car, only with views that have data."""

from dataclasses import dataclass
from typing import Any, Final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import LinkAxis
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from fleet.replay import mapping
from fleet.replay.mapping import Contents, Curve, Lane, Panel
from schemas import keys
from schemas.topics import TOPICS

TIMELINE: Final = "message_publish_time"
"""When a message was published, by its publisher's clock; the recorder's own is `message_log_time`."""

_COLOURS: Final = {
    "red": (235, 80, 80), "green": (90, 200, 110), "blue": (90, 150, 250), "yellow": (235, 205, 70),
    "orange": (245, 150, 60), "white": (230, 230, 230), "black": (130, 130, 130), "pink": (245, 130, 190),
}  # fmt: skip
_OTHERS: Final = ((80, 200, 200), (190, 130, 240), (245, 150, 60), (160, 200, 80), (230, 120, 160), (120, 160, 200))

# One meaning has one colour in every lane.
_STATES: Final = {
    "true": 0x4FB477FF, "false": 0x30343BFF,
    "online": 0x4FB477FF, "quiet": 0x5C7FA3FF, "stale": 0xE0A030FF, "lost": 0xD9534FFF,
    "confirmed": 0x4FB477FF, "assumed": 0x8A8F98FF, "contradicted": 0xD9534FFF, "unknown": 0x555A63FF,
    "manual": 0x5C7FA3FF, "tracking": 0x8E6BBFFF, "obstacle_avoidance": 0xD08A3CFF, "light_seeking": 0xC9B037FF,
    "following": 0x3C9D9BFF, "color_led": 0xC0689FFF, "remote_control": 0xA0522DFF,
    "stop": 0x30343BFF, "forward": 0x4FB477FF, "back": 0xD08A3CFF, "left": 0x5C7FA3FF, "right": 0x8E6BBFFF,
    "spin_left": 0x3C9D9BFF, "spin_right": 0xC0689FFF,
}  # fmt: skip


_LEAST_HEIGHT_M: Final = 1.5
_Shown = dict[Any, list[Any]]
"""Visualizers by entity; Any, because Rerun's mapping is invariant in a union of its own."""


def colour(car: str, index: int) -> tuple[int, int, int]:
    """A car's colour: the one it is named after, else one of its own."""
    return _COLOURS.get(car, _OTHERS[index % len(_OTHERS)])


@dataclass(frozen=True, slots=True)
class Ground:
    """The part of the world that the cars were in, m."""

    x_m: float
    y_m: float
    size_m: float


def layout(session: Contents, ground: Ground | None) -> rrb.Blueprint:
    """The whole layout of a session; `ground`: where the simulated cars were, None if there were none."""
    tabs = [_fleet_tab(session, ground)] + [_car_tab(session, car) for car in session.cars]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_views=False,
        auto_layout=False,
    )


def _entity(session: Contents, car: str, topic: str) -> str:
    return mapping.entity(keys.topic_key(session.fleet, car, topic))


def _curve(curve: Curve, name: str, rgb: tuple[int, int, int] | None) -> rrb.Visualizer:
    style = (
        rr.SeriesLines(names=name, widths=2.0) if rgb is None else rr.SeriesLines(names=name, widths=2.0, colors=rgb)
    )
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component=f"{TOPICS[curve.topic].message}:message",
        selector=f".{curve.field}",
    )
    return style.visualizer(mappings=[source])


def _lane(lane: Lane) -> rrb.Visualizer:
    style = rr.StateConfiguration(values=list(_STATES), colors=list(_STATES.values()))
    source = VisualizerComponentMapping(
        "StateChange:state", ComponentSourceKind.SourceComponent, source_component=lane.name
    )
    return style.visualizer(mappings=[source])


def _curves(name: str, shown: _Shown) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(shown),
        name=name,
        overrides=shown,
        plot_legend=rrb.PlotLegend(visible=True),
        axis_x=rrb.TimeAxis(link=LinkAxis.LinkToGlobal),
    )


def _lanes(name: str, shown: _Shown) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(origin="/", contents=list(shown), name=name, overrides=shown)


def _text(name: str, entities: list[str]) -> rrb.TextLogView:
    columns = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.TextLogView(
        origin="/",
        contents=entities,
        name=name,
        columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=columns),
    )


def _world(session: Contents, ground: Ground) -> rrb.Spatial3DView:
    cars = [car for car, topics in session.cars.items() if mapping.TRUTH in topics]
    contents = [f"{_entity(session, car, mapping.TRUTH)}/**" for car in cars]
    height = max(_LEAST_HEIGHT_M, 1.3 * ground.size_m)
    # Not straight down: Rerun's eye has no sides when it looks along its own up.
    eye = rrb.EyeControls3D(
        position=(ground.x_m, ground.y_m - 0.01, height),
        look_target=(ground.x_m, ground.y_m, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )
    return rrb.Spatial3DView(origin="/", contents=contents, name="World, from above (simulated cars)", eye_controls=eye)


def _fleet_tab(session: Contents, ground: Ground | None) -> rrb.Container:
    rows: list[rrb.View | rrb.Container] = []
    lanes: _Shown = {}
    for car, topics in session.cars.items():
        for lane in (mapping.MODE_ASKED, mapping.MODE_INFERRED, mapping.LINK):
            if lane.topic in topics:
                lanes.setdefault(_entity(session, car, lane.topic), []).append(_lane(lane))
    for name, curve in (("Distance (m)", mapping.DISTANCE), ("Battery (V)", mapping.BATTERY)):
        shown = {
            _entity(session, car, curve.topic): [_curve(curve, car, colour(car, index))]
            for index, (car, topics) in enumerate(session.cars.items())
            if curve.topic in topics
        }
        if shown:
            rows.append(_curves(name, shown))
    texts = [
        _entity(session, car, topic)
        for car, topics in session.cars.items()
        for topic in ("event/command", "event/log")
        if topic in topics
    ]
    texts += [mapping.entity(f"{session.fleet}/{topic}") for topic in sorted(session.services & _worded())]
    left: list[rrb.View | rrb.Container] = [_world(session, ground)] if ground is not None else []
    if texts:
        left.append(_text("Commands, log, decisions", texts))
    if lanes:
        rows.insert(0, _lanes("Mode and link", lanes))
    # The lanes of every car need room; the curves share a view.
    shares = [2 if isinstance(view, rrb.StateTimelineView) else 1 for view in rows]
    columns = [
        rrb.Vertical(*column, row_shares=parts) for column, parts in ((left, [1] * len(left)), (rows, shares)) if column
    ]
    return rrb.Horizontal(*columns, name="Fleet")


def _worded() -> frozenset[str]:
    return frozenset(words.topic for words in mapping.WORDS)


def _car_tab(session: Contents, car: str) -> rrb.Container:
    main = [view for panel in mapping.CAR_PANELS[: mapping.MAIN_PANELS] if (view := _panel(session, car, panel))]
    more = [view for panel in mapping.CAR_PANELS[mapping.MAIN_PANELS :] if (view := _panel(session, car, panel))]
    grid = rrb.Grid(*main, grid_columns=2, name="Car")
    if not more:
        return rrb.Grid(*main, grid_columns=2, name=car)
    return rrb.Tabs(grid, rrb.Grid(*more, name="More"), name=car, active_tab=0)


def _panel(session: Contents, car: str, panel: Panel) -> rrb.View | None:
    has = session.cars[car]
    if panel.texts:
        texts = [_entity(session, car, topic) for topic in panel.texts if topic in has]
        return _text(panel.name, texts) if texts else None
    shown: _Shown = {}
    for curve in panel.curves:
        if curve.topic in has:
            rgb = colour(car, sorted(session.cars).index(car)) if len(panel.curves) == 1 else None
            shown.setdefault(_entity(session, car, curve.topic), []).append(_curve(curve, curve.name, rgb))
    for lane in panel.lanes:
        if lane.topic in has:
            shown.setdefault(_entity(session, car, lane.topic), []).append(_lane(lane))
    if not shown:
        return None
    return _lanes(panel.name, shown) if panel.lanes else _curves(panel.name, shown)

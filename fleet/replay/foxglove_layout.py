"""Builds a layout for Foxglove (and Lichtblick) from the tables in panels.py.

`python -m fleet.replay.foxglove_layout [CAR ...] > LAYOUT.json` writes it.

`deploy/foxglove.json` is the layout for the cars of `make demo`. Foxglove draws only fields of messages, so the layout
leaves out everything that lenses.py or drawings.py derives. Where Rerun shows lines of text that we compose, Foxglove
shows the raw messages.
"""

import json
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, Final

from fleet.replay import panels
from fleet.replay.panels import Curve, Derivation, Panel, StateTrack
from schemas import keys
from schemas.colors import car_color, hex_color
from schemas.topics import TOPICS

DEMO_CARS: Final = ("red", "green", "blue")
GRID_COLUMNS: Final = 2
LOG: Final = "foxglove.Log"
_UNQUOTED: Final = re.compile(r"[A-Za-z0-9_/]+")
"""Topic names that need no quotes in a message path."""


class _FoxgloveLayout:
    """Builds a layout. `panels` collects its panels by id."""

    def __init__(self, fleet: str, cars: Sequence[str]) -> None:
        self._fleet = fleet
        self._tints = {car: {"color": hex_color(car_color(car, index))} for index, car in enumerate(cars)}
        self.panels: dict[str, Any] = {}

    def add(self, kind: str, name: str, config: dict[str, Any]) -> str:
        """Add a panel, and return the id by which the layout refers to it."""
        panel = f"{kind}!{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}"
        assert panel not in self.panels, panel
        self.panels[panel] = {"foxglovePanelTitle": name, **config}
        return panel

    def key(self, car: str, topic: str) -> str:
        """Return the key of a topic of a car or a service. The topic of a service begins with `@` and its name."""
        return f"{self._fleet}/{topic}" if topic.startswith("@") else keys.topic_key(self._fleet, car, topic)

    def path(self, car: str, part: Curve | StateTrack) -> str:
        """Return the message path of a field in Foxglove's syntax."""
        return f"{_quote_if_needed(self.key(car, part.topic))}.{part.field.rstrip('!')}"

    def add_plot(self, name: str, lines: Iterable[tuple[str, Curve, str]]) -> str:
        """Add a plot of curves, given as (car, curve, label)."""
        every = list(lines)
        # With one curve per car, each curve has the color of its car. Otherwise Foxglove picks the colors.
        tinted = len({car for car, _, _ in every}) == len(every)
        paths = [
            {**_series(self.path(car, curve), label), **(self._tints.get(car, {}) if tinted else {})}
            for car, curve, label in every
        ]
        return self.add("Plot", name, {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"})

    def add_states(self, name: str, tracks: Iterable[tuple[str, StateTrack, str]]) -> str:
        """Add a view of states over time, given as (car, track, label)."""
        paths = [_series(self.path(car, track), label) for car, track, label in tracks]
        return self.add("StateTransitions", name, {"paths": paths, "isSynced": True})

    def add_messages(self, name: str, topic: str, car: str = "") -> str:
        """Add a view of a topic's messages: the lines of a log, or the raw messages of any other topic."""
        key = self.key(car, topic)
        if TOPICS[topic].message == LOG:
            return self.add("RosOut", name, {"topicToRender": key, "minLogLevel": 1, "searchTerms": []})
        return self.add("RawMessages", name, {"topicPath": _quote_if_needed(key), "diffEnabled": False})

    def add_panel(self, car: str, panel: Panel) -> list[str]:
        """Add the parts of a panel that Foxglove can show, and return their ids. An empty `car` means a service."""
        name = f"{car} {panel.name}".strip()
        tracks = [(car, track, track.name) for track in panel.tracks if _can_draw(track)]
        curves = [(car, curve, curve.name) for curve in panel.curves if _can_draw(curve)]
        added = []
        if tracks:
            added.append(self.add_states(name, tracks))
        elif curves:
            added.append(self.add_plot(name, curves))
        added += [self.add_messages(f"{car} {topic}", topic, car) for topic in panel.texts]
        return added


def layout(cars: Sequence[str] = DEMO_CARS, fleet: str = keys.DEFAULT_FLEET) -> dict[str, Any]:
    """Return the layout of a fleet: a tab for the fleet, a tab for each car and a tab for the services."""
    builder = _FoxgloveLayout(fleet, cars)
    overview = [
        builder.add_states(
            name, [(car, track, f"{car} {track.name}") for car in cars for track in tracks if _can_draw(track)]
        )
        for name, tracks in panels.FLEET_TRACKS
    ]
    overview += [builder.add_plot(name, [(car, curve, car) for car in cars]) for name, curve in panels.FLEET_CURVES]
    services = [each for panel in panels.SERVICE_PANELS for each in builder.add_panel("", panel)]
    services += [builder.add_messages(topic, topic) for topic in TOPICS if topic.startswith("@")]
    each_car = [[each for panel in panels.CAR_PANELS for each in builder.add_panel(car, panel)] for car in cars]
    grids = map(_grid, (overview, *each_car, services))
    tabs = [{"title": title, "layout": grid} for title, grid in zip(("Fleet", *cars, "Services"), grids, strict=True)]
    root = builder.add("Tab", "tabs", {"activeTabIdx": 0, "tabs": tabs})
    return {
        "configById": builder.panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": root,
    }


def layout_text(cars: Sequence[str] = DEMO_CARS, fleet: str = keys.DEFAULT_FLEET) -> str:
    """Return a fleet's layout as the text of the file that Foxglove imports."""
    return json.dumps(layout(cars, fleet), indent=1) + "\n"


def _quote_if_needed(key: str) -> str:
    return key if _UNQUOTED.fullmatch(key) else json.dumps(key)


def _can_draw(part: Curve | StateTrack) -> bool:
    """Return True if Foxglove can draw the part from a field of the message."""
    return part.derivation in (None, Derivation.TEXT_OR_NOTHING) and not (isinstance(part, StateTrack) and part.drawn)


def _series(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _grid(names: Sequence[str]) -> Any:
    """Arrange panels of equal size in rows of GRID_COLUMNS panels."""
    rows = [_split("row", names[at : at + GRID_COLUMNS]) for at in range(0, len(names), GRID_COLUMNS)]
    return _split("column", rows)


def _split(direction: str, parts: Sequence[Any]) -> Any:
    if len(parts) == 1:
        return parts[0]
    rest = _split(direction, parts[1:])
    return {"direction": direction, "first": parts[0], "second": rest, "splitPercentage": 100 / len(parts)}


if __name__ == "__main__":
    sys.stdout.write(layout_text(sys.argv[1:] or DEMO_CARS))

"""Builds a layout for Foxglove (and Lichtblick) from the tables in panels.py.

`python -m fleet.replay.foxglove_layout [CAR ...] > LAYOUT.json` writes it.

`deploy/foxglove.json` is the layout for the cars of `make demo`. Foxglove draws only fields of messages: everything
that lenses.py or drawings.py derive is left out, and messages with text lines in Rerun are shown raw.
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
_PLAIN: Final = re.compile(r"[A-Za-z0-9_/]+")
"""Topic names that need no quotes in a message path."""


class _FoxgloveLayout:
    """Builder of a layout. `panels` collects its panels by id."""

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
        """Return the key of a topic. The topic of a service begins with its name."""
        return f"{self._fleet}/{topic}" if topic.startswith("@") else keys.topic_key(self._fleet, car, topic)

    def path(self, car: str, part: Curve | StateTrack) -> str:
        """Return the message path of a field in Foxglove's syntax."""
        key = self.key(car, part.topic)
        return f"{key if _PLAIN.fullmatch(key) else json.dumps(key)}.{part.field.rstrip('!')}"

    def plot(self, name: str, lines: Iterable[tuple[str, Curve, str]]) -> str:
        """Add a plot of curves, given as (car, curve, label)."""
        every = list(lines)
        # With one curve per car, each has the color of its car. Else Foxglove picks the colors.
        tinted = len({car for car, _, _ in every}) == len(every)
        paths = [
            {**_series(self.path(car, curve), label), **(self._tints.get(car, {}) if tinted else {})}
            for car, curve, label in every
        ]
        return self.add("Plot", name, {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"})

    def states(self, name: str, tracks: Iterable[tuple[str, StateTrack, str]]) -> str:
        """Add a view of states over time, given as (car, track, label)."""
        paths = [_series(self.path(car, track), label) for car, track, label in tracks]
        return self.add("StateTransitions", name, {"paths": paths, "isSynced": True})

    def messages(self, name: str, key: str) -> str:
        """Add a view of raw messages."""
        path = key if _PLAIN.fullmatch(key) else json.dumps(key)
        return self.add("RawMessages", name, {"topicPath": path, "diffEnabled": False})

    def log(self, name: str, key: str) -> str:
        """Add a log view of foxglove.Log messages."""
        return self.add("RosOut", name, {"topicToRender": key, "minLogLevel": 1, "searchTerms": []})

    def panel(self, car: str, panel: Panel) -> list[str]:
        """Add the views that Foxglove can show of a panel of a car (empty: of a service), and return their ids."""
        name = f"{car} {panel.name}".strip()
        tracks = [(car, track, track.name) for track in panel.tracks if plain(track)]
        curves = [(car, curve, curve.name) for curve in panel.curves if plain(curve)]
        found = [self.states(name, tracks)] if tracks else [self.plot(name, curves)] if curves else []
        for topic in panel.texts:
            add = self.log if TOPICS[topic].message == LOG else self.messages
            found.append(add(f"{car} {topic}", self.key(car, topic)))
        return found


def layout(cars: Sequence[str] = DEMO_CARS, fleet: str = keys.DEFAULT_FLEET) -> dict[str, Any]:
    """Return the layout of a fleet: a tab for the fleet, one for each car, one for the services."""
    builder = _FoxgloveLayout(fleet, cars)
    glance = [
        builder.states(name, [(car, track, f"{car} {track.name}") for car in cars for track in tracks if plain(track)])
        for name, tracks in panels.FLEET_TRACKS
    ]
    glance += [builder.plot(name, [(car, curve, car) for car in cars]) for name, curve in panels.FLEET_CURVES]
    services = [each for panel in panels.SERVICE_PANELS for each in builder.panel("", panel)]
    for topic in (topic for topic in TOPICS if topic.startswith("@")):
        add = builder.log if TOPICS[topic].message == LOG else builder.messages
        services.append(add(topic, builder.key("", topic)))
    each_car = [[each for panel in panels.CAR_PANELS for each in builder.panel(car, panel)] for car in cars]
    tabs = zip(("Fleet", *cars, "Services"), map(_grid, (glance, *each_car, services)), strict=True)
    root = builder.add("Tab", "tabs", {"activeTabIdx": 0, "tabs": [{"title": name, "layout": at} for name, at in tabs]})
    return {
        "configById": builder.panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": root,
    }


def layout_text(cars: Sequence[str] = DEMO_CARS, fleet: str = keys.DEFAULT_FLEET) -> str:
    """Return the file of the layout of a fleet."""
    return json.dumps(layout(cars, fleet), indent=1) + "\n"


def plain(part: Curve | StateTrack) -> bool:
    """Return True if Foxglove can draw the part from a field of the message."""
    return part.derivation in (None, Derivation.TEXT_OR_NOTHING) and not (isinstance(part, StateTrack) and part.drawn)


def _series(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _grid(names: Sequence[str]) -> Any:
    """Arrange panels in rows of GRID_COLUMNS of equal size."""
    rows = [_split("row", names[at : at + GRID_COLUMNS]) for at in range(0, len(names), GRID_COLUMNS)]
    return _split("column", rows)


def _split(direction: str, parts: Sequence[Any]) -> Any:
    if len(parts) == 1:
        return parts[0]
    rest = _split(direction, parts[1:])
    return {"direction": direction, "first": parts[0], "second": rest, "splitPercentage": 100 / len(parts)}


if __name__ == "__main__":
    sys.stdout.write(layout_text(sys.argv[1:] or DEMO_CARS))

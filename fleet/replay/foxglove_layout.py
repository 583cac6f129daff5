"""A layout for Foxglove (and Lichtblick) of the same tables.

`python -m fleet.replay.foxglove_layout [CAR ...] > LAYOUT.json` writes it.

Pure but for the printing. `deploy/foxglove.json` is that of the cars of `make demo`. Foxglove draws fields as they are:
what lenses or drawing.py make is left out, and messages that are put into words for Rerun are shown as they are.
"""

import json
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, Final

from fleet.replay import panels as mapping
from fleet.replay.colors import colour
from fleet.replay.panels import Curve, How, Panel, StateTrack
from schemas import keys
from schemas.topics import TOPICS

CARS: Final = ("red", "green", "blue")
COLUMNS: Final = 2
LOG: Final = "foxglove.Log"
_PLAIN: Final = re.compile(r"[A-Za-z0-9_/]+")
"""Names of topics that need no quotes in a message path."""


class _FoxgloveLayout:
    """Panels by id, as they are made."""

    def __init__(self, fleet: str) -> None:
        self._fleet = fleet
        self.panels: dict[str, Any] = {}

    def add(self, kind: str, name: str, config: dict[str, Any]) -> str:
        """A panel; its id, by which a place in the layout names it."""
        panel = f"{kind}!{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}"
        assert panel not in self.panels, panel
        self.panels[panel] = {"foxglovePanelTitle": name, **config}
        return panel

    def key(self, car: str, topic: str) -> str:
        """The key of a topic: a service's has its own name in front."""
        return f"{self._fleet}/{topic}" if topic.startswith("@") else keys.topic_key(self._fleet, car, topic)

    def path(self, car: str, part: Curve | StateTrack) -> str:
        """Foxglove's path of a field."""
        key = self.key(car, part.topic)
        return f"{key if _PLAIN.fullmatch(key) else json.dumps(key)}.{part.field.rstrip('!')}"

    def plot(self, name: str, lines: Iterable[tuple[str, Curve, str]]) -> str:
        """Curves over time, of (car, curve, what it is called)."""
        every = list(lines)
        # A car has its colour among others; several curves of one car each have one of their own.
        tinted = len({car for car, _, _ in every}) == len(every)
        paths = [
            {**_shown(self.path(car, curve), label), **(_tint(car) if tinted else {})} for car, curve, label in every
        ]
        return self.add("Plot", name, {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"})

    def states(self, name: str, lanes: Iterable[tuple[str, StateTrack, str]]) -> str:
        """States over time, of (car, lane, what it is called)."""
        paths = [_shown(self.path(car, lane), label) for car, lane, label in lanes]
        return self.add("StateTransitions", name, {"paths": paths, "isSynced": True})

    def messages(self, name: str, key: str) -> str:
        """Messages as they are."""
        path = key if _PLAIN.fullmatch(key) else json.dumps(key)
        return self.add("RawMessages", name, {"topicPath": path, "diffEnabled": False})

    def log(self, name: str, key: str) -> str:
        """A log of foxglove.Log."""
        return self.add("RosOut", name, {"topicToRender": key, "minLogLevel": 1, "searchTerms": []})

    def panel(self, car: str, panel: Panel) -> list[str]:
        """What Foxglove can show of one of a car's (or, with an empty name, a service's) views."""
        name = f"{car} {panel.name}".strip()
        lanes = [(car, lane, lane.name) for lane in panel.lanes if plain(lane)]
        curves = [(car, curve, curve.name) for curve in panel.curves if plain(curve)]
        found = [self.states(name, lanes)] if lanes else [self.plot(name, curves)] if curves else []
        for topic in panel.texts:
            add = self.log if TOPICS[topic].message == LOG else self.messages
            found.append(add(f"{car} {topic}", self.key(car, topic)))
        return found


def layout(cars: Sequence[str] = CARS, fleet: str = keys.DEFAULT_FLEET) -> dict[str, Any]:
    """The layout of a fleet of these cars: a tab for the fleet, one for each car, one for the services."""
    made = _FoxgloveLayout(fleet)
    glance = [
        made.states(name, [(car, lane, f"{car} {lane.name}") for car in cars for lane in lanes if plain(lane)])
        for name, lanes in mapping.FLEET_LANES
    ]
    glance += [made.plot(name, [(car, curve, car) for car in cars]) for name, curve in mapping.FLEET_CURVES]
    services = [each for panel in mapping.SERVICE_PANELS for each in made.panel("", panel)]
    for topic in (topic for topic in TOPICS if topic.startswith("@")):
        add = made.log if TOPICS[topic].message == LOG else made.messages
        services.append(add(topic, made.key("", topic)))
    each_car = [[each for panel in mapping.CAR_PANELS for each in made.panel(car, panel)] for car in cars]
    tabs = zip(("Fleet", *cars, "Services"), map(_grid, (glance, *each_car, services)), strict=True)
    root = made.add("Tab", "tabs", {"activeTabIdx": 0, "tabs": [{"title": name, "layout": at} for name, at in tabs]})
    return {
        "configById": made.panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": root,
    }


def plain(part: Curve | StateTrack) -> bool:
    """Whether it is a field as it is."""
    return part.how in (None, How.TEXT_OR_NOTHING) and not (isinstance(part, StateTrack) and part.drawn)


def _shown(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _tint(car: str) -> dict[str, str]:
    """The colour of a car that is named after one."""
    return {"color": "#{:02x}{:02x}{:02x}".format(*colour(car, CARS.index(car)))} if car in CARS else {}


def _grid(panels: Sequence[str]) -> Any:
    """Rows of COLUMNS, all alike."""
    rows = [_split("row", panels[at : at + COLUMNS]) for at in range(0, len(panels), COLUMNS)]
    return _split("column", rows)


def _split(direction: str, parts: Sequence[Any]) -> Any:
    if len(parts) == 1:
        return parts[0]
    rest = _split(direction, parts[1:])
    return {"direction": direction, "first": parts[0], "second": rest, "splitPercentage": 100 / len(parts)}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(layout(sys.argv[1:] or CARS), indent=1) + "\n")

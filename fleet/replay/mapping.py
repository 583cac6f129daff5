"""What each message looks like in Rerun: which fields are curves, lanes and lines of text. Pure tables, no Rerun here.

A curve is a number over time; a lane a state over time; words a line in a log. What is in no table is still in the file
(every message is, as it was), for Rerun's dataframe view. Entities are the keys themselves: `/fleet/red/sensor/range`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from schemas import keys
from schemas.topics import TOPICS


@dataclass(frozen=True, slots=True)
class Curve:
    """One number of a topic."""

    topic: str
    field: str
    """Selector inside the message. One that ends in ! leaves out what was not measured, instead of drawing a zero."""
    name: str


@dataclass(frozen=True, slots=True)
class Lane:
    """One state of a topic; `name` is its component in the .rrd, and what the lane is called."""

    topic: str
    field: str
    name: str


@dataclass(frozen=True, slots=True)
class Words:
    """A line of text made of fields, in order, without those that are empty."""

    topic: str
    fields: tuple[str, ...]
    alarm_field: str = ""
    alarm_values: frozenset[str] = frozenset()
    """Values of `alarm_field` that make the line a warning."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One view of a car's tab, in the order of the tab."""

    name: str
    curves: tuple[Curve, ...] = ()
    lanes: tuple[Lane, ...] = ()
    texts: tuple[str, ...] = ()
    """Topics whose lines of text are shown together."""

    @property
    def topics(self) -> frozenset[str]:
        """Topics it shows."""
        return frozenset(
            [curve.topic for curve in self.curves] + [lane.topic for lane in self.lanes] + list(self.texts)
        )


def _unit(topic: str, field: str) -> str:
    return TOPICS[topic].units[field.rstrip("!")]


DISTANCE: Final = Curve("sensor/range", "range_m!", f"distance ({_unit('sensor/range', 'range_m')})")
BATTERY: Final = Curve("sensor/battery", "voltage_v", f"battery ({_unit('sensor/battery', 'voltage_v')})")
MODE_ASKED: Final = Lane("state/mode", "asked", "mode asked")
MODE_INFERRED: Final = Lane("state/mode", "inferred", "mode inferred")
MOTION: Final = Lane("state/motion", "motion", "motion")
LINK: Final = Lane("state/link", "state", "link")

CAR_PANELS: Final = (
    Panel(
        "Mode, motion, link",
        lanes=(MODE_ASKED, MODE_INFERRED, Lane("state/mode", "verdict", "verdict"), MOTION, LINK),
    ),
    Panel("Distance", curves=(DISTANCE,)),
    Panel(
        "Line, obstacle, light",
        lanes=(
            *(Lane("sensor/line", f, f"line {f.replace('_', ' ')}") for f in
              ("left_outer", "left_inner", "right_inner", "right_outer")),
            Lane("sensor/obstacle", "left", "obstacle left"),
            Lane("sensor/obstacle", "right", "obstacle right"),
            Lane("sensor/light", "left", "light left"),
            Lane("sensor/light", "right", "light right"),
        ),
    ),
    Panel("Battery", curves=(BATTERY,)),
    Panel("Commands", texts=("event/command",)),
    Panel("Log", texts=("event/log",)),
    Panel("Grayscale", curves=(Curve("sensor/grayscale", "raw", "grayscale (raw)"),)),
    Panel("Gyroscope", curves=tuple(Curve("sensor/imu", f"gyro_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Acceleration", curves=tuple(Curve("sensor/imu", f"accel_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Arm", curves=tuple(Curve("sensor/arm", f"joint_deg[{n}]", f"J{n + 1} (deg)") for n in range(6))),
    Panel(
        "Gateway",
        curves=(Curve("state/health", "loop_lag_s", "loop lag (s)"), Curve("state/health", "cpu", "CPU (cores)")),
    ),
)  # fmt: skip
"""A car's tab. The first six make its main page, the rest the pages beside it."""
MAIN_PANELS: Final = 6

WORDS: Final = (
    Words(
        "event/command",
        ("car", "verb", "phase", "reason", "words"),
        "phase",
        frozenset({"rejected", "failed", "expired", "superseded"}),
    ),
    Words("@coordinator/decision", ("subject", "decided", "why")),
    Words("@coordinator/plan", ("version", "text")),
)
"""`event/log` needs none: Rerun reads foxglove.Log as text by itself."""

TRUTH: Final = "sim/truth"


@dataclass(frozen=True, slots=True)
class Contents:
    """What a session has: topics by car, and of the fleet's services."""

    fleet: str
    cars: Mapping[str, frozenset[str]]
    services: frozenset[str]


def contents(recorded: frozenset[str]) -> Contents:
    """Sort a session's keys; what is not one of the table's topics has no place in the layout."""
    cars: dict[str, set[str]] = {}
    services: set[str] = set()
    fleets: list[str] = []
    for text in sorted(recorded):
        key = keys.parse(text)
        if key is None:
            continue
        if key.car.startswith("@"):
            if f"{key.car}/{key.topic}" in TOPICS:
                services.add(f"{key.car}/{key.topic}")
                fleets.append(key.fleet)
        elif key.topic in TOPICS:
            cars.setdefault(key.car, set()).add(key.topic)
            fleets.append(key.fleet)
    return Contents(
        fleet=fleets[0] if fleets else keys.DEFAULT_FLEET,
        cars=MappingProxyType({car: frozenset(topics) for car, topics in sorted(cars.items())}),
        services=frozenset(services),
    )


def entity(key: str) -> str:
    """The Rerun entity of a key, as Rerun's MCAP reader names it: what is no word character is escaped."""
    return "/" + "/".join(
        "".join(c if c.isalnum() or c in "-_." else f"\\{c}" for c in part) for part in key.split("/")
    )


def key_of(path: str) -> str:
    """The key of an entity; the inverse of `entity`."""
    return path.replace("\\", "").lstrip("/")

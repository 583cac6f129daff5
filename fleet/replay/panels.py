"""What each message looks like in Rerun: which fields are curves, lanes and lines of text. Pure tables, no Rerun here.

A curve is a number over time; a lane a state over time; words a line in a log. What is in no table is still in the file
(every message is, as it was), for Rerun's dataframe view. Entities are the keys themselves: `/fleet/red/sensor/range`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from fleet.fleetfile.models import CRITICAL_V, LOW_V
from schemas import keys
from schemas.topics import TOPICS


@dataclass(frozen=True, slots=True)
class Curve:
    """One number of a topic."""

    topic: str
    field: str
    """Selector inside the message. One that ends in ! leaves out what was not measured, instead of drawing a zero."""
    name: str
    how: "How | None" = None
    """None: the field as it is, which the viewer reads from the message itself."""


class How(StrEnum):
    """What a lens makes of a field that is not shown as it is."""

    TEXT_OR_NOTHING = "text_or_nothing"
    """A text; an empty one is nothing."""
    WHO_AND_WHY = "who_and_why"
    """A list of e-stops: who gave them, and why; nothing if there is none."""
    TOTAL = "total"
    """The sum of a map's values."""
    LOW = "low"
    CRITICAL = "critical"
    """A line at the battery's threshold."""


@dataclass(frozen=True, slots=True)
class StateTrack:
    """One state of a topic; `name` is its component in the .rrd, and what the lane is called."""

    topic: str
    field: str
    name: str
    how: How | None = None
    drawn: bool = False
    """Made by drawing.py of several fields or messages; `field` is the first of them."""


@dataclass(frozen=True, slots=True)
class Words:
    """A line of text made of fields, in order, without those that are empty."""

    topic: str
    fields: tuple[str, ...]
    alarm_field: str = ""
    before: Mapping[str, str] = field(default_factory=dict)
    """What stands in front of a field, if it is not empty."""
    calm: frozenset[str] = frozenset()
    """Values of `alarm_field` that are as it should be; with any other the line is a warning."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One view: curves, or lanes, or lines of text."""

    name: str
    curves: tuple[Curve, ...] = ()
    lanes: tuple[StateTrack, ...] = ()
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


def _lanes(topic: str, what: str, *fields: str) -> tuple[StateTrack, ...]:
    return tuple(StateTrack(topic, field, f"{what} {field.replace('_', ' ')}".strip()) for field in fields)


TRUTH: Final = "sim/truth"
WORLD: Final = "@sim/world"
COMMANDS: Final = "event/command"
ASSIGNMENT: Final = "@coordinator/assignment"
PLAN: Final = "@coordinator/plan"

DISTANCE: Final = Curve("sensor/range", "range_m!", f"distance ({_unit('sensor/range', 'range_m')})")
BATTERY: Final = Curve("sensor/battery", "voltage_v", f"battery ({_unit('sensor/battery', 'voltage_v')})")
LOW: Final = Curve("sensor/battery", "voltage_v", f"low, by default {LOW_V:g} V", How.LOW)
CRITICAL: Final = Curve("sensor/battery", "voltage_v", f"critical, by default {CRITICAL_V:g} V", How.CRITICAL)
MODE_ASKED: Final = StateTrack("state/mode", "asked", "mode asked")
MODE_INFERRED: Final = StateTrack("state/mode", "inferred", "mode inferred")
MODE_TRUE: Final = StateTrack(TRUTH, "mode", "mode true")
VERDICT: Final = StateTrack("state/mode", "verdict", "verdict")
MOTION: Final = StateTrack("state/motion", "motion", "motion")
LINK: Final = StateTrack("state/link", "state", "link")
ESTOPS: Final = StateTrack("state/safety", "estops", "e-stop", How.WHO_AND_WHY)
HOLD: Final = StateTrack("state/safety", "hold.by", "hold", How.TEXT_OR_NOTHING)
LEASE: Final = StateTrack("state/safety", "lease.holder", "driven by", How.TEXT_OR_NOTHING)
MARKS: Final = StateTrack(COMMANDS, "verb", "commands", drawn=True)
LED_ASKED: Final = StateTrack(COMMANDS, "request", "LED asked", drawn=True)
LED_TRUE: Final = StateTrack(TRUTH, "led", "LED true")
ROLE: Final = StateTrack(ASSIGNMENT, "roles", "role", drawn=True)
"""On the assignment's entity, one lane per car: `role red`."""
PHASE: Final = StateTrack(ASSIGNMENT, "phase", "phase of the plan", How.TEXT_OR_NOTHING)

MAIN_PANELS: Final = (
    Panel(
        "Mode, motion, link",
        lanes=(
            MODE_ASKED,
            MODE_INFERRED,
            MODE_TRUE,
            VERDICT,
            MOTION,
            StateTrack("state/safety", "motors", "motors"),
            LINK,
        ),
    ),
    Panel("Distance", curves=(DISTANCE,)),
    Panel(
        "Line, obstacle, light",
        lanes=(
            *_lanes("sensor/line", "line", "left_outer", "left_inner", "right_inner", "right_outer"),
            *_lanes("sensor/obstacle", "obstacle", "left", "right"),
            *_lanes("sensor/light", "light", "left", "right"),
        ),
    ),
    Panel("Battery", curves=(BATTERY, LOW, CRITICAL)),
    Panel("Commands, holds, e-stops", lanes=(MARKS, LEASE, HOLD, ESTOPS, ROLE, LED_ASKED, LED_TRUE)),
    Panel("What happened", texts=(COMMANDS, "event/log")),
)
"""The page of a car's tab that is seen first, two beside each other."""

MORE_PANELS: Final = (
    Panel("Gyroscope", curves=tuple(Curve("sensor/imu", f"gyro_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Acceleration", curves=tuple(Curve("sensor/imu", f"accel_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Arm", curves=tuple(Curve("sensor/arm", f"joint_deg[{n}]", f"J{n + 1} (deg)") for n in range(6))),
    Panel("Grayscale", curves=(Curve("sensor/grayscale", "raw", "grayscale (raw)"),)),
    Panel("Speed (estimate)", curves=(Curve("state/motion", "speed", "speed (0 to 1)"),)),
    Panel("Servo", curves=(Curve("state/motion", "servo_deg!", "number sent (deg)"),)),
    Panel(
        "Motors in truth",
        curves=(Curve(TRUTH, "motor_left", "left (PWM)"), Curve(TRUTH, "motor_right", "right (PWM)")),
    ),
    Panel(
        "Link",
        curves=(
            Curve("state/link", "tx_airtime", "airtime (share)"),
            Curve("state/link", "rejects", "frames rejected", How.TOTAL),
            Curve("state/link", "reconnects", "reconnects"),
        ),
    ),
    Panel(
        "Gateway",
        curves=(
            Curve("state/health", "loop_lag_s", "loop lag (s)"),
            Curve("state/health", "cpu", "CPU (cores)"),
            Curve("state/health", "bus_drops", "dropped to the bus"),
        ),
    ),
    Panel(
        "Battery, fan, bumps, platform",
        lanes=(
            StateTrack("sensor/battery", "level", "battery level"),
            StateTrack("state/motion", "fan", "fan"),
            StateTrack(TRUTH, "blocked", "blocked in truth"),
            StateTrack("state/health", "platform", "platform"),
        ),
    ),
    Panel("Raw frames", texts=("frame/rx", "frame/tx")),
)
"""The other page of a car's tab."""

CAR_PANELS: Final = MAIN_PANELS + MORE_PANELS

FLEET_LANES: Final = (
    ("Mode and link", (MODE_ASKED, MODE_INFERRED, MODE_TRUE, LINK)),
    ("Commands, holds, e-stops", (MARKS, LEASE, HOLD, ESTOPS, ROLE)),
)
"""(name, of every car), on the fleet's tab."""
FLEET_CURVES: Final = (("Distance (m)", DISTANCE), ("Battery (V)", BATTERY))
FLEET_TEXTS: Final = (
    ("Decisions and why", (), ("@coordinator/decision", ASSIGNMENT, "@recorder/mark")),
    ("Commands and log", (COMMANDS, "event/log"), ("@coordinator/log",)),
)
"""(name, topics of every car, topics of services)."""

SERVICE_PANELS: Final = (
    Panel(
        "Plan, recorder, supervisor",
        lanes=(
            PHASE,
            StateTrack("@recorder/status", "state", "recorder"),
            StateTrack("@recorder/status", "error", "recorder's error", How.TEXT_OR_NOTHING),
            StateTrack("@supervisor/status", "state", "fleet up"),
        ),
    ),
    Panel("Recorded", curves=(Curve("@recorder/status", "messages", "messages"),)),
    Panel(
        "Lost",
        curves=(
            Curve("@recorder/status", "drops", "dropped by the recorder", How.TOTAL),
            Curve("@recorder/status", "missed", "missed on the bus", How.TOTAL),
        ),
    ),
    Panel("Free on the disk", curves=(Curve("@recorder/status", "free_bytes", "free (B)"),)),
)
"""The page of the fleet's own services."""

WORDS: Final = (
    Words(
        COMMANDS,
        ("car", "verb", "phase", "reason", "words", "sender"),
        "phase",
        {"sender": "by "},
        frozenset({"asked", "queued", "sent", "effect_seen", "complete"}),
    ),
    Words(
        "@coordinator/decision",
        ("subject", "decided", "why", "would_change"),
        before={"would_change": "- changes with: "},
    ),
    Words(ASSIGNMENT, ("roles", "phase")),
    Words("frame/rx", ("data", "verdict"), "verdict", calm=frozenset({"sensors", "arm", "imu", "echo"})),
    Words("frame/tx", ("data", "why", "command_id")),
)
"""`event/log` needs none: Rerun reads foxglove.Log as text by itself."""


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


def parts() -> Iterator[Curve | StateTrack]:
    """Every curve and lane of the tables, each once."""
    every: list[Curve | StateTrack] = [curve for _, curve in FLEET_CURVES]
    for _, lanes in FLEET_LANES:
        every += lanes
    for panel in (*CAR_PANELS, *SERVICE_PANELS):
        every += (*panel.curves, *panel.lanes)
    yield from dict.fromkeys(every)


def topic_of(key: str) -> str:
    """The topic of a key in the table, of a car or of a service; of another key what may stand there."""
    found = keys.parse(key)
    if found is None:
        return ""
    return f"{found.car}/{found.topic}" if found.car.startswith("@") else found.topic


def entity(key: str) -> str:
    """The Rerun entity of a key, as Rerun's MCAP reader names it: what is no word character is escaped."""
    return "/" + "/".join(
        "".join(c if c.isalnum() or c in "-_." else f"\\{c}" for c in part) for part in key.split("/")
    )


def key_of(path: str) -> str:
    """The key of an entity; the inverse of `entity`."""
    return path.replace("\\", "").lstrip("/")

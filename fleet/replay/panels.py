"""Tables of the views: which field is drawn as a curve, as a state track or as a line of text. Pure, and without Rerun.

A curve shows a number over time. A track shows a state over time. A text line is an entry of a log. A topic that has no
row here is in the .rrd (Rerun's file) all the same, and Rerun's dataframe view shows it. Rerun calls the place of data
an entity. That of a key is the key with a `/` in front, escaped: `/fleet/red/sensor/range`.
"""

from collections.abc import Iterator, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from msgspec import Struct, field

from schemas import keys
from schemas.battery_levels import CRITICAL_V, LOW_V
from schemas.topics import CAR_TOPICS, TOPICS, Topic
from schemas.words import FrameVerdict, Phase


class Curve(Struct, frozen=True):
    """One number of a topic."""

    topic: str
    field: str
    """Path of the field inside the message. If it ends with !, values that were not measured are left out instead of
    drawn as zero."""
    name: str
    derivation: "Derivation | None" = None
    """How the curve is derived from the field, or None if the viewer draws the field itself."""


class Derivation(StrEnum):
    """The value that is derived from a field, by a lens of Rerun (lenses.py)."""

    TEXT_OR_NOTHING = "text_or_nothing"
    """A text, or no state if it is empty."""
    WHO_AND_WHY = "who_and_why"
    """The senders and reasons of a list of e-stops, or no state if it is empty."""
    TOTAL = "total"
    """The sum of the values of a map."""
    LOW = "low"
    CRITICAL = "critical"
    """A line at a battery threshold."""


class StateTrack(Struct, frozen=True):
    """One state of a topic over time. `name` is its component in the .rrd and its label."""

    topic: str
    field: str
    name: str
    derivation: Derivation | None = None
    drawn: bool = False
    """True if drawings.py derives it from several fields or messages; `field` is the first of them."""


class TextTopic(Struct, frozen=True):
    """A line of text joined from fields in this order, without empty ones."""

    topic: str
    fields: tuple[str, ...]
    alarm_field: str = ""
    before: Mapping[str, str] = field(default_factory=dict)
    """Prefix of a field that is not empty."""
    calm: frozenset[str] = frozenset()
    """Normal values of `alarm_field`. Any other value makes the line a warning."""


class Panel(Struct, frozen=True):
    """One view of curves, tracks or lines of text."""

    name: str
    curves: tuple[Curve, ...] = ()
    tracks: tuple[StateTrack, ...] = ()
    texts: tuple[str, ...] = ()
    """Topics whose lines of text share the view."""

    @property
    def topics(self) -> frozenset[str]:
        """Return the topics of the view."""
        return frozenset(
            [curve.topic for curve in self.curves] + [track.topic for track in self.tracks] + list(self.texts)
        )


def _unit(topic: str, field: str) -> str:
    return TOPICS[topic].units[field.rstrip("!")]


def _tracks(topic: str, what: str, *fields: str) -> tuple[StateTrack, ...]:
    return tuple(StateTrack(topic, field, f"{what} {field.replace('_', ' ')}".strip()) for field in fields)


TRUTH: Final = "sim/truth"
POSE: Final = "sensor/pose"
WORLD: Final = "@sim/world"
COMMAND_TOPIC: Final = "event/command"
ASSIGNMENT: Final = "@coordinator/assignment"
PLAN_TOPIC: Final = "@coordinator/plan"
ON_CHANGE_TOPICS: Final = (PLAN_TOPIC, ASSIGNMENT)
"""Topics that are published on change, and otherwise every ten seconds. So a viewer that starts later asks for their
last message."""

DISTANCE: Final = Curve("sensor/range", "range_m!", f"distance ({_unit('sensor/range', 'range_m')})")
BATTERY: Final = Curve("sensor/battery", "voltage_v", f"battery ({_unit('sensor/battery', 'voltage_v')})")
LOW: Final = Curve("sensor/battery", "voltage_v", f"low, by default {LOW_V:g} V", Derivation.LOW)
CRITICAL: Final = Curve("sensor/battery", "voltage_v", f"critical, by default {CRITICAL_V:g} V", Derivation.CRITICAL)
MODE_REQUESTED: Final = StateTrack("state/mode", "asked", "mode asked")
MODE_INFERRED: Final = StateTrack("state/mode", "inferred", "mode inferred")
MODE_TRUE: Final = StateTrack(TRUTH, "mode", "mode true")
VERDICT_TRACK: Final = StateTrack("state/mode", "verdict", "verdict")
MOTION: Final = StateTrack("state/motion", "motion", "motion")
LINK_TRACK: Final = StateTrack("state/link", "state", "link")
ESTOPS: Final = StateTrack("state/safety", "estops", "e-stop", Derivation.WHO_AND_WHY)
HOLD: Final = StateTrack("state/safety", "hold.by", "hold", Derivation.TEXT_OR_NOTHING)
LEASE: Final = StateTrack("state/safety", "lease.holder", "driven by", Derivation.TEXT_OR_NOTHING)
COMMAND_TRACK: Final = StateTrack(COMMAND_TOPIC, "verb", "commands", drawn=True)
LED_REQUESTED: Final = StateTrack(COMMAND_TOPIC, "request", "LED asked", drawn=True)
LED_TRUE: Final = StateTrack(TRUTH, "led", "LED true")
ROLE: Final = StateTrack(ASSIGNMENT, "roles", "role", drawn=True)
"""One track per car, on the entity of the assignment: `role red`."""
PHASE: Final = StateTrack(ASSIGNMENT, "phase", "phase of the plan", Derivation.TEXT_OR_NOTHING)

MAIN_PANELS: Final = (
    Panel(
        "Mode, motion, link",
        tracks=(
            MODE_REQUESTED,
            MODE_INFERRED,
            MODE_TRUE,
            VERDICT_TRACK,
            MOTION,
            StateTrack("state/safety", "motors", "motors"),
            LINK_TRACK,
        ),
    ),
    Panel("Distance", curves=(DISTANCE,)),
    Panel(
        "Line, obstacle, light",
        tracks=(
            *_tracks("sensor/line", "line", "left_outer", "left_inner", "right_inner", "right_outer"),
            *_tracks("sensor/obstacle", "obstacle", "left", "right"),
            *_tracks("sensor/light", "light", "left", "right"),
        ),
    ),
    Panel("Battery", curves=(BATTERY, LOW, CRITICAL)),
    Panel("Commands, holds, e-stops", tracks=(COMMAND_TRACK, LEASE, HOLD, ESTOPS, ROLE, LED_REQUESTED, LED_TRUE)),
    Panel("What happened", texts=(COMMAND_TOPIC, "event/log")),
)
"""First page of a car's tab, in two columns."""

_SENSOR_PANELS: Final = (
    Panel("Gyroscope", curves=tuple(Curve("sensor/imu", f"gyro_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Acceleration", curves=tuple(Curve("sensor/imu", f"accel_{a}_raw", f"{a} (raw)") for a in "xyz")),
    Panel("Wheels", curves=tuple(Curve("sensor/wheels", f"{side}_m_s", f"{side} (m/s)") for side in ("left", "right"))),
    Panel("Odometer", curves=tuple(Curve("sensor/odometer", f"{side}_m", f"{side} (m)") for side in ("left", "right"))),
    Panel(
        "Attitude",
        curves=tuple(Curve("sensor/attitude", f"{axis}_rad", f"{axis} (rad)") for axis in ("roll", "pitch", "yaw")),
    ),
    Panel("Pose", curves=tuple(Curve(POSE, name, f"{name[0]} ({_unit(POSE, name)})") for name in ("x_m", "y_m"))),
    Panel("Heading", curves=(Curve(POSE, "heading_rad", f"heading ({_unit(POSE, 'heading_rad')})"),)),
    Panel("Arm", curves=tuple(Curve("sensor/arm", f"joint_deg[{n}]", f"J{n + 1} (deg)") for n in range(6))),
)
_STATE_PANELS: Final = (
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
            Curve("state/link", "rejects", "frames rejected", Derivation.TOTAL),
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
        tracks=(
            StateTrack("sensor/battery", "level", "battery level"),
            StateTrack("state/motion", "fan", "fan"),
            StateTrack(TRUTH, "blocked", "blocked in truth"),
            StateTrack("state/health", "platform", "platform"),
        ),
    ),
    Panel("Raw frames", texts=("frame/rx", "frame/tx")),
)
_DRAWN: Final = frozenset[str]().union(*(panel.topics for panel in MAIN_PANELS + _SENSOR_PANELS))


def _plain_panel(topic: Topic) -> Panel:
    """Return the panel of a sensor that no table above draws: a curve per field with a unit, a track per word field."""
    name = topic.name.removeprefix("sensor/").replace("_", " ")
    curves = tuple(Curve(topic.name, field, f"{name} ({field.replace('_', ' ')})") for field in topic.units)
    return Panel(name.capitalize(), curves, _tracks(topic.name, name, *topic.words))


_PLAIN_PANELS: Final = tuple(
    _plain_panel(topic) for topic in CAR_TOPICS if topic.family == "sensor" and topic.name not in _DRAWN
)
MORE_PANELS: Final = _SENSOR_PANELS + _PLAIN_PANELS + _STATE_PANELS
"""Second page of a car's tab."""

CAR_PANELS: Final = MAIN_PANELS + MORE_PANELS

FLEET_TRACKS: Final = (
    ("Mode and link", (MODE_REQUESTED, MODE_INFERRED, MODE_TRUE, LINK_TRACK)),
    ("Commands, holds, e-stops", (COMMAND_TRACK, LEASE, HOLD, ESTOPS, ROLE)),
)
"""(name, tracks of every car) on the fleet's tab."""
FLEET_CURVES: Final = (("Distance (m)", DISTANCE), ("Battery (V)", BATTERY))
FLEET_TEXTS: Final = (
    ("Decisions and why", (), ("@coordinator/decision", ASSIGNMENT, "@recorder/mark")),
    ("Commands and log", (COMMAND_TOPIC, "event/log"), ("@coordinator/log",)),
)
"""(name, topics of every car, topics of services) on the fleet's tab."""

SERVICE_PANELS: Final = (
    Panel(
        "Plan, recorder, supervisor",
        tracks=(
            PHASE,
            StateTrack("@recorder/status", "state", "recorder"),
            StateTrack("@recorder/status", "error", "recorder's error", Derivation.TEXT_OR_NOTHING),
            StateTrack("@supervisor/status", "state", "fleet up"),
        ),
    ),
    Panel("Recorded", curves=(Curve("@recorder/status", "messages", "messages"),)),
    Panel(
        "Lost",
        curves=(
            Curve("@recorder/status", "drops", "dropped by the recorder", Derivation.TOTAL),
            Curve("@recorder/status", "missed", "missed on the bus", Derivation.TOTAL),
        ),
    ),
    Panel("Free on the disk", curves=(Curve("@recorder/status", "free_bytes", "free (B)"),)),
)
"""Page of the fleet's services."""

TEXT_LINES: Final = (
    TextTopic(
        COMMAND_TOPIC,
        ("car", "verb", "phase", "reason", "words", "sender"),
        "phase",
        {"sender": "by "},
        frozenset({Phase.ASKED, Phase.QUEUED, Phase.SENT, Phase.EFFECT_SEEN, Phase.COMPLETE}),
    ),
    TextTopic(
        "@coordinator/decision",
        ("subject", "decided", "why", "would_change"),
        before={"would_change": "- changes with: "},
    ),
    TextTopic(ASSIGNMENT, ("roles", "phase")),
    TextTopic("frame/rx", ("data", "verdict"), "verdict", calm=frozenset(FrameVerdict)),
    TextTopic("frame/tx", ("data", "why", "command_id")),
)
"""`event/log` needs no row: Rerun reads foxglove.Log as text."""


class Contents(Struct, frozen=True):
    """Topics of a session by car, and of the fleet's services."""

    fleet: str
    cars: Mapping[str, frozenset[str]]
    services: frozenset[str]


def contents(recorded: frozenset[str]) -> Contents:
    """Sort the keys of a session by car and service. Ignore keys without a topic in schemas/topics.py."""
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
    """Yield every curve and track of the tables once."""
    every: list[Curve | StateTrack] = [curve for _, curve in FLEET_CURVES]
    for _, tracks in FLEET_TRACKS:
        every += tracks
    for panel in (*CAR_PANELS, *SERVICE_PANELS):
        every += (*panel.curves, *panel.tracks)
    yield from dict.fromkeys(every)


def topic_of(key: str) -> str:
    """Return the topic name of a key of a car or service, or an empty text if the key belongs to no fleet."""
    found = keys.parse(key)
    if found is None:
        return ""
    return f"{found.car}/{found.topic}" if found.car.startswith("@") else found.topic


def entity(key: str) -> str:
    """Return the entity that Rerun's MCAP reader gives a key: it escapes all but letters, digits, -, _ and ."""
    return "/" + "/".join(
        "".join(c if c.isalnum() or c in "-_." else f"\\{c}" for c in part) for part in key.split("/")
    )


def key_of(path: str) -> str:
    """Return the key of an entity, the inverse of `entity`."""
    return path.replace("\\", "").lstrip("/")

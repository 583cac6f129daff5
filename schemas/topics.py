"""The one table of topics: name, message, units, rate, staleness, QoS, recorded or not, Rerun entity. Pure."""

import math
import re
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Final, NamedTuple

from schemas.suggestion import nearest
from schemas.words import UNKNOWN, Basis, BatteryLevel, LinkState, Mode, Motion, MotionSource, Motors, Verdict

PROTOBUF: Final = "application/protobuf"
HISTORY: Final = 1500  # docs/reference/keys.md#topics: about one minute of the fastest readings
# A hub or a recorder that restarts is back after two or three seconds.
CACHE_S: Final = 10.0
"""Time for which a publisher keeps its publications for backfill."""
_MIN_CACHE_SIZE: Final = 100  # events and states come in bursts


class Qos(StrEnum):
    """The quality of service of a publication. `bus.publisher` maps it to Zenoh's options."""

    # Under congestion, Zenoh drops readings and states: one stalled subscriber must not freeze a gateway. Only the
    # sender of a command waits.
    READING = "reading"  # batched
    STATE = "state"  # overtakes readings
    COMMAND = "command"  # overtakes everything, sent at once


class Topic(NamedTuple):
    """One row of the table: the messages under `<fleet>/<car>/<name>`."""

    name: str
    message: str
    """Full protobuf name."""
    about: str
    qos: Qos
    rate_hz: float = 0.0
    """Maximum expected rate. 0 if there is none, as for events and sent frames."""
    stale_after_s: float | None = None
    """Age at which a value is stale. None if it never expires."""
    units: Mapping[str, str] = MappingProxyType({})
    """Units by field, for fields with a unit."""
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """Lowest and highest published value by field (docs/reference/protocol.md#readings)."""
    words: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    """The possible words by field, for fields whose value is one of a few words."""
    recorded: bool = True
    entity: str = ""
    """Rerun entity below the car. Empty if it is shown through frames and logs only."""

    @property
    def encoding(self) -> str:
        """The Zenoh encoding of the messages of this topic, with the full name in the schema part."""
        return f"{PROTOBUF};{self.message}"

    @property
    def family(self) -> str:
        """`sensor`, `state`, `frame`, `event` or `sim`; for a topic of a service, the name of the service."""
        return self.name.partition("/")[0]

    @property
    def history_size(self) -> int:
        """Number of values that a gateway stores for queries: the history of a reading, the latest state."""
        return {"sensor": HISTORY, "state": 1}.get(self.family, 0)

    @property
    def cache_size(self) -> int:
        """Number of publications that a publisher caches for backfill."""
        return max(_MIN_CACHE_SIZE, math.ceil(CACHE_S * self.rate_hz))


# A mode-0 report comes about once a second and may be blocked for another second
# (docs/reference/protocol.md#blocking-times), so a reading is stale after 3 s; states are published on change and once
# a second.
_READING: Final = 3.0
_STATE: Final = 3.0
_TRACKING_HZ: Final = 27.0  # docs/reference/protocol.md#rates: the most frames the UART carries, in tracking
_MODES: Final = (*Mode, UNKNOWN)
_PLACE_M: Final = (-1000.0, 1000.0)
"""Range of a place on a floor, in m."""

CAR_TOPICS: Final = (
    Topic(
        "sensor/range",
        "fleet.v1.Range",
        "ultrasonic distance",
        Qos.READING,
        1.0,
        _READING,
        {"range_m": "m"},
        {"range_m": (0.0, 12.0)},
        entity="range",
    ),
    Topic(
        "sensor/battery",
        "fleet.v1.Battery",
        "battery voltage",
        Qos.READING,
        1.0,
        _READING,
        {"voltage_v": "V", "charge": "1", "charge_error": "1"},
        {"voltage_v": (0.0, 13.0), "charge": (0.0, 1.0), "charge_error": (0.0, 1.0)},
        {"level": tuple(BatteryLevel)},
        entity="battery",
    ),
    Topic(
        "sensor/grayscale",
        "fleet.v1.Grayscale",
        "reflected light, as the raw number of the sensor (ADC)",
        Qos.READING,
        1.0,
        _READING,
        {"raw": "count"},
        {"raw": (0.0, 4095.0)},
        entity="grayscale",
    ),
    Topic("sensor/line", "fleet.v1.Line", "line sensors", Qos.READING, _TRACKING_HZ, _READING, entity="line"),
    Topic(
        "sensor/obstacle",
        "fleet.v1.Obstacle",
        "infrared obstacle sensors",
        Qos.READING,
        24.0,
        _READING,
        entity="obstacle",
    ),
    Topic("sensor/light", "fleet.v1.Light", "light sensors", Qos.READING, 23.0, _READING, entity="light"),
    Topic(
        "sensor/imu",
        "fleet.v1.Imu",
        "gyroscope and accelerometer, as raw numbers",
        Qos.READING,
        1.0,
        _READING,
        {f"{part}_{axis}_raw": "count" for part in ("gyro", "accel") for axis in "xyz"},
        entity="imu",
    ),
    Topic(
        "sensor/wheels",
        "fleet.v1.Wheels",
        "speed of the wheels, by encoders",
        Qos.READING,
        20.0,
        _READING,
        {"left_m_s": "m/s", "right_m_s": "m/s"},
        {"left_m_s": (-5.0, 5.0), "right_m_s": (-5.0, 5.0)},
        entity="wheels",
    ),
    Topic(
        "sensor/odometer",
        "fleet.v1.Odometer",
        "way of the wheels since the car was switched on; it falls while they turn backwards",
        Qos.READING,
        20.0,
        _READING,
        {"left_m": "m", "right_m": "m"},
        entity="odometer",
    ),
    Topic(
        "sensor/attitude",
        "fleet.v1.Attitude",
        "roll, pitch and yaw of the car",
        Qos.READING,
        20.0,
        _READING,
        {"roll_rad": "rad", "pitch_rad": "rad", "yaw_rad": "rad"},
        {f"{axis}_rad": (-math.pi, math.pi) for axis in ("roll", "pitch", "yaw")},
        entity="attitude",
    ),
    Topic(
        "sensor/pose",
        "fleet.v1.Pose",
        "where the car is, by its odometry or a program outside the car",
        Qos.READING,
        20.0,
        _READING,
        {"x_m": "m", "y_m": "m", "heading_rad": "rad", "xy_std_m": "m", "heading_std_rad": "rad"},
        {"x_m": _PLACE_M, "y_m": _PLACE_M, "heading_rad": (-math.pi, math.pi)},
        entity="pose",
    ),
    Topic(
        "sensor/arm",
        "fleet.v1.Arm",
        "arm joints",
        Qos.READING,
        1.0,
        _READING,
        {"joint_deg": "deg"},
        entity="arm",
    ),
    Topic(
        "state/link",
        "fleet.v1.Link",
        "the state of the link, and counters",
        Qos.STATE,
        1.0,
        _STATE,
        {"tx_airtime": "1", "since_s": "s", "last_rx_s": "s", "rx_bytes": "B", "tx_bytes": "B"},
        {"tx_airtime": (0.0, 1.0)},
        {"state": tuple(LinkState)},
        entity="link",
    ),
    Topic(
        "state/mode",
        "fleet.v1.Mode",
        "the mode that was asked for, the mode that the readings show, and the evidence",
        Qos.STATE,
        1.0,
        _STATE,
        {"evidence_age_s": "s"},
        words={"asked": _MODES, "inferred": _MODES, "verdict": tuple(Verdict)},
        entity="mode",
    ),
    Topic(
        "state/motion",
        "fleet.v1.Motion",
        "the current motion, and its sender",
        Qos.STATE,
        1.0,
        _STATE,
        {"speed": "1", "expires_in_s": "s", "servo_deg": "deg"},
        {"speed": (0.0, 1.0), "servo_deg": (0.0, 180.0)},
        {"motion": (*Motion, UNKNOWN), "source": tuple(MotionSource)},
        entity="motion",
    ),
    Topic(
        "state/safety",
        "fleet.v1.Safety",
        "e-stops, hold and lease in force, and whether the motors are off",
        Qos.STATE,
        1.0,
        _STATE,
        {"worst_stop_s": "s", "shown_age_s": "s", "trust_since_s": "s"},
        words={"motors": tuple(Motors), "motors_basis": tuple(Basis)},
        entity="safety",
    ),
    Topic(
        "state/health",
        "fleet.v1.Health",
        "the gateway's process, and what it knows of its car",
        Qos.STATE,
        1.0,
        _STATE,
        {"uptime_s": "s", "loop_lag_s": "s", "cpu": "1", "rss_mb": "MB"},
        entity="health",
    ),
    Topic("frame/rx", "fleet.v1.RxFrame", "bytes from the car", Qos.READING, _TRACKING_HZ, entity="frame/rx"),
    Topic("frame/tx", "fleet.v1.TxFrame", "bytes to the car", Qos.READING, 0.0, entity="frame/tx"),
    Topic(
        "event/command",
        "fleet.v1.CommandEvent",
        "what became of a command: a record for each phase",
        Qos.STATE,
        units={"age_s": "s", "worst_case_s": "s", "took_s": "s"},
        entity="command",
    ),
    Topic("event/log", "foxglove.Log", "notable events", Qos.STATE, entity="log"),
    Topic(
        "sim/truth",
        "fleet.v1.Truth",
        "the true state of a simulated car",
        Qos.READING,
        10.0,
        1.0,
        {"x_m": "m", "y_m": "m", "heading_rad": "rad", "motor_left": "PWM", "motor_right": "PWM"},
        entity="truth",
    ),
)

SERVICE_TOPICS: Final = (
    Topic("@coordinator/plan", "fleet.v1.Plan", "the plan in force", Qos.STATE, entity="coordinator/plan"),
    Topic(
        "@coordinator/assignment",
        "fleet.v1.Assignment",
        "which car has which role",
        Qos.STATE,
        entity="coordinator/assignment",
    ),
    Topic(
        "@coordinator/decision",
        "fleet.v1.Decision",
        "what was decided, and why",
        Qos.STATE,
        entity="coordinator/decision",
    ),
    Topic("@coordinator/log", "foxglove.Log", "notable events of the coordinator", Qos.STATE, entity="coordinator/log"),
    Topic(
        "@recorder/status",
        "fleet.v1.Recording",
        "the state of the recorder",
        Qos.STATE,
        1.0,
        _STATE,
        {"bytes": "B", "free_bytes": "B"},
        entity="recorder",
    ),
    Topic(
        "@recorder/mark", "foxglove.Log", "a mark that somebody set in the recording", Qos.STATE, entity="recorder/mark"
    ),
    Topic(
        "@supervisor/status",
        "fleet.v1.Supervision",
        "the processes of `fleet up`",
        Qos.STATE,
        1.0,
        _STATE,
        {"uptime_s": "s"},
        entity="supervisor",
    ),
    Topic(
        "@sim/world",
        "fleet.v1.World",
        "where everything but the cars is in a simulated world, unless the world is empty",
        Qos.READING,
        10.0,
        _STATE,
        entity="sim/world",
    ),
)

TOPICS: Final[Mapping[str, Topic]] = MappingProxyType({topic.name: topic for topic in CAR_TOPICS + SERVICE_TOPICS})

FROM_OUTSIDE: Final = frozenset({"sensor/pose"})
"""Readings that a program outside the car may publish, for any car and in any mode. They do not show that the car is
alive."""
RESULT: Final = "fleet.v1.Result"
_FAMILIES: Final = tuple(dict.fromkeys(topic.family for topic in CAR_TOPICS))
_MIN_WORD_LENGTH: Final = 4
"""Minimum length of a word that is looked up in the descriptions of topics: shorter words are in many of them."""


def of_key(key: str) -> Topic | None:
    """Return the topic of a concrete key (`fleet/red/sensor/range`). None if it is not in the table."""
    _, _, rest = key.partition("/")
    if rest.startswith("@"):
        return TOPICS.get(rest)
    return TOPICS.get(rest.partition("/")[2])


def likely_name(name: str) -> str | None:
    """Return the topic that a wrong name probably means: sensor/range for `sensor/rang` and for `sensor/distance`."""
    family, _, last = name.rpartition("/")
    # Compare only the last part: with the family, any two topics of one family would be near each other.
    there = sorted(TOPICS, key=lambda each: (each.rpartition("/")[0] != family, each.startswith("@")))
    parts = [each.rpartition("/")[2] for each in there]
    if last == "*" or (not family and last not in parts):
        near = nearest(family or last, _FAMILIES)
        if near:
            return f"{near}/*"
    near = None if last == "*" else nearest(last, parts)
    if near:
        return there[parts.index(near)]
    return _topic_about(last, [each for each in there if each.startswith("@") == name.startswith("@")])


def _topic_about(word: str, there: list[str]) -> str | None:
    """Return the first topic with this word in its description or in a field's name, or None."""
    about: dict[str, str] = {}
    for name in there:
        for each in re.findall(r"[a-z]+", f"{TOPICS[name].about} {' '.join(TOPICS[name].units)}".lower()):
            about.setdefault(each, name)
    known = [each for each in about if len(each) >= _MIN_WORD_LENGTH and each not in _FAMILIES]
    for part in re.findall(r"[a-z]+", word.lower()):
        if len(part) >= _MIN_WORD_LENGTH and (near := nearest(part, known)):
            return about[near]
    return None

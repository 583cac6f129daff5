"""The one table of metrics: names, labels, values and the panels that show them. Pure: time is an argument.

A car whose gateway has gone has `fleet_car_up`, which is 0, and its counters of commands and refusals, but no other
metric. A stale message gives no value. So no measured number is ever older than its topic allows. The values of labels
are only words from fixed sets, and names of cars that have or had a gateway.
"""

from collections.abc import Callable, Iterable, Iterator
from enum import StrEnum
from typing import Any, Final

from msgspec import Struct

from fleet.client.car_state import CarState
from schemas.words import UNKNOWN, LinkState, Mode, Motors, RecorderState

Values = Iterable[tuple[tuple[str, ...], float]]
"""Pairs: the values of the labels after `car`, and the value of the metric."""
OTHER: Final = "other"
"""The label for a verb or a reason that this version does not know. For other words it is `unknown`."""


class MetricKind(StrEnum):
    """The kinds of metrics. A counter only grows, and begins again from 0 when its process restarts."""

    GAUGE = "gauge"
    COUNTER = "counter"


class Unit(StrEnum):
    """The units of metrics, as Grafana names them."""

    NONE = "none"
    YES_NO = "bool"
    VOLTS = "volt"
    SHARE = "percentunit"
    SECONDS = "s"
    BYTES = "bytes"


class Metric(Struct, frozen=True):
    """One row of the table."""

    name: str
    """The name. A counter's name is written without `_total`, which `sample` adds."""
    about: str
    unit: Unit = Unit.NONE
    kind: MetricKind = MetricKind.GAUGE
    labels: tuple[str, ...] = ()
    panel: str = ""
    """Title of the panel of the dashboard that shows the metric. Metrics with the same title share a panel."""

    @property
    def label_names(self) -> tuple[str, ...]:
        """Return the names of the labels."""
        return self.labels

    @property
    def sample(self) -> str:
        """Return the name of its samples."""
        return f"{self.name}_total" if self.kind is MetricKind.COUNTER else self.name


class CarMetric(Metric, frozen=True):
    """A metric of each car. The first label is the car."""

    values: Callable[[CarState, float], Values] = lambda *_: ()
    of_absent: bool = False
    """True if a car without a gateway has this metric, too."""

    @property
    def label_names(self) -> tuple[str, ...]:
        """Return the names of the labels."""
        return ("car", *self.labels)


def one_of(words: Iterable[str], word: str) -> Iterator[tuple[tuple[str, ...], float]]:
    """Yield a 1 for the word, and a 0 for each other word. A word that is not in `words` counts as `unknown`."""
    known = tuple(dict.fromkeys((*map(str, words), UNKNOWN)))
    found = word if word in known else UNKNOWN
    for each in known:
        yield (each,), float(each == found)


def _number(topic: str, read: Callable[[Any], float | None]) -> Callable[[CarState, float], Values]:
    """Return a function that yields a number from a topic's newest message.

    It yields nothing if the message is stale, or if the field is missing.
    """

    def values(state: CarState, now: float) -> Iterator[tuple[tuple[str, ...], float]]:
        message = state.fresh(topic, now)
        if message is not None and (found := read(message)) is not None:
            yield (), float(found)

    return values


def _word(topic: str, words: Iterable[str], read: Callable[[Any], str]) -> Callable[[CarState, float], Values]:
    """Return a function that yields a 1 for the word in a topic's newest message, and a 0 for each other word.

    It yields nothing if the message is stale.
    """
    return lambda state, now: () if (found := state.fresh(topic, now)) is None else one_of(words, read(found))


def _ages(state: CarState, now: float) -> Iterator[tuple[tuple[str, ...], float]]:
    for topic in sorted(state.newest_by_topic):
        yield (topic,), state.age_s(topic, now)


def _silence_s(state: CarState, now: float) -> Iterator[tuple[tuple[str, ...], float]]:
    link = state.fresh("state/link", now)
    if link is not None and link.HasField("last_rx_s"):
        yield (), link.last_rx_s + state.age_s("state/link", now)


_COUNTER: Final = MetricKind.COUNTER

CAR_METRICS: Final = (
    CarMetric(
        "fleet_car_up",
        "1 if the car's gateway is on the bus",
        Unit.YES_NO,
        panel="Gateways",
        values=lambda state, _: [((), float(state.present))],
        of_absent=True,
    ),
    CarMetric(
        "fleet_car_ready",
        "1 if the car answers, and a command to it need not wait",
        Unit.YES_NO,
        panel="Ready",
        values=lambda state, now: [((), float(state.why_not_ready(now) is None))],
    ),
    CarMetric(
        "fleet_car_link",
        "1 for the state of the car's link, 0 for the others",
        labels=("state",),
        panel="Link",
        values=_word("state/link", LinkState, lambda link: link.state),
    ),
    CarMetric(
        "fleet_car_motors",
        "1 for the state of the car's motors, as its gateway claims, 0 for the others",
        labels=("state",),
        panel="Motors",
        values=_word("state/safety", Motors, lambda safety: safety.motors),
    ),
    CarMetric(
        "fleet_car_mode",
        "1 for the mode that the car was asked for, 0 for the others",
        labels=("mode",),
        panel="Mode",
        values=_word("state/mode", Mode, lambda mode: mode.asked),
    ),
    CarMetric(
        "fleet_car_battery_volts",
        "voltage of the battery",
        Unit.VOLTS,
        panel="Battery",
        values=_number("sensor/battery", lambda battery: battery.voltage_v),
    ),
    CarMetric(
        "fleet_car_battery_charge_ratio",
        "charge of the battery, an estimate, 0 to 1",
        Unit.SHARE,
        panel="Charge",
        values=_number("sensor/battery", lambda each: each.charge if each.HasField("charge") else None),
    ),
    CarMetric(
        "fleet_car_silence_seconds",
        "time since the car's last byte",
        Unit.SECONDS,
        panel="Silence of cars",
        values=_silence_s,
    ),
    CarMetric(
        "fleet_car_message_age_seconds",
        "time since the newest message of a topic",
        Unit.SECONDS,
        labels=("topic",),
        panel="Age of messages",
        values=_ages,
    ),
    CarMetric(
        "fleet_car_estops",
        "number of emergency stops in force",
        panel="Stops in force",
        values=_number("state/safety", lambda safety: len(safety.estops)),
    ),
    CarMetric(
        "fleet_car_held",
        "1 if somebody has stopped the car, so that the plan leaves it alone",
        Unit.YES_NO,
        panel="Stops in force",
        values=_number("state/safety", lambda safety: bool(safety.hold.by)),
    ),
    CarMetric(
        "fleet_car_paused",
        "1 if the fleet is paused",
        Unit.YES_NO,
        panel="Stops in force",
        values=_number("state/safety", lambda safety: bool(safety.pauses)),
    ),
    CarMetric(
        "fleet_car_stop_seconds",
        "longest time that a stop would take now",
        Unit.SECONDS,
        panel="Longest stop",
        values=_number("state/safety", lambda safety: safety.worst_stop_s if safety.HasField("worst_stop_s") else None),
    ),
    CarMetric(
        "fleet_car_received_bytes",
        "bytes from the car",
        Unit.BYTES,
        _COUNTER,
        panel="Bytes from cars",
        values=_number("state/link", lambda link: link.rx_bytes),
    ),
    CarMetric(
        "fleet_car_sent_bytes",
        "bytes to the car",
        Unit.BYTES,
        _COUNTER,
        panel="Bytes to cars",
        values=_number("state/link", lambda link: link.tx_bytes),
    ),
    CarMetric(
        "fleet_car_rejected_frames",
        "frames or bytes of the car that gave no readings or were not used, and troubles of its link",
        Unit.NONE,
        _COUNTER,
        panel="Trouble of links",
        values=_number("state/link", lambda link: sum(link.rejects.values())),
    ),
    CarMetric(
        "fleet_car_reconnects",
        "how often the link was opened again",
        Unit.NONE,
        _COUNTER,
        panel="Trouble of links",
        values=_number("state/link", lambda link: link.reconnects),
    ),
    CarMetric(
        "fleet_car_loop_lag_seconds",
        "worst delay of the gateway's loop in the last second",
        Unit.SECONDS,
        panel="Lag of gateways",
        values=_number("state/health", lambda health: health.loop_lag_s),
    ),
    CarMetric(
        "fleet_car_gateway_cpu_ratio",
        "CPU of the gateway, share of one core",
        Unit.SHARE,
        panel="CPU of gateways",
        values=_number("state/health", lambda health: health.cpu),
    ),
    CarMetric(
        "fleet_car_gateway_memory_bytes",
        "memory of the gateway",
        Unit.BYTES,
        panel="Memory of gateways",
        values=_number("state/health", lambda health: health.rss_mb * 1e6),
    ),
    CarMetric(
        "fleet_car_bus_drops",
        "messages that the gateway could not publish or take",
        Unit.NONE,
        _COUNTER,
        panel="Dropped messages",
        values=_number("state/health", lambda health: health.bus_drops),
    ),
)

COMMANDS: Final = Metric(
    "fleet_car_commands",
    "commands that reached a phase since the exporter began: asked, sent, complete, rejected, ...",
    kind=_COUNTER,
    labels=("car", "verb", "phase"),
    panel="Commands by phase",
)
REFUSALS: Final = Metric(
    "fleet_car_refusals",
    "commands that were not carried out, by reason",
    kind=_COUNTER,
    labels=("car", "reason"),
    panel="Refused commands by reason",
)

_RECORDER: Final[tuple[tuple[Metric, Callable[[Any], Values]], ...]] = (
    (
        Metric(
            "fleet_recorder",
            "1 for the state of the recorder, 0 for the others, no value without a recorder",
            labels=("state",),
            panel="Recorder",
        ),
        lambda status: one_of(RecorderState, status.state),
    ),
    (
        Metric("fleet_recorder_session_bytes", "size of the session", Unit.BYTES, panel="Recording"),
        lambda status: [((), status.bytes)],
    ),
    (
        Metric("fleet_recorder_free_bytes", "free space of the recorder's disk", Unit.BYTES, panel="Free disk"),
        lambda status: [((), status.free_bytes)],
    ),
    (
        Metric(
            "fleet_recorder_dropped_messages",
            "messages of the session for which the recorder had no room",
            panel="Dropped messages",
        ),
        lambda status: [((), sum(status.drops.values()))],
    ),
    (
        Metric(
            "fleet_recorder_missed_messages",
            "messages of the session that were lost on the way to the recorder",
            panel="Dropped messages",
        ),
        lambda status: [((), sum(status.missed.values()))],
    ),
)
RECORDER_METRICS: Final = tuple(metric for metric, _ in _RECORDER)

CONNECTED: Final = Metric(
    "fleet_exporter_connected", "1 if the exporter is linked to the hub", Unit.YES_NO, panel="Hub"
)
DROPS: Final = Metric(
    "fleet_exporter_dropped_messages",
    "messages that the exporter had no room for",
    kind=_COUNTER,
    panel="Dropped messages",
)

METRICS: Final[tuple[Metric, ...]] = (CONNECTED, *CAR_METRICS, COMMANDS, REFUSALS, *RECORDER_METRICS, DROPS)
"""All metrics, in the order of the dashboard."""


def recorder_values(status: Any) -> Iterator[tuple[Metric, Values]]:
    """Yield the metrics of a recorder with their values."""
    return ((metric, values(status)) for metric, values in _RECORDER)

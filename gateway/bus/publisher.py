"""One car's publications: readings, frames, states and records become messages under its keys, and answers to queries.

What is published is decided elsewhere (`protocol.profile` for readings, `control` for states); here it gets its form.
"""

import os
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import zenoh

from gateway.bus.history import BadRange, HistoryBuffer
from gateway.clock import WallClock
from gateway.control.commands import Phase
from gateway.control.controller import Controller
from gateway.control.estimate import battery
from gateway.control.estimate.link_health import LinkHealth
from gateway.control.estimate.platform import PlatformDetector
from gateway.control.events import CommandRecord, Level, LogRecord, OutgoingFrame
from gateway.control.rate_limit import TokenBucket
from gateway.protocol.enums import Mode
from gateway.protocol.events import Event
from gateway.protocol.measurements import measured, verdict_of
from schemas import bus, keys, messages, topics
from schemas.gen import fleet_v1_pb2 as pb

VERSION: Final = "0.1.0"
_STATM: Final = Path("/proc/self/statm")
STATE_EVERY_S: Final = 1.0
"""States are published on change and once a second (docs/reference/keys.md#topics)."""
SLICE: Final = 50
"""Answers to a query without a pause: 3 ms as JSON."""
BACK_S: Final = 1.0
"""After the bus was away its other clients, a recorder above all, need so long to be back."""
STALLED_S: Final = 1.0
"""A process that slept longer may have lost its link to the bus, and not know it yet (Zenoh's lease is 2 s)."""
KEPT_RECORDS: Final = 1000
"""Records of commands and events that wait for the bus; of more the oldest are dropped, and counted."""
RAW_PER_S: Final = 100.0
RAW_AT_ONCE: Final = 1000.0
"""Raw frames that are published: a car sends up to 27 a second (docs/reference/protocol.md#rates); what a link held
up comes at once."""
_CLASSES: Final[dict[str, Any]] = {
    topic.name: messages.message_class(topic.message)
    for topic in topics.CAR_TOPICS
    if topic.message.startswith("fleet.v1.")
}
"""A message is made anew each time: one that is cleared and filled again keeps what it held before in memory."""
_ON_ARRIVAL: Final = frozenset({Phase.ASKED, Phase.QUEUED, Phase.REJECTED})
"""Records made when a command arrives: nothing took any time yet."""
_LEVELS: Final = {Level.DEBUG: 1, Level.INFO: 2, Level.WARNING: 3, Level.ERROR: 4}  # foxglove.Log.Level


class CarPublisher:
    """Publishers, latest values and rings of one car."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str, control: Controller, url: str) -> None:
        self._fleet = fleet
        self._car = car
        self.profile = control.profile
        """What the car is treated as; its readings are filler or not accordingly."""
        self._battery = control.battery
        self._url = url
        self._publishers: dict[str, bus.Publisher] = {}
        self._rings: dict[str, HistoryBuffer] = {}
        self._told: dict[str, tuple[object, ...]] = {}
        self._told_at: dict[str, float] = {}
        for topic in topics.CAR_TOPICS:
            if topic.family == "sim":
                continue
            key = keys.topic_key(fleet, car, topic.name)
            self._publishers[topic.name] = opened.publisher(key, topic, car)
            if topic.kept:
                self._rings[topic.name] = HistoryBuffer(topic.kept)
        self._wall = WallClock()
        self._raw = TokenBucket(RAW_PER_S, RAW_AT_ONCE)
        self._process = _ProcessStats()
        self._away_at = float("-inf")
        """When the bus was away last."""
        self._kept: deque[tuple[bus.Publisher, Any, int]] = deque()
        self.dropped = 0
        """Records that found too many waiting for the bus."""

    # ------------------------------------------------------------------ readings

    def event(self, event: Event, confirmed: Mode | None, *, loaded: bool) -> bool:
        """Publish what was measured in an event, then its raw frame; False if there were too many of those.

        `loaded`: motors may pull the battery down.
        """
        stamp_ns = self._wall.ns(event.at)
        published: list[str] = []
        for name, fields in measured(event, self.profile, confirmed).items():
            message = _CLASSES[name]()
            for field, value in fields.items():
                if isinstance(value, tuple):
                    getattr(message, field).extend(value)
                else:
                    setattr(message, field, value)
            if name == "sensor/battery":
                voltage_v = message.voltage_v
                message.charge, message.charge_error = battery.charge(voltage_v, loaded=loaded)
                message.level = self._battery.level or battery.BatteryLevel.OK
            self._reading(name, message, stamp_ns, published)
        if not self._raw.take(1, event.at):
            return False
        frame = _CLASSES["frame/rx"]()
        frame.data = event.raw
        frame.verdict = verdict_of(event)
        frame.published.extend(published)
        self._publishers["frame/rx"].put(frame, stamp_ns)
        return True

    def _reading(self, name: str, message: Any, stamp_ns: int, published: list[str]) -> None:
        self._rings[name].add(stamp_ns, self._publishers[name].put(message, stamp_ns))
        published.append(name)

    # ------------------------------------------------------------------ frames out, records

    def written(self, write: OutgoingFrame, at: float, *, whole: bool) -> None:
        """Publish a frame that was written, or was not."""
        frame = _CLASSES["frame/tx"]()
        frame.data = write.data
        frame.command_id = write.command_id
        frame.why = write.why
        frame.written = whole
        self._publishers["frame/tx"].put(frame, self._wall.ns(at))

    def command(self, record: CommandRecord, request: tuple[bytes, str] | None) -> None:
        """Publish one transition of a command; the first carries the request as it came."""
        event = _CLASSES["event/command"]()
        command = record.command
        event.id = command.id
        event.verb = command.verb
        event.sender = command.sender.name
        event.kind = command.sender.kind
        event.phase = record.phase
        event.reason = record.reason or ""
        event.words = record.words
        if command.age_s is not None:
            event.age_s = command.age_s
        if record.worst_case_s > 0:  # only a stop announces one
            event.worst_case_s = record.worst_case_s
        if record.phase not in _ON_ARRIVAL:
            event.took_s = record.took_s
        event.count = record.count
        event.evidence.extend(record.evidence)
        event.basis = record.basis
        if request is not None:
            event.request, event.request_encoding = request
        self._record("event/command", event, record.at)

    def log(self, record: LogRecord) -> None:
        """Publish a notable event as foxglove.Log."""
        message: Any = messages.message_class("foxglove.Log")()
        message.timestamp.seconds, message.timestamp.nanos = divmod(self._wall.ns(record.at), 1_000_000_000)
        message.level = _LEVELS[record.level]
        message.name = f"{self._car} {record.code}"
        message.message = record.words
        self._record("event/log", message, record.at)

    def _record(self, name: str, message: Any, at: float) -> None:
        """Publish what explains afterwards what happened; while the bus is away it waits."""
        publisher, stamp_ns = self._publishers[name], self._wall.ns(at)
        if not self._kept and at > self._away_at + BACK_S:
            publisher.put(message, stamp_ns)
            return
        self._kept.append((publisher, message, stamp_ns))
        if len(self._kept) > KEPT_RECORDS:
            self._kept.popleft()
            self.dropped += 1

    def bus_away(self, now: float) -> None:
        """The bus cannot be reached now, or it is not sure that it can."""
        self._away_at = now

    def bus_back(self, now: float, *, at_once: bool = False) -> None:
        """The bus can be reached: what waited is published when the others are back, too, or at once."""
        if self._kept and (at_once or now > self._away_at + BACK_S):
            for publisher, message, stamp_ns in self._kept:
                publisher.put(message, stamp_ns)
            self._kept.clear()

    # ------------------------------------------------------------------ states

    def states(self, control: Controller, health: LinkHealth, now: float, *, force: bool = False) -> None:
        """Publish each state that changed, and all of them once a second."""
        mode, believed, safety = control.mode, control.believed, control.safety
        lease = safety.leased(now)
        changes: dict[str, tuple[object, ...]] = {
            "state/link": (health.state, health.reconnects, health.state == "lost" and health.reason),
            "state/mode": (mode.asked, mode.inferred, mode.verdict),
            "state/motion": (control.motion, control.owner, believed.fan, believed.servo_deg, believed.speed),
            "state/safety": (
                safety.kept,
                lease and lease.holder,
                control.motors,
                control.basis,
                control.model.trust.state,
            ),
        }
        for name, told in changes.items():
            late = now - self._told_at.get(name, float("-inf")) >= STATE_EVERY_S
            if force or late or self._told.get(name) != told:
                self._told[name] = told
                self._state(name, control, health, now)

    def _state(self, name: str, control: Controller, health: LinkHealth, now: float) -> None:
        message = _CLASSES[name]()
        match name:
            case "state/link":
                _fill_link(message, health, self._url, now)
                if control.lost_frames:
                    message.rejects["not_obeyed"] = control.lost_frames
            case "state/mode":
                _fill_mode(message, control, now)
            case "state/motion":
                _fill_motion(message, control, now)
            case _:
                _fill_safety(message, control, now)
        self._put_state(name, message, now)

    def health(self, now: float, *, loop_lag_s: float, bus_drops: int, platform: PlatformDetector) -> None:
        """Publish what the gateway's process does, and what the car is treated as."""
        message = _CLASSES["state/health"]()
        self._process.fill(message, now)
        message.host = socket.gethostname()
        message.link = self._url
        message.version = VERSION
        message.platform = self.profile.name
        message.platform_evidence.extend(platform.evidence)
        message.platform_contradictions.extend(platform.contradictions)
        message.capabilities.extend(sorted(self.profile.capabilities))
        message.loop_lag_s = loop_lag_s
        message.bus_drops = bus_drops
        self._put_state("state/health", message, now)

    def _put_state(self, name: str, message: Any, now: float) -> None:
        self._told_at[name] = now
        stamp_ns = self._wall.ns(now)
        self._rings[name].add(stamp_ns, self._publishers[name].put(message, stamp_ns))

    # ------------------------------------------------------------------ queries

    def answers(self, family: str, query: zenoh.Query) -> Iterator[None]:
        """Answer a query for one family, `sensor` or `state`: the latest values, or the history that it asks for.

        Stops after every so many, so that whoever iterates can do something else: the whole history as JSON takes
        longer than a car may be left alone.
        """
        with query:
            parameters = query.parameters
            form = parameters.get("format") or "protobuf"
            if form not in ("protobuf", "json"):
                query.reply_err(f"format={form}: allowed are json and protobuf", encoding="text/plain")
                return
            asked = [
                (self._publishers[name], ring)
                for name, ring in self._rings.items()
                if self._publishers[name].topic.family == family
                and query.key_expr.intersects(self._publishers[name].key)
            ]
            time_range, last, now_ns = parameters.get("_time"), parameters.get("last"), time.time_ns()
            try:
                found = [
                    (publisher, value)
                    for publisher, ring in asked
                    for value in ring.select(time_range=time_range, last=last, now_ns=now_ns)
                ]
            except BadRange as error:
                query.reply_err(str(error), encoding="text/plain")
                return
            for count, (publisher, value) in enumerate(found, 1):
                alone = len(found) == 1
                bus.reply_value(query, publisher.key, value.payload, publisher.topic, express=alone)
                if count % SLICE == 0:
                    yield


def _fill_link(message: pb.Link, health: LinkHealth, url: str, now: float) -> None:
    message.state = health.state
    message.reason = health.reason
    message.url = url
    message.rx_bytes = health.rx_bytes
    message.tx_bytes = health.tx_bytes
    message.rx_frames = health.rx_frames
    message.tx_frames = health.tx_frames
    message.rejects.update(health.rejects)
    message.reconnects = health.reconnects
    message.tx_airtime = health.airtime(now)
    message.since_s = now - health.since
    if health.last_rx_at is not None:
        message.last_rx_s = max(0.0, now - health.last_rx_at)


def _fill_mode(message: pb.Mode, control: Controller, now: float) -> None:
    mode = control.mode
    message.asked = mode.asked or "unknown"
    message.inferred = mode.inferred or "unknown"
    message.verdict = mode.verdict
    message.evidence = mode.evidence
    if mode.evidence_at is not None:
        message.evidence_age_s = max(0.0, now - mode.evidence_at)
    message.candidates.extend(mode.candidates)


def _fill_motion(message: pb.Motion, control: Controller, now: float) -> None:
    message.motion = control.motion or "unknown"
    message.source = "unknown" if control.motion is None else "commanded" if control.owner else "assumed"
    message.speed = control.profile.speed.fraction(control.believed.speed)
    message.owner = control.owner
    expires_in_s = control.expires_in_s(now)
    if expires_in_s is not None:
        message.expires_in_s = expires_in_s
    message.fan = bool(control.believed.fan)
    if control.believed.servo_deg is not None:
        message.servo_deg = control.believed.servo_deg


def _fill_safety(message: pb.Safety, control: Controller, now: float) -> None:
    safety = control.safety
    for estop in safety.estops:
        scope = "fleet" if estop.fleet_wide else "car"
        shown = message.estops.add(id=estop.id, by=estop.by, why=estop.why, scope=scope)
        shown.stamp.seconds, shown.stamp.nanos = divmod(estop.at_ns, 1_000_000_000)
    message.ended.extend(safety.ended)
    if safety.hold is not None:
        message.hold.by = safety.hold.by
        message.hold.since.seconds, message.hold.since.nanos = divmod(safety.hold.since_ns, 1_000_000_000)
    lease = safety.leased(now)
    if lease is not None:
        message.lease.holder, message.lease.kind = lease.holder.name, lease.holder.kind
        message.lease.expires_in_s = lease.until - now
    message.motors = control.motors
    message.motors_basis = control.basis or ""
    trust = control.model.trust
    message.trust = trust.state
    message.trust_evidence = trust.evidence
    if trust.shown_at is not None:
        message.shown_age_s = max(0.0, now - trust.shown_at)
    message.worst_stop_s = control.worst_stop_s(now)


class _ProcessStats:
    """CPU, memory and age of this process."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._cpu_s = time.process_time()
        self._at = self._started

    def fill(self, message: pb.Health, now: float) -> None:
        cpu_s = time.process_time()
        message.pid = os.getpid()
        message.uptime_s = now - self._started
        message.cpu = (cpu_s - self._cpu_s) / max(now - self._at, 1e-3)
        message.rss_mb = _rss_mb()
        self._cpu_s, self._at = cpu_s, now


def _rss_mb() -> float:
    try:
        pages = int(_STATM.read_bytes().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except FileNotFoundError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3

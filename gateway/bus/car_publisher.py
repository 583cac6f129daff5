"""Publishes one car's readings, frames, states and records as messages, and answers queries of values.

The driver decides which measurements are published, and what is claimed about the car. This module fills the messages.
"""

import math
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, Final

import zenoh

from gateway.bus.history_buffer import BadRange, HistoryBuffer, Value
from gateway.bus.process_stats import ProcessStats
from gateway.clock import Sleeps, WallClock
from gateway.control.control_output import CommandRecord, LogRecord, OutgoingFrame
from gateway.control.controller import Controller
from gateway.control.driver import Driver, DriverClaims, Event
from gateway.control.link_health import LinkHealth
from schemas import bus, keys, messages, topics
from schemas.gen import fleet_v1_pb2 as pb
from schemas.token_bucket import TokenBucket
from schemas.words import UNKNOWN, BatteryLevel, LinkState, MotionSource, Motors, Phase, Scope

VERSION: Final = "0.1.0"
STATE_INTERVAL_S: Final = 1.0
"""Maximum interval between two messages of a state. A change is published at once (docs/reference/keys.md#topics)."""
ANSWERS_PER_SLICE: Final = 50
"""Number of answers to a query after which the loop serves the car. As JSON, they take 3 ms."""
CLIENTS_BACK_S: Final = 1.0
"""Time after a loss of the bus until the other clients, such as the recorder, are connected again."""
BUS_LOSS_GAP_S: Final = 1.0
"""During a gap of the loop of at least this length, the bus may have been lost unnoticed (Zenoh's lease is 2 s)."""
MAX_PENDING_RECORDS: Final = 1000
"""Maximum records of commands and events that wait for the bus. The oldest are dropped and counted."""
RAW_PER_S: Final = 100.0
RAW_BURST: Final = 1000.0
"""Rate limit and burst of published raw frames. A car sends up to 27 a second (docs/reference/protocol.md#rates), and a
link may delay many of them and deliver them together."""
_CLASSES: Final[dict[str, Any]] = {
    topic.name: messages.message_class(topic.message)
    for topic in topics.CAR_TOPICS
    if topic.message.startswith("fleet.v1.")
}
"""Message classes by topic. Each message is a new object, because a cleared one would not free its memory."""
_ON_ARRIVAL: Final = frozenset({Phase.ASKED, Phase.QUEUED, Phase.REJECTED})
"""Phases that are recorded when a command arrives. These records have no `took_s`."""


class CarPublisher:
    """The publishers and history buffers of one car."""

    def __init__(self, opened: bus.Bus, fleet: str, car: str, control: Controller[Driver], url: str) -> None:
        self._fleet = fleet
        self._car = car
        self._driver = control.driver
        self._url = url
        self._boot_id = opened.boot_id
        self._publishers: dict[str, bus.Publisher] = {}
        self._histories: dict[str, HistoryBuffer] = {}
        self._published_states: dict[str, tuple[object, ...]] = {}
        self._published_at: dict[str, float] = {}
        self._claims: tuple[object, ...] = ()
        """`_claims_of` the car when the states were last published."""
        self._findings: tuple[object, ...] = ()
        """`_findings_of` the car when its health was last published."""
        for topic in topics.CAR_TOPICS:
            if topic.family == "sim":
                continue
            key = keys.topic_key(fleet, car, topic.name)
            self._publishers[topic.name] = opened.publisher(key, topic, car)
            if topic.history_size:
                self._histories[topic.name] = HistoryBuffer(topic.history_size)
        self._wall = WallClock()
        self._sleeps = Sleeps()
        self._raw = TokenBucket(RAW_PER_S, RAW_BURST)
        self._process = ProcessStats()
        self._bus_lost_at = float("-inf")
        """When the bus was last unreachable."""
        self._pending: deque[tuple[bus.Publisher, Any, int]] = deque()
        self.dropped = 0
        """Number of dropped records, and of published poses that are not usable."""

    # ------------------------------------------------------------------ readings

    def publish_event(self, event: Event) -> bool:
        """Publish the measurements of an event, then its raw frame. Return False if raw frames exceed their rate limit.

        The driver decides which measurements an event has.
        """
        model = self._driver.model
        stamp_ns = self._wall.ns(event.at)
        published: list[str] = []
        for name, fields in self._driver.measured(event).items():
            message = _CLASSES[name](**fields)
            if name == "sensor/battery":
                loaded = model.motors is not Motors.OFF
                # The driver updates its battery only after this, and the message must agree with the log.
                battery = model.battery.after(message.voltage_v, loaded=loaded, now=event.at)
                if battery.charge is not None:
                    message.charge, message.charge_error = battery.charge
                message.level = battery.level or BatteryLevel.OK
            self._put_kept(name, message, event.at, stamp_ns)
            published.append(name)
        if not self._raw.take(1, event.at):
            return False
        frame = _CLASSES["frame/rx"]()
        frame.data = event.raw
        frame.verdict = self._driver.verdict(event)
        frame.published.extend(published)
        self._publishers["frame/rx"].put(frame, stamp_ns)
        return True

    def _put_kept(self, name: str, message: Any, at: float, stamp_ns: int) -> None:
        payload = self._publishers[name].put(message, stamp_ns)
        self._histories[name].add(Value(at, stamp_ns, payload))

    def keep_pose(self, sample: bus.Sample, now: float) -> None:
        """Store a pose that a program outside the car has published, so that queries are answered with it.

        Drop and count a payload that is not a pose, and a pose with a number that is not finite: no program of ours
        sends such a thing.
        """
        name = "sensor/pose"
        if sample.deleted or sample.why_unread:
            self.dropped += 1
            return
        try:
            message: Any = messages.parse(topics.TOPICS[name].message, sample.payload, sample.encoding)
        except messages.BadPayload:
            self.dropped += 1
            return
        if message.boot_id == self._boot_id:
            return  # the pose was published by this gateway, which has stored it already
        if not all(math.isfinite(each) for each in (message.x_m, message.y_m, message.heading_rad)):
            self.dropped += 1
            return
        if not message.stamp.seconds:
            message.stamp.FromNanoseconds(self._wall.ns(now))  # it has no stamp, so use the time of arrival
        self._histories[name].add(Value(now, messages.stamp_ns(message.stamp), message.SerializeToString()))

    # ------------------------------------------------------------------ frames out, records

    def publish_frame(self, write: OutgoingFrame, at: float, *, whole: bool) -> None:
        """Publish a frame and whether it was written."""
        frame = _CLASSES["frame/tx"]()
        frame.data = write.data
        frame.command_id = write.command_id
        frame.why = write.why
        frame.written = whole
        self._publishers["frame/tx"].put(frame, self._wall.ns(at))

    def publish_command(self, record: CommandRecord, request: tuple[bytes, str] | None) -> None:
        """Publish one transition of a command. `request` is the original request, for the first transition only."""
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
        if record.worst_case_s > 0:  # only a stop has a worst case
            event.worst_case_s = record.worst_case_s
        if record.phase not in _ON_ARRIVAL:
            event.took_s = record.took_s
        event.count = record.count
        event.evidence.extend(record.evidence)
        event.basis = record.basis
        if request is not None:
            event.request, event.request_encoding = request
        self._put_record("event/command", event, record.at)

    def publish_log(self, record: LogRecord) -> None:
        """Publish a log record as foxglove.Log."""
        name = f"{self._car} {record.code}"
        message = messages.log_message(self._wall.ns(record.at), record.level, name, record.words)
        self._put_record("event/log", message, record.at)

    def _put_record(self, name: str, message: Any, at: float) -> None:
        """Publish a record. Buffer it while the bus is unreachable."""
        publisher, stamp_ns = self._publishers[name], self._wall.ns(at)
        if not self._pending and at > self._bus_lost_at + CLIENTS_BACK_S:
            publisher.put(message, stamp_ns)
            return
        self._pending.append((publisher, message, stamp_ns))
        if len(self._pending) > MAX_PENDING_RECORDS:
            self._pending.popleft()
            self.dropped += 1

    def on_bus_lost(self, now: float) -> None:
        """Buffer records from now on, because the bus is, or may be, unreachable."""
        self._bus_lost_at = now

    def on_bus_connected(self, now: float, *, at_once: bool = False) -> None:
        """Publish the buffered records once the other clients are connected again. With `at_once`, publish them now."""
        if self._pending and (at_once or now > self._bus_lost_at + CLIENTS_BACK_S):
            for publisher, message, stamp_ns in self._pending:
                publisher.put(message, stamp_ns)
            self._pending.clear()

    # ------------------------------------------------------------------ states

    @property
    def is_outdated(self) -> bool:
        """True if a reading or a silence has changed a state since the last `publish_states`."""
        return _claims_of(self._driver.model) != self._claims

    @property
    def has_new_findings(self) -> bool:
        """True if a finding about the car has changed since the last `publish_health`."""
        return _findings_of(self._driver.model) != self._findings

    def publish_states(
        self, control: Controller[Driver], health: LinkHealth, now: float, *, force: bool = False
    ) -> None:
        """Publish each state that changed, and all of them once a second."""
        model, safety = control.driver.model, control.safety
        mode = model.mode
        self._claims = _claims_of(model)
        lease = safety.lease_at(now)
        changes: dict[str, tuple[object, ...]] = {
            "state/link": (health.state, health.reconnects, health.state is LinkState.LOST and health.reason),
            "state/mode": (mode.asked, mode.inferred, mode.verdict),
            "state/motion": (model.motion, control.owner, model.outputs),
            "state/safety": (
                safety.persisted,
                lease and lease.holder,
                model.motors,
                model.basis,
                model.trust.state,
                control.is_free(now),
            ),
        }
        for name, state in changes.items():
            is_due = now - self._published_at.get(name, float("-inf")) >= STATE_INTERVAL_S
            if force or is_due or self._published_states.get(name) != state:
                self._published_states[name] = state
                self._publish_state(name, control, health, now)

    def _publish_state(self, name: str, control: Controller[Driver], health: LinkHealth, now: float) -> None:
        message = _CLASSES[name]()
        match name:
            case "state/link":
                _fill_link(message, health, self._url, now, self._sleeps)
                if control.driver.lost_frames:
                    message.rejects["not_obeyed"] = control.driver.lost_frames
            case "state/mode":
                _fill_mode(message, control, now, self._sleeps)
            case "state/motion":
                _fill_motion(message, control, now)
            case _:
                _fill_safety(message, control, now, self._sleeps)
        self._put_state(name, message, now)

    def publish_health(self, now: float, *, loop_lag_s: float, bus_drops: int) -> None:
        """Publish the health of the process, and the profile in force."""
        message = _CLASSES["state/health"]()
        self._process.fill(message)
        message.uptime_s = self._sleeps.age_s(self._process.started, now)
        message.host = socket.gethostname()
        message.link = self._url
        message.version = VERSION
        model = self._driver.model
        message.platform = model.profile.name
        message.capabilities.extend(sorted(model.profile.capabilities))
        message.loop_lag_s = loop_lag_s
        message.bus_drops = bus_drops
        _fill_findings(message, model)
        self._findings = _findings_of(model)
        self._put_state("state/health", message, now)

    def _put_state(self, name: str, message: Any, now: float) -> None:
        self._published_at[name] = now
        self._put_kept(name, message, now, self._wall.ns(now))

    def on_slept(self, slept_s: float, now: float) -> None:
        """Add a sleep of the computer (s) to the ages of values and claims: the monotonic clock does not count it."""
        self._sleeps.add(slept_s, now)
        for history in self._histories.values():
            history.age(slept_s)

    # ------------------------------------------------------------------ queries

    def answer_query(self, family: str, query: zenoh.Query) -> Iterator[None]:
        """Answer a query for one family, `sensor` or `state`, with the latest values or the history.

        Yields after each slice, so that the caller can serve the car: to send a whole history as JSON takes long.
        """
        with query:
            parameters = query.parameters
            form = parameters.get("format") or "protobuf"
            if form not in ("protobuf", "json"):
                query.reply_err(f"format={form}: allowed are json and protobuf", encoding="text/plain")
                return
            matching = [
                (self._publishers[name], ring)
                for name, ring in self._histories.items()
                if self._publishers[name].topic.family == family
                and query.key_expr.intersects(self._publishers[name].key)
            ]
            time_range, last = parameters.get("_time"), parameters.get("last")
            now = time.monotonic()
            try:
                values = [
                    (publisher, value)
                    for publisher, ring in matching
                    for value in ring.select(time_range=time_range, last=last, now=now)
                ]
            except BadRange as error:
                query.reply_err(str(error), encoding="text/plain")
                return
            for count, (publisher, value) in enumerate(values, 1):
                alone = len(values) == 1
                bus.reply_value(query, publisher.key, value.payload, publisher.topic, express=alone)
                if count % ANSWERS_PER_SLICE == 0:
                    yield


def _fill_findings(message: pb.Health, model: DriverClaims) -> None:
    findings = model.findings
    message.platform_evidence.extend(findings.platform_evidence)
    message.platform_contradictions.extend(findings.platform_contradictions)
    message.shows_stops, message.shows_stops_words = model.shows_stops
    message.doubted = model.doubted
    message.MergeFrom(type(message)(**findings.numbers))


def _fill_link(message: pb.Link, health: LinkHealth, url: str, now: float, sleeps: Sleeps) -> None:
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
    message.since_s = sleeps.age_s(health.since, now)
    if health.last_rx_at is not None:
        message.last_rx_s = sleeps.age_s(health.last_rx_at, now)


def _fill_mode(message: pb.Mode, control: Controller[Driver], now: float, sleeps: Sleeps) -> None:
    mode = control.driver.model.mode
    message.asked = mode.asked or UNKNOWN
    message.inferred = mode.inferred or UNKNOWN
    message.verdict = mode.verdict
    message.evidence = mode.evidence
    if mode.evidence_at is not None:
        message.evidence_age_s = sleeps.age_s(mode.evidence_at, now)
    if mode.since is not None:
        message.since_s = sleeps.age_s(mode.since, now)
    message.candidates.extend(mode.candidates)


def _findings_of(model: DriverClaims) -> tuple[object, ...]:
    """Return the findings about the car itself: its profile, and whether its readings show its stops."""
    return model.profile.name, model.shows, model.doubted


def _claims_of(model: DriverClaims) -> tuple[object, ...]:
    """Return the claims in the published states that a reading or a silence may change."""
    return model.mode.verdict, model.mode.inferred, model.motors, model.basis, *_findings_of(model)


def _fill_motion(message: pb.Motion, control: Controller[Driver], now: float) -> None:
    model = control.driver.model
    message.motion = model.motion or UNKNOWN
    known = MotionSource.COMMANDED if control.owner else MotionSource.ASSUMED
    message.source = MotionSource.UNKNOWN if model.motion is None else known
    message.speed = model.outputs.speed
    message.owner = control.owner
    expires_in_s = control.expires_in_s(now)
    if expires_in_s is not None:
        message.expires_in_s = expires_in_s
    message.fan = bool(model.outputs.fan)
    if model.outputs.servo_deg is not None:
        message.servo_deg = model.outputs.servo_deg


def _fill_safety(message: pb.Safety, control: Controller[Driver], now: float, sleeps: Sleeps) -> None:
    safety = control.safety
    for estop in safety.estops:
        scope = Scope.FLEET if estop.fleet_wide else Scope.CAR
        shown = message.estops.add(id=estop.id, by=estop.by, why=estop.why, scope=scope, rank=estop.rank)
        _set_stamp(shown.stamp, estop.at_ns)
    message.ended.extend(safety.ended)
    if safety.hold is not None:
        message.hold.by, message.hold.rank = safety.hold.by, safety.hold.rank
        _set_stamp(message.hold.since, safety.hold.since_ns)
    for pause in safety.pauses:
        added = message.pauses.add(id=pause.id, by=pause.by, why=pause.why, rank=pause.rank)
        _set_stamp(added.stamp, pause.at_ns)
    message.ended_pauses.extend(safety.ended_pauses)
    loan = safety.loan_at(now)
    if loan is not None:
        message.loan.to, message.loan.by, message.loan.rank = loan.to, loan.by, loan.rank
        _set_stamp(message.loan.since, loan.since_ns)
        message.loan.expires_in_s = safety.loan_until - now
    if control.people.roles is not None:
        control.people.fill(message.people)
    lease = safety.lease_at(now)
    if lease is not None:
        message.lease.holder, message.lease.kind = lease.holder.name, lease.holder.kind
        message.lease.expires_in_s = lease.until - now
    model = control.driver.model
    message.motors = model.motors
    message.motors_basis = model.basis or ""
    trust = model.trust
    message.trust = trust.state
    message.trust_evidence = trust.evidence
    if trust.since > float("-inf"):
        message.trust_since_s = sleeps.age_s(trust.since, now)
    if trust.shown_at is not None:
        message.shown_age_s = sleeps.age_s(trust.shown_at, now)
    if model.link_open:
        message.worst_stop_s = control.driver.worst_s(now)
    message.waits_for = control.waits_for(now)


def _set_stamp(stamp: Any, at_ns: int) -> None:
    stamp.seconds, stamp.nanos = divmod(at_ns, 1_000_000_000)

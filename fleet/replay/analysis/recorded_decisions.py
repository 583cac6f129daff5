"""Extracts the coordinators of a session: when each ran, its plans, its decisions, and the presence of cars.

Liveliness tokens are not recorded, so the presence of a car is inferred from its states, which its gateway publishes
once a second. If they pause, or if the next state has another boot_id, the gateway was gone in between.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from msgspec import Struct, field

from fleet.policy.decision import DecisionKind
from fleet.policy.plan_requests import EVENTS, PlanRequest
from fleet.recording.reading.session import Recorded
from schemas import keys, messages
from schemas.topics import TOPICS

DECISION_KEYS: Final = tuple(f"*/{keys.COORDINATOR}/{name}" for name in ("plan", "assignment", "decision", "log"))
STATE_KEYS: Final = ("*/*/state/*",)
MAX_STATE_PAUSE_NS: Final = 2_500_000_000
"""Maximum time between two states of a gateway that was there all the time. After a longer pause it counts as gone."""


class RecordedDecision(Struct, frozen=True):
    """One decision about a subject.

    It holds from `at_ns` (the recorder's clock) until the next decision about that subject.
    """

    at_ns: int
    kind: str
    decided: str
    role: str
    why: str = ""
    readings: tuple[str, ...] = ()
    would_change: str = ""

    @property
    def what(self) -> tuple[str, str, str]:
        """Return the parts to compare."""
        # The reasons are not compared, because they contain ages, which always differ. Nor is the role of a car that is
        # left alone: the car loses its role later without a decision.
        return self.kind, self.decided, "" if self.kind == DecisionKind.ALONE else self.role

    def __str__(self) -> str:
        match self.kind:
            case DecisionKind.VACANT | DecisionKind.FILLED:
                return f"cars: {self.decided.removesuffix(' of all')}"
            case DecisionKind.OUT | DecisionKind.PHASE | DecisionKind.ALONE:
                return self.decided
            case _:
                return f"{self.decided} ({f'role {self.role}' if self.role else 'no role'})"


Timeline = dict[str, list[RecordedDecision]]
"""Decisions by subject, in order, each different from the one before."""


def add(timeline: Timeline, subject: str, decision: RecordedDecision) -> None:
    """Add a decision if it differs from the last one about its subject."""
    before = timeline.setdefault(subject, [])
    if not before or before[-1].what != decision.what:
        before.append(decision)


class RecordedRequest(Struct, frozen=True):
    """A request of a person that the coordinator carried out."""

    at_ns: int
    request: PlanRequest
    by: str


_REQUESTS: Final = {f"{keys.COORDINATOR} {code}": (request, words) for request, (code, words) in EVENTS.items()}


class CoordinatorRun(Struct):
    """One coordinator, from its first message in the session to its last."""

    fleet: str
    start_ns: int
    end_ns: int
    whole: bool
    """True if the session contains its start."""
    plans: list[tuple[int, str]] = field(default_factory=list)
    """Start time and text of each plan."""
    decisions: Timeline = field(default_factory=dict)
    roles: Mapping[str, str] = field(default_factory=dict)
    """First role of each car."""
    phase: str = ""
    stopped_by: str = ""
    """The sender who had stopped the plan before this coordinator started. Empty if nobody had."""
    requests: list[RecordedRequest] = field(default_factory=list)
    assigned: bool = False
    """True once it has published its roles."""


def runs(recorded: Iterable[Recorded]) -> list[CoordinatorRun]:
    """Return the coordinators of a session in order of their start; `recorded` has the messages of DECISION_KEYS."""
    found: dict[tuple[str, str], CoordinatorRun] = {}
    for item in recorded:
        key = keys.parse(item.key)
        value = decode_message(item)
        if key is None or value is None:
            continue
        at_ns = item.recorded_ns
        if key.topic == "log":  # log events do not name their coordinator, so assume the last one that started
            run = next((each for each in reversed(found.values()) if each.fleet == key.fleet), None)
            if run is not None and value.name in _REQUESTS:
                request, words = _REQUESTS[value.name]
                run.requests.append(RecordedRequest(at_ns, request, value.message.partition(f" {words}")[0]))
            continue
        run = found.get((key.fleet, value.boot_id))
        if run is None:
            # A coordinator publishes its plan first, and repeats everything every ten seconds.
            whole = key.topic == "plan" and value.seq == 1
            run = found[key.fleet, value.boot_id] = CoordinatorRun(key.fleet, at_ns, at_ns, whole)
        run.end_ns = max(run.end_ns, at_ns)
        match key.topic:
            case "plan":
                if not run.plans or run.plans[-1][1] != value.text:
                    run.plans.append((at_ns, value.text))
            case "assignment":
                if not run.assigned:
                    run.assigned, run.stopped_by = True, value.stopped_by
                if not run.roles:
                    run.roles = {car: role.name for role in value.roles for car in role.cars}
                    run.phase = value.phase
            case _:
                decision = RecordedDecision(
                    at_ns,
                    value.kind,
                    value.decided,
                    value.role,
                    value.why,
                    tuple(value.readings),
                    value.would_change,
                )
                add(run.decisions, value.subject, decision)
    return sorted(found.values(), key=lambda run: run.start_ns)


class PresenceToken(Struct, frozen=True):
    """A car appeared on the bus or disappeared."""

    at_ns: int
    car: str
    alive: bool


def presence(recorded: Iterable[Recorded], end_ns: int) -> list[PresenceToken]:
    """Return when cars appeared and disappeared until `end_ns`, from the messages of STATE_KEYS.

    The time at which a car disappeared is an estimate.
    """
    last: dict[str, tuple[int, str]] = {}
    found = []
    for item in recorded:
        key = keys.parse(item.key)
        value = decode_message(item)
        if key is None or value is None:
            continue
        at_ns, before = item.recorded_ns, last.get(key.car)
        if before is None:
            found.append(PresenceToken(at_ns, key.car, alive=True))
        elif before[1] != value.boot_id or at_ns - before[0] > MAX_STATE_PAUSE_NS:
            found.append(PresenceToken(min(before[0] + 500_000_000, (before[0] + at_ns) // 2), key.car, alive=False))
            found.append(PresenceToken(at_ns, key.car, alive=True))
        last[key.car] = at_ns, value.boot_id
    found += [
        PresenceToken(at_ns + 500_000_000, car, alive=False)
        for car, (at_ns, _) in last.items()
        if end_ns - at_ns > MAX_STATE_PAUSE_NS
    ]
    return sorted(found, key=lambda token: token.at_ns)


def decode_message(item: Recorded) -> Any:
    """Return the decoded message of a known topic, or None if the topic is unknown or the payload invalid."""
    key = keys.parse(item.key)
    if key is None:
        return None
    topic = TOPICS.get(f"{key.car}/{key.topic}" if key.car.startswith("@") else key.topic)
    if topic is None or topic.message != item.message:
        return None
    try:
        return messages.parse(item.message, item.payload, topic.encoding)
    except messages.BadPayload:
        return None

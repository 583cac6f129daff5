"""What a session recorded of coordinators: when each ran, with which plan, what it decided; and which cars were there.

A coordinator's liveliness tokens are not recorded. That a car was on the bus follows from its states, which come once
a second: it was gone where they pause, or where its gateway's next one is of another start.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from fleet.policy.decision import DecisionKind
from fleet.recording.reading.session import Recorded
from schemas import keys, messages
from schemas.topics import TOPICS

KEYS: Final = tuple(f"*/{keys.COORDINATOR}/{name}" for name in ("plan", "assignment", "decision"))
STATES: Final = ("*/*/state/*",)
GONE_NS: Final = 2_500_000_000
"""States pause so long only if the gateway is away."""


@dataclass(frozen=True, slots=True)
class RecordedDecision:
    """A decision of one subject, from `at_ns` (the recorder's clock) until its next."""

    at_ns: int
    kind: str
    decided: str
    role: str
    why: str = ""
    readings: tuple[str, ...] = ()
    would_change: str = ""

    @property
    def what(self) -> tuple[str, str, str]:
        """What is compared. Reasons have ages in them; the role of a car left alone ends later without a word."""
        return self.kind, self.decided, "" if self.kind == DecisionKind.ALONE else self.role

    def __str__(self) -> str:
        role = f" (role {self.role})" if self.role and self.kind != "role" else ""
        return f"{self.kind} {self.decided}{role}"


Timeline = dict[str, list[RecordedDecision]]
"""By subject, the decisions that differ from the one before, in order."""


def add(timeline: Timeline, subject: str, said: RecordedDecision) -> None:
    """One more decision; one that says what the last one said is none."""
    before = timeline.setdefault(subject, [])
    if not before or before[-1].what != said.what:
        before.append(said)


@dataclass(slots=True)
class CoordinatorRun:
    """One coordinator, from its first message in the session to its last."""

    fleet: str
    start_ns: int
    end_ns: int
    whole: bool
    """Whether the session has its beginning."""
    plans: list[tuple[int, str]] = field(default_factory=list)
    """From when on which text."""
    said: Timeline = field(default_factory=dict)
    roles: Mapping[str, str] = field(default_factory=dict)
    """Of each car, as first said."""
    phase: str = ""


def runs(recorded: Iterable[Recorded]) -> list[CoordinatorRun]:
    """The coordinators of a session, in order; `recorded`: the messages of KEYS."""
    found: dict[tuple[str, str], CoordinatorRun] = {}
    for one in recorded:
        key = keys.parse(one.key)
        value = message(one)
        if key is None or value is None:
            continue
        at_ns = one.recorded_ns
        run = found.get((key.fleet, value.boot_id))
        if run is None:
            # The plan is the first thing that a coordinator says; later it says all of it again every ten seconds.
            whole = key.topic == "plan" and value.seq == 1
            run = found[key.fleet, value.boot_id] = CoordinatorRun(key.fleet, at_ns, at_ns, whole)
        run.end_ns = max(run.end_ns, at_ns)
        match key.topic:
            case "plan":
                if not run.plans or run.plans[-1][1] != value.text:
                    run.plans.append((at_ns, value.text))
            case "assignment":
                if not run.roles:
                    run.roles = {car: role.name for role in value.roles for car in role.cars}
                    run.phase = value.phase
            case _:
                said = RecordedDecision(
                    at_ns,
                    value.kind,
                    value.decided,
                    value.role,
                    value.why,
                    tuple(value.readings),
                    value.would_change,
                )
                add(run.said, value.subject, said)
    return sorted(found.values(), key=lambda run: run.start_ns)


@dataclass(frozen=True, slots=True)
class PresenceToken:
    """A car came to the bus, or went."""

    at_ns: int
    car: str
    alive: bool


def presence(recorded: Iterable[Recorded], end_ns: int) -> list[PresenceToken]:
    """When cars came and went, by their states (those of STATES), until `end_ns`; the times of going are estimates."""
    last: dict[str, tuple[int, str]] = {}
    found = []
    for one in recorded:
        key = keys.parse(one.key)
        value = message(one)
        if key is None or value is None:
            continue
        at_ns, before = one.recorded_ns, last.get(key.car)
        if before is None:
            found.append(PresenceToken(at_ns, key.car, alive=True))
        elif before[1] != value.boot_id or at_ns - before[0] > GONE_NS:
            found.append(PresenceToken(min(before[0] + 500_000_000, (before[0] + at_ns) // 2), key.car, alive=False))
            found.append(PresenceToken(at_ns, key.car, alive=True))
        last[key.car] = at_ns, value.boot_id
    found += [
        PresenceToken(at_ns + 500_000_000, car, alive=False)
        for car, (at_ns, _) in last.items()
        if end_ns - at_ns > GONE_NS
    ]
    return sorted(found, key=lambda token: token.at_ns)


def message(one: Recorded) -> Any:
    """The message of a key of the table; None for what is none, or does not parse."""
    key = keys.parse(one.key)
    if key is None:
        return None
    topic = TOPICS.get(f"{key.car}/{key.topic}" if key.car.startswith("@") else key.topic)
    if topic is None or topic.message != one.message:
        return None
    try:
        return messages.parse(one.message, one.payload, topic.encoding)
    except messages.BadPayload:
        return None


@dataclass(frozen=True, slots=True)
class DecisionDifference:
    """From when until when something else was decided then than now; None: nothing."""

    subject: str
    from_ns: int
    to_ns: int
    then: RecordedDecision | None
    now: RecordedDecision | None


def differences(then: Timeline, now: Timeline, start_ns: int, end_ns: int) -> Iterator[DecisionDifference]:
    """Every stretch between two times in which the two say otherwise; both sides are stepwise."""
    for subject in sorted({*then, *now}):
        one, other = then.get(subject, []), now.get(subject, [])
        times = sorted({start_ns, *(said.at_ns for said in (*one, *other) if start_ns < said.at_ns < end_ns)})
        open_from: int | None = None
        pair: tuple[RecordedDecision | None, RecordedDecision | None] = (None, None)
        for at_ns in (*times, end_ns):
            held = _at(one, at_ns), _at(other, at_ns)
            same = at_ns == end_ns or _what(held[0]) == _what(held[1])
            if open_from is not None and (same or (_what(held[0]), _what(held[1])) != (_what(pair[0]), _what(pair[1]))):
                yield DecisionDifference(subject, open_from, at_ns, *pair)
                open_from = None
            if not same and open_from is None:
                open_from, pair = at_ns, held


def _at(said: list[RecordedDecision], at_ns: int) -> RecordedDecision | None:
    found = None
    for each in said:
        if each.at_ns > at_ns:
            break
        found = each
    return found


def _what(said: RecordedDecision | None) -> tuple[str, str, str] | None:
    return None if said is None else said.what

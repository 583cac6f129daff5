"""A plan on what a session recorded: the coordinator's policy again, on the recorded clock. No bus; nothing is asked.

What cars said is what happened, whatever this plan would have made them do: a car that it would have put into another
mode says here what it said in its own. Three things a live coordinator knows are not in a recording: its tokens (see
coordinated.py), when exactly it looked (here: after every message, and ten times a second), and which of two messages
of nearly the same time it had first.
"""

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from fleet.coordinator.observer import FleetObserver
from fleet.policy.decide import step
from fleet.policy.plan.parser import parse
from fleet.policy.plan.plan import Plan
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, Refusal, topic_of
from fleet.policy.state import TAKEN_OVER, HeldRole, PersistedPolicy, PolicyState, carry_over, restore, to_persisted
from fleet.recording.reading.session import Recorded
from fleet.replay.analysis.recorded_decisions import (
    CoordinatorRun,
    PresenceToken,
    RecordedDecision,
    Timeline,
    add,
    message,
)
from schemas import keys, messages
from schemas.bus import Sample
from schemas.topics import PROTOBUF

TURN_NS: Final = 100_000_000
TOGETHER_NS: Final = 10_000_000
"""Messages so close together are taken in one turn."""
BEFORE_NS: Final = 60_000_000_000
"""What cars said so long before a coordinator began is what it was told when it asked."""
_ENDED: Final = frozenset({"sent", "complete", "effect_seen", "rejected", "failed", "expired", "superseded"})
_DONE: Final = frozenset({"sent", "complete", "effect_seen"})


@dataclass(frozen=True, slots=True)
class _NewPlan:
    at_ns: int
    plan: Plan


def wanted_keys(fleet: str, plans: Iterable[Plan]) -> list[str]:
    """What a coordinator with these plans hears, and what became of what it asked."""
    topics = {topic_of(name) for plan in plans for name in plan.names}
    return [f"{fleet}/*/{topic}" for topic in ("state/*", "event/command", *sorted(topics)) if topic]


def plans_of(run: CoordinatorRun) -> list[Plan]:
    """The plans that a coordinator had, one after the other; raises BadPlan for one that this version cannot read."""
    return [parse(text, f"the recorded plan of {run.fleet}") for _, text in run.plans]


@dataclass(slots=True)
class Replanning:
    """One coordinator again, from its beginning to its end: `plans` are (from when on, plan)."""

    run: CoordinatorRun
    plans: list[tuple[int, Plan]]
    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    kept: PersistedPolicy = field(default_factory=PersistedPolicy)
    """What the coordinator before it left."""
    said: Timeline = field(default_factory=dict)
    _observer: FleetObserver = field(init=False)
    _plan: Plan = field(init=False)
    _memory: PolicyState | None = None
    _busy: dict[str, str] = field(default_factory=dict)
    """Car: the mode that it was asked for."""
    _looked_ns: int = 0

    def __post_init__(self) -> None:
        self._observer = FleetObserver(self.listed)
        self._plan = self.plans[0][1]

    def go(self, recorded: Iterable[Recorded], tokens: Iterable[PresenceToken]) -> PersistedPolicy:
        """Take all of it, of the keys that are wanted and in order; what it would leave to the next coordinator."""
        changes = [_NewPlan(at_ns, plan) for at_ns, plan in self.plans[1:]]
        new_ns: int | None = None
        items: Iterable[Any] = heapq.merge(_ordered(recorded), tokens, changes, key=_time)
        for item in items:
            at_ns = _time(item)
            if at_ns > self.run.end_ns:
                break
            if new_ns is not None and at_ns - new_ns > TOGETHER_NS:
                self._look(new_ns)
                new_ns = None
            self._pass(at_ns)
            new_ns = at_ns if new_ns is None else new_ns
            match item:
                case PresenceToken():
                    self._observer.on_token(item.car, item.at_ns / 1e9, alive=item.alive)
                case _NewPlan():
                    if self._memory is not None:
                        self._memory = carry_over(self._memory, self._plan, item.plan)
                    self._plan = item.plan
                case _:
                    self._take(item)
        self._pass(self.run.end_ns)
        self._look(self.run.end_ns)
        assert self._memory is not None
        return to_persisted(self._plan, self._memory, self.run.end_ns / 1e9, self.run.end_ns / 1e9)

    def _take(self, item: Recorded) -> None:
        if item.key.endswith("/event/command"):
            self._outcome(item)
        else:
            encoding = f"{PROTOBUF};{item.message}"
            self._observer.on_sample(
                Sample(item.key, item.payload, encoding, item.published_ns, item.sequence), item.recorded_ns / 1e9, None
            )

    def _outcome(self, item: Recorded) -> None:
        """What became of a mode that the coordinator asked for then."""
        event, key = message(item), keys.parse(item.key)
        if event is None or key is None or event.kind != "coordinator" or event.verb != "mode":
            return
        if event.phase == "asked":
            try:
                request: Any = messages.parse("fleet.v1.ModeCommand", event.request, event.request_encoding)
            except messages.BadPayload:
                return
            self._busy[key.car] = request.mode
        elif event.phase in _ENDED and (mode := self._busy.pop(key.car, None)) is not None:
            refusal = Refusal(mode, event.reason, event.words, item.recorded_ns / 1e9)
            self._observer.on_outcome(key.car, None if event.phase in _DONE else refusal)

    def _pass(self, to_ns: int) -> None:
        """Time in which nothing came."""
        if to_ns < self.run.start_ns:
            return
        if self._memory is None:
            self._memory = self._begin()
            self._looked_ns = self.run.start_ns - TURN_NS
        while self._looked_ns + TURN_NS <= to_ns:
            self._look(self._looked_ns + TURN_NS)

    def _begin(self) -> PolicyState:
        now = self.run.start_ns / 1e9
        known = {car: role for car, role in self.run.roles.items() if role in self._plan.roles}
        picture = self._observer.snapshot(())
        if not self.run.whole or any(not picture.cars.get(car, UNKNOWN_CAR).mode for car in known):
            # It began, or knew its cars, before the recording: that is where its first roles are from.
            return restore(
                self._plan, picture, PersistedPolicy(self._plan.version, known, self.run.phase, now), now, now
            )
        memory = restore(self._plan, picture, self.kept, now, now)
        # Roles from before the session: its first words tell of them.
        told = {
            car: HeldRole(known[car], TAKEN_OVER)
            for car, said in self.run.said.items()
            if car in known and said[0].role == known[car] and TAKEN_OVER in said[0].why
        }
        return memory if memory.held_roles or not told else PolicyState(held_roles=told)

    def _look(self, at_ns: int) -> None:
        if self._memory is None or at_ns < self._looked_ns:
            return
        self._looked_ns = at_ns
        self._observer.forget(at_ns / 1e9, {*self._plan.named, *self._memory.held_roles})
        result = step(self._plan, self._observer.snapshot(self._busy), self._memory, at_ns / 1e9)
        self._memory = result.memory
        for each in result.changed:
            said = RecordedDecision(
                at_ns, each.kind, each.decided, each.role or "", each.why, each.readings, each.would_change
            )
            add(self.said, each.subject, said)


def _ordered(recorded: Iterable[Recorded]) -> Iterable[Recorded]:
    """By the recorder's clock, which a person may have set back: such a message counts as of the latest time."""
    latest_ns = 0
    for one in recorded:
        if one.recorded_ns < latest_ns:
            yield replace(one, recorded_ns=latest_ns)
        else:
            latest_ns = one.recorded_ns
            yield one


def _time(item: Recorded | PresenceToken | _NewPlan) -> int:
    return item.recorded_ns if isinstance(item, Recorded) else item.at_ns

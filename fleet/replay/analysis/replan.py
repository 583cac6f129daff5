"""Runs the coordinator's policy with a plan on the readings of a session, on the recorded clock. Uses no bus.

Cars behave as recorded, whatever this plan would have commanded. A recording lacks three things that a live coordinator
knows: the liveliness tokens (see recorded_decisions.py), the exact times of the coordinator's steps (here there is a
step after the messages of each 10 ms, and ten times a second), and the order of messages that arrived almost at once.
"""

import contextlib
import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from fleet.coordinator.observer import FleetObserver
from fleet.policy.decide import step
from fleet.policy.plan.plan import Plan
from fleet.policy.plan.plan_parser import parse
from fleet.policy.plan_requests import RequestRefused, on_request
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, Refusal, topic_of
from fleet.policy.state import TAKEN_OVER, HeldRole, PersistedPolicy, PolicyState, carry_over, restore, to_persisted
from fleet.recording.reading.session import Recorded
from fleet.replay.analysis.recorded_decisions import (
    CoordinatorRun,
    PresenceToken,
    RecordedDecision,
    RecordedRequest,
    Timeline,
    add,
    decode_message,
)
from schemas import keys, messages
from schemas.bus import Sample
from schemas.commands import Verb
from schemas.topics import PROTOBUF
from schemas.words import Phase, Rank

STEP_INTERVAL_NS: Final = 100_000_000
MAX_BATCH_NS: Final = 10_000_000
"""Maximum time between messages that one step processes together."""
COORDINATOR_HISTORY_NS: Final = 60_000_000_000
"""A coordinator starts with queries for the latest readings. Here the answers are the readings that were recorded
within this time before its start."""
_FINAL_PHASES: Final = frozenset(Phase) - {Phase.ASKED, Phase.QUEUED}
_SUCCESS_PHASES: Final = frozenset({Phase.SENT, Phase.COMPLETE, Phase.EFFECT_SEEN})


class _NewPlan(Struct, frozen=True):
    at_ns: int
    plan: Plan


def keys_for(fleet: str, plans: Iterable[Plan]) -> list[str]:
    """Return the key expressions that a coordinator with these plans subscribes to, and the one of command outcomes."""
    topics = {topic_of(name) for plan in plans for name in plan.read_names}
    return [f"{fleet}/*/{topic}" for topic in ("state/*", "event/command", *sorted(topics)) if topic]


def plans_of(run: CoordinatorRun) -> list[Plan]:
    """Return the plans of a coordinator in order. Raises BadPlan if this version cannot read one of them."""
    return [parse(text, f"the recorded plan of {run.fleet}") for _, text in run.plans]


@dataclass(slots=True)
class Replanning:
    """Runs one recorded coordinator again from its start to its end. `plans` are pairs (start time, plan)."""

    run: CoordinatorRun
    plans: list[tuple[int, Plan]]
    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    persisted: PersistedPolicy = field(default_factory=PersistedPolicy)
    """State persisted by the previous coordinator."""
    decisions: Timeline = field(default_factory=dict)
    _observer: FleetObserver = field(init=False)
    _plan: Plan = field(init=False)
    _state: PolicyState | None = None
    _busy: dict[str, str] = field(default_factory=dict)
    """Requested mode by car."""
    _stepped_ns: int = 0

    def __post_init__(self) -> None:
        self._observer = FleetObserver(self.listed)
        self._plan = self.plans[0][1]

    def go(self, recorded: Iterable[Recorded], tokens: Iterable[PresenceToken]) -> PersistedPolicy:
        """Process all messages of `keys_for`, in order, and return the state to persist for the next coordinator."""
        changes = [_NewPlan(at_ns, plan) for at_ns, plan in self.plans[1:]]
        new_ns: int | None = None
        items: Iterable[Any] = heapq.merge(_ordered(recorded), tokens, changes, self.run.requests, key=_time)
        for item in items:
            at_ns = _time(item)
            if at_ns > self.run.end_ns:
                break
            if new_ns is not None and at_ns - new_ns > MAX_BATCH_NS:
                self._step(new_ns)
                new_ns = None
            self._advance(at_ns)
            new_ns = at_ns if new_ns is None else new_ns
            match item:
                case PresenceToken():
                    self._observer.on_token(item.car, item.at_ns / 1e9, alive=item.alive)
                case _NewPlan():
                    if self._state is not None:
                        self._state = carry_over(self._state, self._plan, item.plan)
                    self._plan = item.plan
                case RecordedRequest():
                    self._request(item)
                case _:
                    self._take(item)
        self._advance(self.run.end_ns)
        self._step(self.run.end_ns)
        assert self._state is not None
        return to_persisted(self._plan, self._state, self.run.end_ns / 1e9, self.run.end_ns / 1e9)

    def _request(self, item: RecordedRequest) -> None:
        """Carry out a person's request to the recorded plan, unless this plan refuses it."""
        if self._state is not None:
            with contextlib.suppress(RequestRefused):
                self._state, _ = on_request(item.request, self._plan, self._state, item.by, item.at_ns / 1e9)

    def _take(self, item: Recorded) -> None:
        if item.key.endswith("/event/command"):
            self._outcome(item)
        else:
            encoding = f"{PROTOBUF};{item.message}"
            self._observer.on_sample(
                Sample(item.key, item.payload, encoding, item.published_ns, item.sequence), item.recorded_ns / 1e9, None
            )

    def _outcome(self, item: Recorded) -> None:
        """Apply the outcome of a mode command of the recorded coordinator."""
        event, key = decode_message(item), keys.parse(item.key)
        if event is None or key is None or event.kind != Rank.COORDINATOR or event.verb != Verb.MODE:
            return
        if event.phase == Phase.ASKED:
            try:
                request: Any = messages.parse("fleet.v1.ModeCommand", event.request, event.request_encoding)
            except messages.BadPayload:
                return
            self._busy[key.car] = request.mode
        elif event.phase in _FINAL_PHASES and (mode := self._busy.pop(key.car, None)) is not None:
            refusal = Refusal(mode, event.reason, event.words, item.recorded_ns / 1e9)
            self._observer.on_outcome(key.car, mode, None if event.phase in _SUCCESS_PHASES else refusal)

    def _advance(self, to_ns: int) -> None:
        """Advance the clock, with a step at each interval."""
        if to_ns < self.run.start_ns:
            return
        if self._state is None:
            self._state = self._initial_state()
            self._stepped_ns = self.run.start_ns - STEP_INTERVAL_NS
        while self._stepped_ns + STEP_INTERVAL_NS <= to_ns:
            self._step(self._stepped_ns + STEP_INTERVAL_NS)

    def _initial_state(self) -> PolicyState:
        now = self.run.start_ns / 1e9
        known = {car: role for car, role in self.run.roles.items() if role in self._plan.roles}
        snapshot = self._observer.snapshot(())
        if not self.run.whole or any(not snapshot.cars.get(car, UNKNOWN_CAR).mode for car in known):
            # The coordinator started before the recording, or knew more of its cars than the recording has. So let it
            # begin with its first recorded roles.
            return restore(
                self._plan,
                snapshot,
                PersistedPolicy(self._plan.version, known, self.run.phase, now, stopped_by=self.run.stopped_by),
                now,
                now,
            )
        # A coordinator that a person ends forgets that its plan was stopped. A coordinator that is killed remembers it.
        persisted = replace(self.persisted, stopped_by=self.run.stopped_by)
        state = restore(self._plan, snapshot, persisted, now, now)
        # The roles from before the session are named in the first decisions of this coordinator.
        initial = {
            car: HeldRole(known[car], TAKEN_OVER)
            for car, past in self.run.decisions.items()
            if car in known and past[0].role == known[car] and TAKEN_OVER in past[0].why
        }
        return state if state.held_roles or not initial else PolicyState(held_roles=initial)

    def _step(self, at_ns: int) -> None:
        if self._state is None or at_ns < self._stepped_ns:
            return
        self._stepped_ns = at_ns
        self._observer.forget(at_ns / 1e9, {*self._plan.named_cars, *self._state.held_roles})
        result = step(self._plan, self._observer.snapshot(self._busy), self._state, at_ns / 1e9)
        self._state = result.memory
        for each in (*result.changed, *result.reworded):  # as the coordinator publishes them
            decision = RecordedDecision(
                at_ns, each.kind, each.decided, each.role or "", each.why, each.readings, each.would_change
            )
            add(self.decisions, each.subject, decision)


def _ordered(recorded: Iterable[Recorded]) -> Iterable[Recorded]:
    """Yield messages with times that never go back. After a backward step of the clock, use the latest time so far."""
    latest_ns = 0
    for message in recorded:
        if message.recorded_ns < latest_ns:
            yield replace(message, recorded_ns=latest_ns)
        else:
            latest_ns = message.recorded_ns
            yield message


def _time(item: Recorded | PresenceToken | RecordedRequest | _NewPlan) -> int:
    return item.recorded_ns if isinstance(item, Recorded) else item.at_ns

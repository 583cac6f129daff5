"""Follows the phases of a plan: when one ends, and which begins. Pure; times in s."""

from collections.abc import Mapping
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.policy.debounce import HYSTERESIS_S, Debounced
from fleet.policy.plan.plan import Plan, PlanPhase
from fleet.policy.rules_in_force import NO_CARS, CarSets, RuleState, debounce_by_car, readings_used
from fleet.policy.snapshot import FleetSnapshot

PHASE_SETTLE_TIMEOUT_S: Final = 15.0
"""Maximum time to wait for a phase's cars before its timeout starts. The recovery of a car and the opening of a mode
take 4.9 + 3.5 s (docs/reference/protocol.md#stops)."""


class PhaseState(Struct, frozen=True):
    """The current phase. The name is empty if the plan has no phases."""

    name: str = ""
    since: float = 0.0
    until: Mapping[str, Debounced] = field(default_factory=dict)
    why: str = ""
    """The reason why the phase began."""
    used: tuple[str, ...] = ()
    settled: bool = False
    """True once the phase's cars were in their modes, or PHASE_SETTLE_TIMEOUT_S has passed."""
    waited_s: float = 0.0
    """Time until the cars settled. The phase's timeout starts then."""


def follow_phase(
    plan: Plan,
    snapshot: FleetSnapshot,
    cars: CarSets,
    before: PhaseState,
    rules: Mapping[int, RuleState],
    now: float,
    *,
    ready: bool,
) -> PhaseState:
    """Return the phase now. Each phase lasts at least HYSTERESIS_S, so that two phases do not alternate quickly.

    `ready` is True if every car is known and in its mode. The phase's timeout starts then, or after
    PHASE_SETTLE_TIMEOUT_S.
    """
    phase = plan.phases.get(before.name)
    if phase is None:
        return PhaseState(plan.first_phase, now, why="the plan begins with it" if plan.first_phase else "")
    lasted_s = now - before.since
    for index, state in rules.items():
        rule = plan.rules[index]
        for effect in rule.effects:
            # A rule that was already in force when this phase began does not start another phase.
            if effect.phase not in (None, phase.name) and state.on and state.since >= before.since:
                if lasted_s < HYSTERESIS_S:
                    continue
                assert effect.phase is not None
                return PhaseState(effect.phase, now, why=f"{rule.name}: {rule.when.text}", used=state.used)
    if not before.settled and lasted_s > 0:
        settled = ready or lasted_s >= PHASE_SETTLE_TIMEOUT_S
        before = replace(before, settled=settled, waited_s=before.waited_s if settled else lasted_s)
    return _follow_phase_end(phase, snapshot, cars, before, lasted_s, now)


def _follow_phase_end(
    phase: PlanPhase, snapshot: FleetSnapshot, cars: CarSets, before: PhaseState, lasted_s: float, now: float
) -> PhaseState:
    until = NO_CARS if phase.until is None else debounce_by_car(phase.until, snapshot, cars, before.until, now)
    true_for = [car for car, debounced in until.items() if debounced.on]
    if phase.until is not None and phase.next is not None and true_for and lasted_s >= HYSTERESIS_S:
        used = readings_used(phase.until, snapshot, cars, true_for[0] or None, now)
        return PhaseState(phase.next, now, why=f"{phase.name} ends with {phase.until.text}", used=used)
    settled_s = lasted_s - before.waited_s
    if phase.timeout_s is not None and phase.on_timeout is not None and settled_s >= max(phase.timeout_s, HYSTERESIS_S):
        return PhaseState(phase.on_timeout, now, why=f"{phase.name} lasts at most {phase.timeout_s:g} s")
    return replace(before, until=until)

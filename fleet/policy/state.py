"""What the coordinator remembers from one decision to the next, and what of it outlives a change of plan. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from fleet.policy.debounce import HYSTERESIS_S, Debounced, Settled
from fleet.policy.decision import Decision
from fleet.policy.plan.plan import Plan
from fleet.policy.rules import PhaseState, RuleState
from fleet.policy.snapshot import NOBODY, FleetSnapshot
from gateway.protocol.enums import Mode

TAKEN_OVER: Final = "it had it before the coordinator was started again"
"""Why a car has a role that it had before."""
HUB_BACK_S: Final = 5.0
"""So long after a hub was away roles are kept for cars whose gateways are not back at it: they try again every half
second, and may be held up."""
IN_PHASE: Final = "it was so before the coordinator was started again"


@dataclass(frozen=True, slots=True)
class ModeAttempts:
    """How often a car was asked for one mode, and when it may be asked again."""

    mode: str = ""
    attempts: int = 0
    again_at: float = 0.0
    fine_since: float | None = None


@dataclass(frozen=True, slots=True)
class HeldRole:
    """A role that a car has, and how it came by it."""

    role: str
    why: str = ""
    used: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PersistedPolicy:
    """What outlives a coordinator: the roles, the phase, the rules in force and the car that made each so."""

    version: str = ""
    """Of the plan."""
    roles: Mapping[str, str] = field(default_factory=dict)
    phase: str = ""
    phase_since_s: float = 0.0
    """On the wall clock."""
    rules: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LinkColor:
    """A car that was asked for the colour of a rule since that came into force."""

    rule: int
    effect: int
    """Both by position."""
    that: str | None
    car: str | None
    """None: every car, by the coordinator before this one."""


@dataclass(frozen=True, slots=True)
class PolicyState:
    """Everything that the next decision needs besides the picture. Times are seconds on one monotonic clock."""

    began: float | None = None
    """The first decision."""
    phase: PhaseState = field(default_factory=PhaseState)
    rules: Mapping[int, RuleState] = field(default_factory=dict)
    """By position in the plan."""
    held: Mapping[str, HeldRole] = field(default_factory=dict)
    """The role that each car has; it is kept for a moment for one that cannot be asked."""
    gone_since: Mapping[str, float] = field(default_factory=dict)
    needs: Mapping[tuple[str, str], Settled] = field(default_factory=dict)
    tried: Mapping[str, ModeAttempts] = field(default_factory=dict)
    coloured: frozenset["LinkColor"] = frozenset()
    said: Mapping[str, Decision] = field(default_factory=dict)
    """The last decision of each subject."""

    @property
    def roles(self) -> dict[str, str]:
        """The role of each car."""
        return {car: held.role for car, held in self.held.items()}


def hub_back(memory: PolicyState, now: float) -> PolicyState:
    """What counts when there is a hub again: without one nobody could be heard, and nobody was lost for that."""
    return replace(memory, gone_since=dict.fromkeys(memory.held, now + HUB_BACK_S - HYSTERESIS_S))


def carried(memory: PolicyState, before: Plan, after: Plan) -> PolicyState:
    """What still counts under another plan: roles, rules and the phase that it has, too."""
    places = {rule: index for index, rule in enumerate(after.rules)}
    rules = {
        places[before.rules[index]]: state for index, state in memory.rules.items() if before.rules[index] in places
    }
    same = {name for name, role in after.roles.items() if before.roles.get(name) == role}
    return replace(
        memory,
        phase=memory.phase if memory.phase.name in after.phases else PhaseState(),
        rules=rules,
        coloured=frozenset(
            replace(each, rule=places[before.rules[each.rule]])
            for each in memory.coloured
            if before.rules[each.rule] in places
        ),
        held={car: held for car, held in memory.held.items() if held.role in after.roles},
        needs={key: settled for key, settled in memory.needs.items() if key[1] in same},
        said={},
    )


def restarted(memory: PolicyState) -> PolicyState:
    """Return what still counts when the plan begins anew: who has which role, but no phase and no rule in force."""
    return replace(memory, phase=PhaseState(), rules={}, coloured=frozenset())


def restored(plan: Plan, picture: FleetSnapshot, kept: PersistedPolicy, now: float, wall_s: float) -> PolicyState:
    """What a coordinator that begins takes over from the one before, as far as the cars are still as it left them.

    What was kept under another plan counts only for the roles that both have; a car that is in the mode of another
    role has been changed by somebody since.
    """
    modes = {role.mode for role in plan.roles.values()} - {Mode.MANUAL}
    held = {}
    for car, name in kept.roles.items():
        role = plan.roles.get(name)
        mode = picture.cars.get(car, NOBODY).mode
        if role is not None and plan.may(car, role) and (mode == role.mode or mode not in modes):
            held[car] = HeldRole(name, TAKEN_OVER)
    if kept.version != plan.version or (kept.phase and kept.phase not in plan.phases):
        return PolicyState(held=held)
    rules = {
        index: RuleState(on=True, when={that: Debounced(on=True, since=now)}, that=that or None, since=now)
        for index, that in kept.rules.items()
        if index < len(plan.rules)
    }
    age_s = max(0.0, wall_s - kept.phase_since_s)
    phase = PhaseState(kept.phase, now - age_s, why=IN_PHASE) if kept.phase else PhaseState()
    coloured = frozenset(
        LinkColor(index, position, state.that, None)
        for index, state in rules.items()
        for position in range(len(plan.rules[index].effects))
    )
    return PolicyState(held=held, rules=rules, phase=phase, coloured=coloured)


def to_keep(plan: Plan, memory: PolicyState, now: float, wall_s: float) -> PersistedPolicy:
    """What the next coordinator should know."""
    return PersistedPolicy(
        plan.version,
        memory.roles,
        memory.phase.name,
        round(wall_s - (now - memory.phase.since), 1) if memory.phase.name else 0.0,
        {index: state.that or "" for index, state in memory.rules.items() if state.on},
    )

"""The state of the coordinator between decisions, and the part that outlives a change of plan or a restart. Pure."""

from collections.abc import Container, Mapping
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.policy.debounce import Debounced, Settled
from fleet.policy.decision import Decision
from fleet.policy.phases import PhaseState
from fleet.policy.plan.plan import Plan
from fleet.policy.role_allocation import ROLE_KEPT_S
from fleet.policy.rules_in_force import RuleState
from fleet.policy.snapshot import UNKNOWN_CAR, FleetSnapshot
from schemas.backoff import backoff_s
from schemas.colors import Rgb
from schemas.words import Mode, Verdict

TAKEN_OVER: Final = "it had it before the coordinator was started again"
"""Reason for a role that a car had before a restart of the coordinator."""
HUB_RETURN_GRACE_S: Final = 5.0
"""Maximum time to wait for gateways after the hub is back. Their cars keep their roles for this time. Gateways try to
reconnect every 0.5 s."""
MODE_RETRY_MAX_S: Final = 30.0
"""Maximum retry interval of a mode command. The interval doubles from 1 s with each attempt."""
ATTEMPTS_BEFORE_REPLACEMENT: Final = 2
"""Number of failed mode commands after which another car may take over the role."""
FAILED_MODE_KEPT_S: Final = 60.0
"""Time for which a car that has failed to change to a mode is the last choice for a role with this mode."""
IN_PHASE: Final = "it was so before the coordinator was started again"


class ModeAttempts(Struct, frozen=True):
    """The number of commands for one mode of a car, and the time of the next retry."""

    mode: str = ""
    count: int = 0
    again_at: float = 0.0
    fine_since: float | None = None
    """Time since which the car has been in the mode. None if it is not."""

    def after(self, now: float) -> "ModeAttempts":
        """Return the attempts after one more command."""
        return ModeAttempts(self.mode, self.count + 1, now + backoff_s(self.count + 1, 1.0, MODE_RETRY_MAX_S))

    def failed(self, now: float, *, busy: bool) -> int:
        """Return the number of commands that have failed if the car is not in the mode now.

        The last one may still succeed while it has no outcome (`busy`), or was sent only a moment ago.
        """
        return self.count - (busy or now < self.again_at)


def note_failures(
    failed_modes: Mapping[tuple[str, str], float],
    attempts: Mapping[str, ModeAttempts],
    snapshot: FleetSnapshot,
    alone: Container[str],
    now: float,
) -> dict[tuple[str, str], float]:
    """Return the modes that cars have failed to change to, with those that they fail to change to now.

    A failure is remembered also while the car has no role. Otherwise two broken cars would take turns in a role, while
    a third one that works has none. It is forgotten after a while, when the car is in the mode, and when it is left
    `alone`: somebody may have mended it, or its gateway is new.
    """
    found = {
        (car, mode): at
        for (car, mode), at in failed_modes.items()
        if now - at < FAILED_MODE_KEPT_S
        and car not in alone
        and not snapshot.cars.get(car, UNKNOWN_CAR).is_confirmed_in(mode)
    }
    for car, each in attempts.items():
        known = snapshot.cars.get(car, UNKNOWN_CAR)
        is_contradicted = known.verdict == Verdict.CONTRADICTED and car not in alone
        if is_contradicted and each.failed(now, busy=known.busy) >= ATTEMPTS_BEFORE_REPLACEMENT:
            found[car, each.mode] = now
    return found


class HeldRole(Struct, frozen=True):
    """A role that a car has, and how it got that role."""

    role: str
    why: str = ""
    used: tuple[str, ...] = ()


class PersistedPolicy(Struct, frozen=True):
    """The persisted part of the state: roles, phase, and rules in force with the car that triggered each."""

    version: str = ""
    """The plan's version."""
    roles: Mapping[str, str] = field(default_factory=dict)
    phase: str = ""
    phase_since_s: float = 0.0
    """Start of the phase on the wall clock."""
    rules: Mapping[int, str] = field(default_factory=dict)
    """By position in the plan: the car that triggered the rule. Empty if the condition is about all cars."""
    stopped_by: str = ""
    """Sender who stopped the plan. Empty if the plan runs."""
    to_rest: tuple[str, ...] = ()
    """Cars that must still be brought to rest since the plan was stopped."""


class LedRequest(Struct, frozen=True):
    """Notes that a car was commanded to show the color of a rule, after the rule came into force."""

    rule: int
    effect: int
    """Position of the rule in the plan, and of the effect in the rule."""
    trigger: str | None
    car: str | None
    """The car, or None for every car that the coordinator had before its restart."""


class BlinkState(Struct, frozen=True):
    """A blinking LED: its color, whether it is on, and the time of the last change."""

    color: Rgb
    on: bool
    at: float


class PolicyState(Struct, frozen=True):
    """Everything that the next decision needs besides the snapshot. Times are seconds on one monotonic clock."""

    started_at: float | None = None
    """Time of the first step."""
    phase: PhaseState = field(default_factory=PhaseState)
    rules: Mapping[int, RuleState] = field(default_factory=dict)
    """By position in the plan."""
    held_roles: Mapping[str, HeldRole] = field(default_factory=dict)
    """The role of each car. A car that cannot be commanded keeps its role for a moment."""
    gone_since: Mapping[str, float] = field(default_factory=dict)
    """By car: the time since which the plan may not or cannot command it."""
    needs: Mapping[tuple[str, str], Settled] = field(default_factory=dict)
    """By car and role: True if the car meets the role's needs."""
    mode_attempts: Mapping[str, ModeAttempts] = field(default_factory=dict)
    """By car."""
    failed_modes: Mapping[tuple[str, str], float] = field(default_factory=dict)
    """By car and mode: the last time at which the car was not in this mode after two commands. See `note_failures`."""
    led_requests: frozenset[LedRequest] = frozenset()
    blinks: Mapping[str, BlinkState] = field(default_factory=dict)
    """By car."""
    decisions: Mapping[str, Decision] = field(default_factory=dict)
    """The last decision of each subject."""
    stopped_by: str = ""
    """Sender who stopped the plan. Empty if the plan runs. After a stop, only cars in `to_rest` get commands."""
    to_rest: frozenset[str] = frozenset()
    """Cars that the stopped plan has commanded, until they are at rest or a person has taken them."""

    @property
    def roles(self) -> dict[str, str]:
        """The role of each car, by name."""
        return {car: held_roles.role for car, held_roles in self.held_roles.items()}


def on_hub_back(memory: PolicyState, now: float) -> PolicyState:
    """Return the state for the time after a hub is back. No car loses its role by an outage of the hub."""
    return replace(memory, gone_since=dict.fromkeys(memory.held_roles, now + HUB_RETURN_GRACE_S - ROLE_KEPT_S))


def carry_over(memory: PolicyState, before: Plan, after: Plan) -> PolicyState:
    """Return the state under another plan. Roles, rules and the phase remain if both plans have them."""
    places = {rule: index for index, rule in enumerate(after.rules)}
    rules = {
        places[before.rules[index]]: state for index, state in memory.rules.items() if before.rules[index] in places
    }
    same = {name for name, role in after.roles.items() if before.roles.get(name) == role}
    return replace(
        memory,
        stopped_by="",
        to_rest=frozenset(),
        phase=memory.phase if memory.phase.name in after.phases else PhaseState(),
        rules=rules,
        led_requests=frozenset(
            replace(each, rule=places[before.rules[each.rule]])
            for each in memory.led_requests
            if before.rules[each.rule] in places
        ),
        held_roles={car: held_roles for car, held_roles in memory.held_roles.items() if held_roles.role in after.roles},
        needs={key: settled for key, settled in memory.needs.items() if key[1] in same},
        decisions={},
    )


def restore(plan: Plan, snapshot: FleetSnapshot, persisted: PersistedPolicy, now: float, wall_s: float) -> PolicyState:
    """Return the state of a coordinator that starts, from the persisted state of the previous one.

    Under another plan, only roles that both plans have are restored. A car that is in the mode of another role loses
    its role, because somebody has changed its mode since. If the previous plan was stopped, this plan is stopped, too,
    even if it is another one.
    """
    if persisted.stopped_by:
        return PolicyState(stopped_by=persisted.stopped_by, to_rest=frozenset(persisted.to_rest))
    modes = {role.mode for role in plan.roles.values()} - {Mode.MANUAL}
    held_roles = {}
    for car, name in persisted.roles.items():
        role = plan.roles.get(name)
        mode = snapshot.cars.get(car, UNKNOWN_CAR).mode
        if role is not None and plan.may(car, role) and (mode == role.mode or mode not in modes):
            held_roles[car] = HeldRole(name, TAKEN_OVER)
    if persisted.version != plan.version or (persisted.phase and persisted.phase not in plan.phases):
        return PolicyState(held_roles=held_roles)
    rules = {
        index: RuleState(on=True, when={trigger: Debounced(on=True, since=now)}, trigger=trigger or None, since=now)
        for index, trigger in persisted.rules.items()
        if index < len(plan.rules)
    }
    age_s = max(0.0, wall_s - persisted.phase_since_s)
    phase = PhaseState(persisted.phase, now - age_s, why=IN_PHASE) if persisted.phase else PhaseState()
    led_requests = frozenset(
        LedRequest(index, position, state.trigger, None)
        for index, state in rules.items()
        for position in range(len(plan.rules[index].effects))
    )
    return PolicyState(held_roles=held_roles, rules=rules, phase=phase, led_requests=led_requests)


def to_persisted(plan: Plan, memory: PolicyState, now: float, wall_s: float) -> PersistedPolicy:
    """Return the part of the state to persist for the next coordinator."""
    return PersistedPolicy(
        plan.version,
        memory.roles,
        memory.phase.name,
        round(wall_s - (now - memory.phase.since), 1) if memory.phase.name else 0.0,
        {index: state.trigger or "" for index, state in memory.rules.items() if state.on},
        memory.stopped_by,
        tuple(sorted(memory.to_rest)),
    )

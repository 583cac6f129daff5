"""Writes decisions in words: the reason, the readings used, and what would change the decision. Pure.

tests/vectors/decisions.tsv has an example of each kind of decision.
"""

from collections.abc import Iterable, Mapping
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.decision import LEFT_ALONE, Decision, DecisionKind
from fleet.policy.lint.reachability import describe_unmeasured
from fleet.policy.phases import PhaseState
from fleet.policy.plan.plan import ALL_CARS, OTHER_CARS, THIS_CAR, Effect, Plan, PlanCondition, Quantifier, Role, Rule
from fleet.policy.role_allocation import Barrier, Candidates, RoleAllocation
from fleet.policy.rules_in_force import RuleState
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, FleetSnapshot
from fleet.policy.state import HeldRole
from schemas.keys import name_of
from schemas.words import Mode

_GOES_ON: Final = "a person runs `fleet plan restart` or `fleet plan set`"
_MAX_REASONS: Final = 4
"""Maximum roles, rules or cars that a reason lists."""


class Override(Struct, frozen=True):
    """A mode that a rule in force gives a car."""

    rule: Rule
    state: RuleState
    effect: Effect


def explain_phase(plan: Plan, state: PhaseState, snapshot: FleetSnapshot) -> Decision:
    """Explain the phase, and what ends it."""
    phase, ends = plan.phases[state.name], list[str]()
    if phase.until is not None:
        ends.append(f"{phase.until.text}{_unmeasured_part(phase.until, snapshot)}: then {phase.next} begins")
    if phase.timeout_s is not None:
        ends.append(f"its {phase.timeout_s:g} s are over: then {phase.on_timeout} begins")
    ends += [
        f"{rule.name}: {rule.when.text}{_unmeasured_part(rule.when, snapshot)}: then {effect.phase} begins"
        for rule in plan.rules
        for effect in rule.effects
        if effect.phase not in (None, state.name) and (rule.during is None or state.name in rule.during)
    ]
    change = "; or ".join(ends) or "another plan is put in force: nothing else ends it"
    cause = f"{state.name} since {state.since}"
    return Decision("phase", DecisionKind.PHASE, state.name, cause, state.why, state.used, change)


def _unmeasured_part(condition: PlanCondition, snapshot: FleetSnapshot) -> str:
    """Name the readings of a condition that no present car measures. Empty if one of the cars measures them all."""
    cars = [known for car, known in snapshot.cars.items() if known.present and condition.car in (None, car)]
    return describe_unmeasured(condition.expression, [(known, known.mode) for known in cars])


def _about_car(
    car: str,
    kind: DecisionKind,
    cause: str,
    why: str,
    used: tuple[str, ...],
    changes: Iterable[str],
    role: str | None,
    mode: Mode | None,
) -> Decision:
    return Decision(car, kind, mode or LEFT_ALONE, cause, why, used, "; or ".join(changes), car, role, mode)


def _about_role(
    name: str, kind: DecisionKind, decided: str, cause: str, why: str, change: str, used: tuple[str, ...] = ()
) -> Decision:
    return Decision(f"role {name}", kind, decided, cause, why, used, change, role=name)


def explain_alone(car: str, barrier: Barrier, reserved_role: str | None, kept_s: float) -> Decision:
    """Explain a car that is left alone."""
    why = f"{barrier.why}; its role {reserved_role} is kept for {kept_s:g} s" if reserved_role else barrier.why
    return _about_car(car, DecisionKind.ALONE, barrier.why, why, (), [barrier.change], reserved_role, None)


def explain_stopped(car: str, by: str, *, rests: bool) -> Decision:
    """Explain a car of a stopped plan."""
    if rests:
        why, kind, mode = f"{name_of(by)} stopped the plan", DecisionKind.ALONE, None
    else:
        why, kind, mode = f"{name_of(by)} stopped the plan: {car} is brought to rest", DecisionKind.IDLE, Mode.MANUAL
    return _about_car(car, kind, why, why, (), [_GOES_ON], None, mode)


def explain_stopped_role(name: str, by: str) -> Decision:
    """Explain a role of a stopped plan."""
    why = f"{name_of(by)} stopped the plan"
    return _about_role(name, DecisionKind.OUT, "not wanted", f"out: {why}", why, _GOES_ON)


def explain_rule(car: str, override: Override, role: str | None) -> Decision:
    """Explain a mode that a rule gives the car."""
    rule, mode = override.rule, override.effect.mode
    changes = [f"its condition is false for {HYSTERESIS_S:g} s, or unknown for 5 s"]
    if rule.until is not None:
        changes = [rule.until.text]
    if rule.during is not None:
        changes.append(f"phase {' or '.join(sorted(rule.during))} ends")
    changes.append("a person stops or drives it")
    why = f"{rule.name}: {rule.when.text}"
    if override.state.trigger is not None and override.state.trigger != rule.when.car:
        why += f" (true for {override.state.trigger})"
    cause = f"{rule.name} {mode}"
    return _about_car(car, DecisionKind.RULE, cause, why, override.state.used, changes, role, mode)


def is_new(decision: Decision, before: Mapping[str, Decision]) -> bool:
    """Return True if the cause has changed."""
    last = before.get(decision.subject)
    return last is None or last.cause != decision.cause


def is_reworded(decision: Decision, before: Mapping[str, Decision]) -> bool:
    """Return True if the cause is the same as before, but the words have changed."""
    return not is_new(decision, before) and decision is not before[decision.subject]


def explain_role(
    car: str, held_role: HeldRole, candidates: Candidates, allocation: RoleAllocation, phase: str, last: Decision | None
) -> Decision:
    """Explain a mode that a role gives the car.

    `last` is the car's last decision in this phase. If it still applies, it is returned.
    """
    plan, name = candidates.plan, held_role.role
    role = plan.roles[name]
    pinned = candidates.pinned.get(car)
    cause = f"role {name}, {pinned.rule}" if pinned is not None else f"role {name}"
    why = f"role {name} ({_count(role, allocation)})"
    if pinned is not None:
        why += f", as {pinned.rule} wants"
    elif name in allocation.stands_in:
        why += f", which stands in for {allocation.stands_in[name]}"
    if held_role.why:
        why += f": {held_role.why}"
    if last is not None and (last.cause, last.why) == (cause, why):
        return last
    known = candidates.snapshot.cars.get(car, UNKNOWN_CAR)
    changes = []
    if role.needs is not None:
        old = describe_unmeasured(role.needs, [(known, role.mode)], ": the last value counts")
        changes.append(f"{role.needs_text} becomes false{old}")
    changes += [f"{pinned.rule} ends"] if pinned is not None else _rules_against(car, known, role, plan, phase)
    if any(each.roles is not None and name not in each.roles for each in plan.phases.values()):
        changes.append(f"phase {phase} ends")
    changes.append("a person stops or drives it")
    return _about_car(car, DecisionKind.ROLE, cause, why, held_role.used, changes, name, role.mode)


def _rules_against(car: str, known: CarSnapshot, role: Role, plan: Plan, phase: str) -> list[str]:
    """List the rules that could take the car out of this role."""
    rules = []
    for rule in plan.rules:
        effects = [effect for effect in rule.effects if _could_take(effect, rule, car, role, plan)]
        if effects and (rule.during is None or phase in rule.during):
            own = rule.when.car == car or all(effect.who == THIS_CAR for effect in effects)
            unseen = describe_unmeasured(rule.when.expression, [(known, role.mode)]) if own else ""
            rules.append(f"{rule.name}: {rule.when.text}{unseen}")
    return rules[:_MAX_REASONS]


def _could_take(effect: Effect, rule: Rule, car: str, role: Role, plan: Plan) -> bool:
    """Return True if an effect of a rule could take the car out of this role."""
    if effect.role is not None:
        if effect.role == role.name or not plan.may(car, plan.roles[effect.role]):
            return False
    elif effect.mode in (None, role.mode):
        return False
    of = rule.when.car if rule.when.of is Quantifier.CAR else None
    match effect.who:
        case who if who == THIS_CAR:
            return of in (None, car) and rule.when.role in (None, role.name)
        case who if who == OTHER_CARS:
            return of != car
        case who:
            return who in (ALL_CARS, car, role.name)


def explain_idle(car: str, candidates: Candidates, allocation: RoleAllocation) -> Decision:
    """Explain a car without a role."""
    plan = candidates.plan
    whys, changes, kinds, used = list[str](), list[str](), list[str](), list[str]()
    for name, role in plan.roles.items():
        if not plan.may(car, role):
            continue
        if name not in candidates.in_force:
            words, change = "it does not count in this phase", "the next phase begins"
        elif (barrier := candidates.barrier(car, role)) is not None:
            words, change = barrier.why, barrier.change
            used += candidates.readings_of(car, barrier)
        else:
            holders = allocation.holders(name)
            cars = f"it has its {'car' if len(holders) == 1 else 'cars'}: {', '.join(holders)}"
            words = cars if holders else "no place"
            change = f"a place in {name} becomes free"
        kinds.append(f"{name} {words}")
        if len(whys) < _MAX_REASONS:
            whys.append(f"{name}: {words}")
            changes.append(change)
    why = f"no role for it: {'; '.join(whys)}" if whys else "the plan has no role for it now"
    readings, changes = tuple(dict.fromkeys(used)), list(dict.fromkeys(changes)) or ["a rule gives it a mode"]
    return _about_car(car, DecisionKind.IDLE, f"idle: {'; '.join(kinds)}", why, readings, changes, None, plan.idle)


def explain_contradiction(decision: Decision, evidence: str) -> Decision:
    """Explain a car that is not in the mode that it was commanded into."""
    return replace(
        decision,
        cause=f"{decision.cause}, contradicted",
        why=f"{decision.why}; but the car is not in {decision.mode} ({evidence}): it is asked for again",
        would_change="a reading fits that mode",
    )


def _count(role: Role, allocation: RoleAllocation) -> str:
    """Return how many cars have the role, and how many it wants: `1 of 2`."""
    return f"{len(allocation.holders(role.name))} of {'all' if role.count is None else allocation.places[role.name]}"


class _Others(Struct, frozen=True):
    """The cars that do not have a role."""

    kinds: tuple[str, ...]
    """Why each of these cars does not have the role."""
    words: str
    """These reasons with the names of the cars, truncated if there are many cars."""
    changes: str
    """The change that would let each of them have the role, with the cars' names, truncated likewise."""
    used: tuple[str, ...]
    has_able: bool
    """True if one of them could have the role."""


def _list_others(
    name: str, candidates: Candidates, allocation: RoleAllocation, barriers: Mapping[str, Barrier]
) -> _Others:
    role, kinds, whys, changes = candidates.plan.roles[name], list[str](), list[str](), list[str]()
    used, has_able = list[str](), False
    for car in sorted({*candidates.free, *barriers}):
        if allocation.roles.get(car) == name or not candidates.plan.may(car, role):
            continue
        barrier = barriers.get(car) or candidates.barrier(car, role)
        has_able = has_able or barrier is None
        words = barrier.why if barrier is not None else f"it has role {allocation.roles.get(car, 'none')}"
        kinds.append(words)
        if len(whys) < _MAX_REASONS:
            whys.append(words if words.startswith((car, f"the link of {car}")) else f"{car}: {words}")
            used += candidates.readings_of(car, barrier)
            if barrier is not None:
                changes.append(f"{car}: {barrier.change}")
    more = f"; and {len(kinds) - _MAX_REASONS} more" if len(kinds) > _MAX_REASONS else ""
    change = "; or ".join(changes)
    return _Others(tuple(kinds), "; ".join(whys) + more, change, tuple(dict.fromkeys(used)), has_able)


def explain_vacancy(
    name: str, candidates: Candidates, allocation: RoleAllocation, barriers: Mapping[str, Barrier]
) -> Decision:
    """Explain a role with fewer cars than it wants."""
    role, holders = candidates.plan.roles[name], allocation.holders(name)
    decided, others = _count(role, allocation), _list_others(name, candidates, allocation, barriers)
    instead = f"; {role.if_none} gets the place" if role.if_none is not None else ""
    if others.kinds:
        cannot = f"no {'other ' if holders else ''}car can"
        why = f"{'no car is left for it' if others.has_able else cannot}: {others.words}"
        change = "one of them is left for it, or becomes able to take it" if others.has_able else others.changes
    elif {*candidates.free, *barriers} - {*holders}:
        why, change = "the plan gives it to no other car that is there", "a car comes up that may have it"
    else:
        why, change = f"no{' other' if holders else ''} car is there", "another car comes up"
    cause = f"{decided}: {'; '.join(others.kinds)}"
    return _about_role(name, DecisionKind.VACANT, decided, cause, why + instead, change, others.used)


def explain_filled(
    name: str, candidates: Candidates, allocation: RoleAllocation, barriers: Mapping[str, Barrier]
) -> Decision:
    """Explain a role that has all its cars."""
    role, holders = candidates.plan.roles[name], allocation.holders(name)
    why, change, used = f"its places are taken: {', '.join(holders)}", "one of them drops out", tuple[str, ...]()
    if role.count is None:
        others = _list_others(name, candidates, allocation, barriers)
        why = f"{', '.join(holders)} {'have' if len(holders) > 1 else 'has'} it, and "
        if others.kinds:
            why += f"no other car is left for it: {others.words}"
        else:
            more = {*candidates.free, *barriers} - {*holders}
            why += "the plan gives it to no other car that is there" if more else "no other car is there"
        change, used = f"another car is left for it, or {change}", others.used
    return _about_role(name, DecisionKind.FILLED, _count(role, allocation), "filled", why, change, used)


def explain_inactive(name: str, candidates: Candidates, phase: str) -> Decision:
    """Explain a role that no car should have now."""
    if name not in candidates.in_force:
        why, change = f"it does not count in phase {phase}", f"phase {phase} ends"
    else:
        why, change = "no rule gives it to a car now, nor does it stand in for another", "a rule gives it to the car"
    return _about_role(name, DecisionKind.OUT, "not wanted", f"out: {why}", why, change)


def explain_origin(car: str, name: str, candidates: Candidates, before: str | None, lost: str) -> HeldRole:
    """Explain how this car got this role. `before` is the car that lost the role, `lost` is the reason."""
    role = candidates.plan.roles[name]
    used = candidates.snapshot.describe_readings(role.needs, car, candidates.now) if role.needs is not None else ()
    if before is not None:
        return HeldRole(name, f"in place of {before}: {lost}", used)
    if candidates.snapshot.cars.get(car, UNKNOWN_CAR).mode == role.mode:
        return HeldRole(name, f"it is in mode {role.mode} already", used)
    return HeldRole(name, f"it has {role.needs_text}" if role.needs is not None else "", used)

"""The reasons of decisions in words: what decided, with which readings, and what would change it. Pure.

Each kind of decision stands in tests/vectors/decisions.tsv with the words expected of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from fleet.policy.allocation import Barrier, Candidates, RoleAllocation
from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.decision import LEFT_ALONE, Decision, DecisionKind
from fleet.policy.plan.plan import ALL, OTHERS, THAT, Effect, Plan, PlanCondition, Quantifier, Role, Rule
from fleet.policy.plan.reachability import blind
from fleet.policy.rules import PhaseState, RuleState
from fleet.policy.snapshot import NOBODY, CarSnapshot, FleetSnapshot
from fleet.policy.state import HeldRole

_NAMED: Final = 4
"""So many roles or cars are gone into."""


@dataclass(frozen=True, slots=True)
class Override:
    """A mode that a rule in force gives a car."""

    rule: Rule
    state: RuleState
    effect: Effect


def of_phase(plan: Plan, state: PhaseState, picture: FleetSnapshot) -> Decision:
    """The phase, and what ends it."""
    phase, ends = plan.phases[state.name], list[str]()
    if phase.until is not None:
        ends.append(f"{phase.until.text}{_unseen(phase.until, picture)}: then {phase.next}")
    if phase.timeout_s is not None:
        ends.append(f"{phase.timeout_s:g} s of it being over: then {phase.on_timeout}")
    ends += [
        f"{rule.name}: {rule.when.text}{_unseen(rule.when, picture)}: then {effect.phase}"
        for rule in plan.rules
        for effect in rule.effects
        if effect.phase not in (None, state.name) and (rule.during is None or state.name in rule.during)
    ]
    return Decision(
        "phase",
        DecisionKind.PHASE,
        state.name,
        f"{state.name} since {state.since}",
        state.why,
        state.used,
        "; or ".join(ends) or "another plan: nothing ends it",
    )


def _unseen(condition: PlanCondition, picture: FleetSnapshot) -> str:
    """What of a condition no car measures that is there; empty if one can."""
    cars = [known for car, known in picture.cars.items() if known.present and condition.car in (None, car)]
    return blind(condition.expression, [(known, known.mode) for known in cars])


def alone(car: str, barrier: Barrier, kept: str | None, kept_s: float) -> Decision:
    """A car that cannot, or may not, be asked for anything."""
    why = f"{barrier.why}; its role {kept} is kept for {kept_s:g} s" if kept else barrier.why
    return Decision(car, DecisionKind.ALONE, LEFT_ALONE, barrier.why, why, (), barrier.change, car=car, role=kept)


def ruled(car: str, override: Override, role: str | None) -> Decision:
    """A rule gives the car its mode."""
    rule, mode = override.rule, override.effect.mode
    end = (
        rule.until.text
        if rule.until is not None
        else f"that no longer being so for {HYSTERESIS_S:g} s, or not known for 5 s"
    )
    if rule.during is not None:
        end += f"; or the end of phase {' or '.join(sorted(rule.during))}"
    end += "; or a person's stop or drive"
    why = f"{rule.name}: {rule.when.text}"
    if override.state.that is not None and override.state.that != rule.when.car:
        why += f" (it is so of {override.state.that})"
    assert mode is not None
    return Decision(
        car,
        DecisionKind.RULE,
        mode,
        f"{rule.name} {mode}",
        why,
        override.state.used,
        end,
        car=car,
        role=role,
        mode=mode,
    )


def new(decision: Decision, said: Mapping[str, Decision]) -> bool:
    """Whether something else decides than before."""
    before = said.get(decision.subject)
    return before is None or before.cause != decision.cause


def reworded(decision: Decision, said: Mapping[str, Decision]) -> bool:
    """Whether the same decides as before, and there is something else to say of it."""
    return not new(decision, said) and decision is not said[decision.subject]


def in_role(
    car: str, held: HeldRole, staff: Candidates, staffing: RoleAllocation, phase: str, told: Mapping[str, Decision]
) -> Decision:
    """A role gives the car its mode; `told`: what was decided in this phase, which needs no new words."""
    plan, name = staff.plan, held.role
    role = plan.roles[name]
    pinned = staff.pinned.get(car)
    cause = f"role {name}, {pinned[1]}" if pinned is not None else f"role {name}"
    why = f"role {name} ({_count(role, staffing)})"
    if pinned is not None:
        why += f", as {pinned[1]} wants"
    elif name in staffing.stands_in:
        why += f", which stands in for {staffing.stands_in[name]}"
    if held.why:
        why += f": {held.why}"
    before = told.get(car)
    if before is not None and (before.cause, before.why) == (cause, why):
        return before
    known = staff.picture.cars.get(car, NOBODY)
    changes = []
    if role.needs is not None:
        old = blind(role.needs, [(known, role.mode)], ": the last value counts")
        changes.append(f"{role.needs_text} no longer being so{old}")
    changes += [f"the end of {pinned[1]}"] if pinned is not None else _rules_for(car, known, role, plan, phase)
    if any(each.roles is not None and name not in each.roles for each in plan.phases.values()):
        changes.append(f"the end of phase {phase}")
    changes.append("a person's stop or drive")
    return Decision(
        car,
        DecisionKind.ROLE,
        role.mode,
        cause,
        why,
        held.used,
        "; or ".join(changes),
        car=car,
        role=name,
        mode=role.mode,
    )


def _rules_for(car: str, known: CarSnapshot, role: Role, plan: Plan, phase: str) -> list[str]:
    """The rules that could give the car something else than this role."""
    told = []
    for rule in plan.rules:
        could = [effect for effect in rule.effects if _could(effect, rule, car, role, plan)]
        if could and (rule.during is None or phase in rule.during):
            own = rule.when.car == car or all(effect.who == THAT for effect in could)
            unseen = blind(rule.when.expression, [(known, role.mode)]) if own else ""
            told.append(f"{rule.name}: {rule.when.text}{unseen}")
    return told[:_NAMED]


def _could(effect: Effect, rule: Rule, car: str, role: Role, plan: Plan) -> bool:
    if effect.role is not None:
        if effect.role == role.name or not plan.may(car, plan.roles[effect.role]):
            return False
    elif effect.mode in (None, role.mode):
        return False
    of = rule.when.car if rule.when.of is Quantifier.CAR else None
    match effect.who:
        case who if who == THAT:
            return of in (None, car) and rule.when.role in (None, role.name)
        case who if who == OTHERS:
            return of != car
        case who:
            return who in (ALL, car, role.name)


def idle(car: str, staff: Candidates, staffing: RoleAllocation) -> Decision:
    """A car that no role is left for."""
    plan = staff.plan
    whys: list[str] = []
    changes: list[str] = []
    kinds: list[str] = []
    looked: list[Barrier] = []
    for name, role in plan.roles.items():
        if not plan.may(car, role):
            continue
        if name not in staff.in_force:
            words, change = "it does not count in this phase", "the next phase"
        elif (barrier := staff.barrier(car, role)) is not None:
            words, change = barrier.why, barrier.change
            looked.append(barrier)
        else:
            holders = staffing.holders(name)
            words = (
                f"it has its {'car' if len(holders) == 1 else 'cars'}: {', '.join(holders)}" if holders else "no place"
            )
            change = f"a place in {name}"
        kinds.append(f"{name} {words}")
        if len(whys) < _NAMED:
            whys.append(f"{name}: {words}")
            changes.append(change)
    cause = "idle: " + "; ".join(kinds)
    mode = plan.idle
    return Decision(
        car,
        DecisionKind.IDLE,
        mode or LEFT_ALONE,
        cause,
        f"no role for it: {'; '.join(whys)}" if whys else "the plan has no role for it now",
        tuple(dict.fromkeys(told for barrier in looked for told in staff.seen(car, barrier))),
        "; or ".join(dict.fromkeys(changes)) or "a rule",
        car=car,
        mode=mode,
    )


def repaired(decision: Decision, evidence: str) -> Decision:
    """The same, of a car that does not do what it was asked for."""
    return replace(
        decision,
        cause=f"{decision.cause}, contradicted",
        why=f"{decision.why}; but the car is not in {decision.mode} ({evidence}): it is asked for again",
        would_change="a reading with the shape of that mode",
    )


def _count(role: Role, staffing: RoleAllocation) -> str:
    """How many cars have it, of how many that it wants."""
    return f"{len(staffing.holders(role.name))} of {'all' if role.count is None else staffing.places[role.name]}"


@dataclass(frozen=True, slots=True)
class _Others:
    """The cars that have not a role."""

    kinds: tuple[str, ...]
    """Why each has not."""
    told: str
    """The same with their names, cut if they are many."""
    used: tuple[str, ...]
    able: bool
    """Whether one could have it."""


def _others(name: str, staff: Candidates, staffing: RoleAllocation, barriers: Mapping[str, Barrier]) -> _Others:
    role, kinds, whys, used, able = staff.plan.roles[name], list[str](), list[str](), list[str](), False
    for car in sorted({*staff.free, *barriers}):
        if staffing.roles.get(car) == name or not staff.plan.may(car, role):
            continue
        barrier = barriers.get(car) or staff.barrier(car, role)
        able = able or barrier is None
        words = barrier.why if barrier is not None else f"it has role {staffing.roles.get(car, 'none')}"
        kinds.append(words)
        if len(whys) < _NAMED:
            whys.append(words if words.startswith((car, f"the link of {car}")) else f"{car}: {words}")
            used += staff.seen(car, barrier)
    more = f"; and {len(kinds) - _NAMED} more" if len(kinds) > _NAMED else ""
    return _Others(tuple(kinds), "; ".join(whys) + more, tuple(dict.fromkeys(used)), able)


def vacancy(name: str, staff: Candidates, staffing: RoleAllocation, barriers: Mapping[str, Barrier]) -> Decision:
    """A role with fewer cars than it wants."""
    role, holders = staff.plan.roles[name], staffing.holders(name)
    decided, others = _count(role, staffing), _others(name, staff, staffing, barriers)
    instead = f"; {role.fallback} gets the place" if role.fallback is not None else ""
    if others.kinds:
        why = f"{'no car is left for it' if others.able else 'no other car can'}: {others.told}"
        change = "one of them being left for it, or able to" if others.able else "one of them being able to"
    elif {*staff.free, *barriers} - {*holders}:
        why, change = "the plan gives it to no other car that is there", "a car coming up that may have it"
    else:
        why, change = f"no{' other' if holders else ''} car is there", "another car coming up"
    return Decision(
        f"role {name}",
        DecisionKind.VACANT,
        decided,
        f"{decided}: {'; '.join(others.kinds)}",
        f"{why}{instead}",
        others.used,
        change,
        role=name,
    )


def filled(name: str, staff: Candidates, staffing: RoleAllocation, barriers: Mapping[str, Barrier]) -> Decision:
    """A role that has the cars it wants."""
    role, holders = staff.plan.roles[name], staffing.holders(name)
    why, change, used = f"its places are taken: {', '.join(holders)}", "one of them dropping out", tuple[str, ...]()
    if role.count is None:
        others = _others(name, staff, staffing, barriers)
        why = f"{', '.join(holders)} {'have' if len(holders) > 1 else 'has'} it, and "
        if others.kinds:
            why += f"no other car is left for it: {others.told}"
        else:
            more = {*staff.free, *barriers} - {*holders}
            why += "the plan gives it to no other car that is there" if more else "no other car is there"
        change, used = f"another car being left for it, or {change}", others.used
    return Decision(
        f"role {name}", DecisionKind.FILLED, _count(role, staffing), "filled", why, used, would_change=change, role=name
    )


def out(name: str, staff: Candidates, phase: str) -> Decision:
    """A role that no car is to have now."""
    if name not in staff.in_force:
        why, change = f"it does not count in phase {phase}", f"the end of phase {phase}"
    else:
        why, change = "no rule gives it to a car now, nor does it stand in for another", "such a rule coming true"
    return Decision(f"role {name}", DecisionKind.OUT, "not wanted", f"out: {why}", why, would_change=change, role=name)


def came_by(car: str, name: str, staff: Candidates, before: str | None, lost: str) -> HeldRole:
    """Why this car has this role from now on; `before`: who had it and lost it, `lost`: why."""
    role = staff.plan.roles[name]
    used = staff.picture.used(role.needs, car, staff.now) if role.needs is not None else ()
    if before is not None:
        return HeldRole(name, f"in place of {before}: {lost}", used)
    if staff.picture.cars.get(car, NOBODY).mode == role.mode:
        return HeldRole(name, f"it is in mode {role.mode} already", used)
    return HeldRole(name, f"it has {role.needs_text}" if role.needs is not None else "", used)

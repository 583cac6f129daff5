"""One step of the coordinator: what each car should do now, why, and what is asked of it. Pure and deterministic.

A car that is on hold, that someone else drives, or that cannot be reached is left alone, whatever the plan says.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from fleet.policy import explain
from fleet.policy.allocation import Barrier, Candidates, RoleAllocation, fill, follow_needs
from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.decision import Decision, DecisionKind
from fleet.policy.explain import Override
from fleet.policy.plan.plan import Effect, Plan, Rule
from fleet.policy.rules import CarSets, RuleState, follow_phase, follow_rules, targets
from fleet.policy.snapshot import CONTRADICTED, LOST, NOBODY, CarSnapshot, FleetSnapshot
from fleet.policy.state import HUB_BACK_S, HeldRole, LinkColor, ModeAttempts, PolicyState
from gateway.protocol.enums import Mode

LONGEST_WAIT_S: Final = 30.0
"""A mode that does not come about is asked for ever more slowly, at least so often."""
HEARD_WITHIN_S: Final = 1.5
"""So long after the start roles wait for cars that are on the bus and have not said yet how they are."""
IN_VAIN: Final = 2
"""A car that was asked so often and does not do it gives its role to one that can."""
_UNKNOWN: Final = "unknown"


@dataclass(frozen=True, slots=True)
class Ask:
    """A command for one car: a mode, or the colour of its LED."""

    car: str
    mode: Mode | None = None
    led: tuple[int, int, int] | None = None


@dataclass(frozen=True, slots=True)
class DecisionStep:
    """What follows from one picture; `memory` is for the next step."""

    memory: PolicyState
    decisions: tuple[Decision, ...] = ()
    """One for each car of the plan, each role, and the phase."""
    changed: tuple[Decision, ...] = ()
    """Those that are not what they were."""
    reworded: tuple[Decision, ...] = ()
    """Those that are, but whose reasons, or what would change them, are told otherwise now."""
    asks: tuple[Ask, ...] = ()
    roles: Mapping[str, str] = field(default_factory=dict)


def step(plan: Plan, picture: FleetSnapshot, memory: PolicyState, now: float) -> DecisionStep:
    """Decide; the same arguments give the same answer."""
    memory = memory if memory.began is not None else replace(memory, began=now)
    subjects = _subjects(plan, picture)
    found = {car: _barrier(car, picture.cars.get(car, NOBODY)) for car in subjects}
    barriers = {car: barrier[0] for car, barrier in found.items() if barrier is not None}
    gone_since = {car: memory.gone_since.get(car, now) for car in barriers}
    lately = {car for car, since in gone_since.items() if now - since < HYSTERESIS_S}
    has = memory.roles
    reserved = {
        car: has[car]
        for car, barrier in found.items()
        if barrier is not None and not barrier[1] and car in has and car in lately
    }
    free = tuple(car for car in subjects if car not in barriers)
    cars = CarSets(subjects, frozenset(free), frozenset({*free, *lately}), has)
    phase = memory.phase
    if not phase.name:  # it begins before the rules are looked at: some count only in it
        phase = follow_phase(plan, picture, cars, phase, {}, now, ready=False)
    rules = follow_rules(plan, picture, cars, phase.name, memory.rules, now)
    phase = follow_phase(plan, picture, cars, phase, rules, now, ready=_ready(picture, found, memory))
    needs = follow_needs(plan, picture, subjects, memory.needs, now)
    told = memory.said if phase.name == memory.phase.name else {}  # what would change a decision depends on the phase
    memory = replace(memory, rules=rules, phase=phase, needs=needs, gone_since=gone_since)
    assert memory.began is not None
    if now - memory.began < HEARD_WITHIN_S and any(_unheard(picture.cars.get(car, NOBODY)) for car in subjects):
        return DecisionStep(memory)

    roles_in_force = plan.phases[phase.name].roles if phase.name else None
    staff = Candidates(
        plan=plan,
        picture=picture,
        free=free,
        reserved=reserved,
        has=has,
        in_vain=frozenset(car for car, tried in memory.tried.items() if tried.attempts >= IN_VAIN),
        pinned=_pinned(plan, rules, subjects),
        in_force=frozenset(plan.roles) if roles_in_force is None else roles_in_force,
        needs=needs,
        now=now,
    )
    staffing = fill(staff)
    held = _held(staff, staffing, memory.held, barriers)
    overrides = _overrides(plan, picture, rules, subjects, staffing.roles, staff.pinned)
    decisions = [explain.of_phase(plan, phase, picture)] if phase.name else []
    for car in subjects:
        if car in barriers:
            kept_s = HYSTERESIS_S if gone_since[car] <= now else HUB_BACK_S  # the latter by memory.hub_back
            decisions.append(explain.alone(car, barriers[car], reserved.get(car), kept_s))
        elif car in overrides:
            decisions.append(explain.ruled(car, overrides[car], staffing.roles.get(car)))
        elif car in held:
            decisions.append(explain.in_role(car, held[car], staff, staffing, phase.name, told))
        else:
            decisions.append(explain.idle(car, staff, staffing))
    decisions = [_doubted(decision, picture) for decision in decisions]
    decisions += _places(staff, staffing, barriers, phase.name)
    decisions = [each.after(memory.said.get(each.subject), now) for each in decisions]
    tried, asks = _asks(decisions, picture, memory.tried, now)
    coloured, colours = _leds(plan, picture, rules, staff, staffing, memory)
    return DecisionStep(
        replace(
            memory,
            held=held,
            tried=tried,
            coloured=coloured,
            said={each.subject: each for each in decisions},
        ),
        tuple(decisions),
        tuple(each for each in decisions if explain.new(each, memory.said)),
        tuple(each for each in decisions if explain.reworded(each, memory.said)),
        (*asks, *colours),
        staffing.roles,
    )


# ---------------------------------------------------------------------- which cars


def _subjects(plan: Plan, picture: FleetSnapshot) -> tuple[str, ...]:
    """The cars that something is decided of: those that the plan names or, if it is for any, all."""
    return tuple(sorted({*plan.named, *picture.cars})) if plan.open else tuple(sorted(plan.named))


def _unheard(known: CarSnapshot) -> bool:
    return known.present and not known.mode


def _recovers(known: CarSnapshot) -> bool:
    return known.motors == _UNKNOWN and known.verdict != CONTRADICTED


def _ready(picture: FleetSnapshot, found: Mapping[str, tuple[Barrier, bool] | None], memory: PolicyState) -> bool:
    """Return True if every car that could be asked is known and in the mode that was decided last.

    A car that a person has, that is lost or that is not there is not waited for, unless no car is there yet.
    """
    for car, barrier in found.items():
        known = picture.cars.get(car, NOBODY)
        if barrier is not None:
            if _unheard(known) or (not barrier[1] and known.present and known.link != LOST and _recovers(known)):
                return False
            continue
        decision = memory.said.get(car)
        if decision is None or decision.kind is DecisionKind.ALONE:  # it can be asked since this step
            return False
        if decision.mode is not None and (known.mode != decision.mode or known.verdict == CONTRADICTED or known.busy):
            return False
    return any(picture.cars.get(car, NOBODY).present for car in found)


def _barrier(car: str, known: CarSnapshot) -> tuple[Barrier, bool] | None:
    """Why the car is left alone, and whether that is a person's word, for which its role is not kept."""
    if not known.present:
        return Barrier(f"{car} is not on the bus", "its gateway coming up"), False
    if not known.mode:  # so it is not known either whether there is a hold
        return Barrier(f"{car} has not said yet how it is", "its first states"), False
    if known.estopped_by is not None:
        return Barrier(
            f"{car} is e-stopped by {known.estopped_by}", "a person or script ending it (fleet resume --estops)"
        ), True
    if known.held_by is not None:
        return Barrier(f"{car} is on hold by {known.held_by}", "a drive, mode or resume by a person or script"), True
    if known.driven_by is not None:
        return Barrier(f"{car} is driven by {known.driven_by}", "the end of that drive"), False
    if known.link == LOST:
        return Barrier(f"the link of {car} is lost", "its return"), False
    if _recovers(known):
        return Barrier(f"{car} is not in a known state yet", "the end of its recovery: a reading from it"), False
    return None


# ---------------------------------------------------------------------- what rules say


def _effects(plan: Plan, rules: Mapping[int, RuleState]) -> Iterator[tuple[int, Rule, RuleState, Effect]]:
    for index, state in rules.items():
        if state.on:
            rule = plan.rules[index]
            for effect in rule.effects:
                yield index, rule, state, effect


def _pinned(plan: Plan, rules: Mapping[int, RuleState], subjects: tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """The one role that rules in force leave a car, and the rule: of several the first counts."""
    found: dict[str, tuple[str, str]] = {}
    for _, rule, state, effect in _effects(plan, rules):
        if effect.role is not None:
            for car in targets(effect, state, subjects, {}):
                found.setdefault(car, (effect.role, rule.name))
    return found


def _overrides(
    plan: Plan,
    picture: FleetSnapshot,
    rules: Mapping[int, RuleState],
    subjects: tuple[str, ...],
    roles: Mapping[str, str],
    pinned: Mapping[str, tuple[str, str]],
) -> dict[str, Override]:
    """The modes that rules in force give cars, whatever their roles say: of several rules the first counts.

    A rule for several cars passes over those that do not know its mode: they would refuse it for ever.
    """
    found: dict[str, Override] = {}
    said: set[str] = set()
    for _, rule, state, effect in _effects(plan, rules):
        if effect.mode is not None:
            for car in targets(effect, state, subjects, roles):
                if car not in said and not picture.cars.get(car, NOBODY).lacks(effect.mode):
                    said.add(car)
                    found[car] = Override(rule, state, effect)
        elif effect.role is not None:
            said |= {car for car in targets(effect, state, subjects, roles) if pinned[car][1] == rule.name}
    return found


# ---------------------------------------------------------------------- roles


def _held(
    staff: Candidates, staffing: RoleAllocation, before: Mapping[str, HeldRole], barriers: Mapping[str, Barrier]
) -> dict[str, HeldRole]:
    """Who has which role, and how each came by it."""
    lost = {
        name: [car for car, held in before.items() if held.role == name and staffing.roles.get(car) != name]
        for name in staff.plan.roles
    }
    found: dict[str, HeldRole] = {}
    for car, name in sorted(staffing.roles.items()):
        held = before.get(car)
        if held is not None and held.role == name:
            found[car] = held
            continue
        # A role for all that are left has a place for each: nobody has it in place of another.
        gone = lost[name].pop(0) if lost[name] and staff.plan.roles[name].count is not None else None
        words = "" if gone is None else _lost(gone, name, staff, staffing, barriers)
        found[car] = explain.came_by(car, name, staff, gone, words)
    return found


def _lost(car: str, name: str, staff: Candidates, staffing: RoleAllocation, barriers: Mapping[str, Barrier]) -> str:
    """Why this car no longer has this role."""
    role = staff.plan.roles[name]
    barrier = barriers.get(car) or staff.barrier(car, role)
    if barrier is not None:
        return barrier.why
    if car in staff.in_vain and staff.picture.cars.get(car, NOBODY).verdict == CONTRADICTED:
        return f"{car} was asked for mode {role.mode} again and again, and is not in it"
    other = staffing.roles.get(car)
    return f"{car} has role {other} now" if other is not None else f"{car} fits it less"


def _places(staff: Candidates, staffing: RoleAllocation, barriers: Mapping[str, Barrier], phase: str) -> list[Decision]:
    found = []
    for name in staff.plan.roles:
        if not staffing.places.get(name):
            found.append(explain.out(name, staff, phase))
            continue
        least = 1 if staff.plan.roles[name].count is None else staffing.places[name]
        if len(staffing.holders(name)) < min(least, staffing.places[name]):
            found.append(explain.vacancy(name, staff, staffing, barriers))
        else:
            found.append(explain.filled(name, staff, staffing, barriers))
    return found


# ---------------------------------------------------------------------- what is asked


def _doubted(decision: Decision, picture: FleetSnapshot) -> Decision:
    known = picture.cars.get(decision.subject, NOBODY)
    if decision.mode is None or known.mode != decision.mode or known.verdict != CONTRADICTED:
        return decision
    return explain.repaired(decision, known.evidence)


def _asks(
    decisions: Iterable[Decision], picture: FleetSnapshot, before: Mapping[str, ModeAttempts], now: float
) -> tuple[dict[str, ModeAttempts], list[Ask]]:
    """Ask each car that is not as it should be for its mode; again and again, ever more slowly."""
    found: dict[str, ModeAttempts] = {}
    asks = []
    for decision in decisions:
        car, mode = decision.car, decision.mode
        if car is None or mode is None:
            continue  # a car that is left alone: what was tried is over
        known = picture.cars.get(car, NOBODY)
        tried = before.get(car, ModeAttempts(mode))
        if tried.mode != mode:
            tried = ModeAttempts(mode)
        if known.mode == mode and known.verdict != CONTRADICTED:
            fine_since = now if tried.fine_since is None else tried.fine_since
            found[car] = (
                ModeAttempts(mode) if now - fine_since >= LONGEST_WAIT_S else replace(tried, fine_since=fine_since)
            )
            continue
        if decision.kind is DecisionKind.IDLE and known.mode == _UNKNOWN:
            found[car] = tried  # its gateway brings it to rest
        elif known.busy or now < tried.again_at:
            found[car] = replace(tried, fine_since=None)
        else:
            wait_s = min(LONGEST_WAIT_S, 2.0**tried.attempts)
            found[car] = ModeAttempts(mode, tried.attempts + 1, now + wait_s)
            asks.append(Ask(car, mode))
    return found, asks


def _leds(
    plan: Plan,
    picture: FleetSnapshot,
    rules: Mapping[int, RuleState],
    staff: Candidates,
    staffing: RoleAllocation,
    memory: PolicyState,
) -> tuple[frozenset[LinkColor], list[Ask]]:
    """A colour is set once while its rule is in force, as soon as the car is in mode manual: in no other it obeys."""
    subjects = tuple(sorted({*staff.free, *staff.reserved}))
    found, asks = set[LinkColor](), []
    for index, state in rules.items():
        for position, effect in enumerate(plan.rules[index].effects):
            if not state.on or effect.led is None:
                continue
            before = LinkColor(index, position, state.that, None)
            if before in memory.coloured:
                found.add(before)
                continue
            for car in targets(effect, state, subjects, staffing.roles):
                one, known = replace(before, car=car), picture.cars.get(car, NOBODY)
                if one in memory.coloured:
                    found.add(one)
                elif _obeys_a_colour(known) and car in staff.free:
                    found.add(one)
                    asks.append(Ask(car, led=effect.led))
    return frozenset(found), asks


def _obeys_a_colour(known: CarSnapshot) -> bool:
    return known.mode == Mode.MANUAL and known.verdict != CONTRADICTED and not known.busy

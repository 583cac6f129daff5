"""One step of the coordinator: what each car should do now, why, and the commands for it. Pure and deterministic.

A plan says which roles there are and when rules give them to cars. Turning the plan into commands would be a lookup if
cars were always connected, readings always fresh, and nobody else drove. But links break, readings become stale, and
people drive. So most of this module is about *not* acting.

First: whose car is it? The coordinator has the lowest rank. A car is left alone, whatever the plan says, if a person
holds, drives, has paused or borrowed it, if an e-stop is in force, or if it cannot be reached or is not in a known
state. Such a reason is a *barrier* (`barriers`). Each barrier has a sentence for the person who asks why nothing
happens. A car that is out of reach keeps its role for a while, because links come back within seconds. A role that
nobody carries out for a moment is better than a fleet whose roles change at every short loss of a link.

Second: what is true? Rules are evaluated in every step. A rule comes into force when its condition has been true for
the time that the plan wants. It ends when the condition has not been true for a time or, if it has an `until`, when
that is true (`debounce`, `rules_in_force`). A comparison with a value that was not measured is unknown, and unknown
does not count as true: no rule begins because of something that nobody has seen. `rule_effects` has what the rules in
force do.

Third: who gets which role? That is a small assignment problem (`role_allocation`). Filled roles of high priority count
most, then cars that keep their role, then few changes of mode. A car may be replaced if it has twice failed to change
to its mode, and is then the last choice for that mode for a while.

Only then come commands, and only commands that change something. A car that is in its mode is not commanded again. If
it does not change to the mode, the command is retried at growing intervals. Everything that lasts from one step to the
next is in `memory`, and time is an argument. So the same plan, snapshot and memory give the same step in a test, in a
dry run, and in a replay of yesterday's recording that asks what another plan would have done.
"""

from collections.abc import Iterable, Mapping
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.policy.barriers import find_barriers, has_no_state, is_recovering
from fleet.policy.decision import Decision, DecisionKind
from fleet.policy.explain import (
    explain_alone,
    explain_contradiction,
    explain_filled,
    explain_idle,
    explain_inactive,
    explain_origin,
    explain_phase,
    explain_role,
    explain_rule,
    explain_stopped,
    explain_stopped_role,
    explain_vacancy,
    is_new,
    is_reworded,
)
from fleet.policy.phases import follow_phase
from fleet.policy.plan.plan import Plan
from fleet.policy.role_allocation import (
    ROLE_KEPT_S,
    Barrier,
    Candidates,
    RoleAllocation,
    allocate,
    follow_needs,
    reserved_roles,
)
from fleet.policy.rule_effects import effects_in_force, overrides, pinned_roles, targets
from fleet.policy.rules_in_force import CarSets, RuleState, follow_rules
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, FleetSnapshot
from fleet.policy.state import (
    HUB_RETURN_GRACE_S,
    MODE_RETRY_MAX_S,
    BlinkState,
    HeldRole,
    LedRequest,
    ModeAttempts,
    PolicyState,
    note_failures,
)
from schemas.colors import COLORS, Rgb
from schemas.words import UNKNOWN, LinkState, Mode, Verdict

FIRST_STATE_TIMEOUT_S: Final = 1.5
"""Timeout for the first states of the cars on the bus. The first roles wait for these states."""


class CarCommand(Struct, frozen=True):
    """A command for one car: a mode, or the color of its LED."""

    car: str
    mode: Mode | None = None
    led: Rgb | None = None
    blink: bool = False
    """True if the next command comes soon, so that this one may be dropped while the car is still busy."""


class DecisionStep(Struct, frozen=True):
    """The decisions about one snapshot. `memory` is for the next step."""

    memory: PolicyState
    decisions: tuple[Decision, ...] = ()
    """One for each car of the plan, one for each role, and one for the phase if there is one.

    Empty while the first states are awaited.
    """
    changed: tuple[Decision, ...] = ()
    """The decisions with a new cause."""
    reworded: tuple[Decision, ...] = ()
    """The decisions whose cause is the same, but whose words have changed (the reason, or what would change them)."""
    commands: tuple[CarCommand, ...] = ()
    roles: Mapping[str, str] = field(default_factory=dict)


def step(plan: Plan, snapshot: FleetSnapshot, memory: PolicyState, now: float) -> DecisionStep:
    """Decide what each car should do. The same arguments give the same result."""
    started_at = now if memory.started_at is None else memory.started_at
    memory = replace(memory, started_at=started_at)
    subjects = _cars_of(plan, snapshot)
    barriers = find_barriers(subjects, snapshot)
    if memory.stopped_by:
        return _step_stopped(plan, snapshot, subjects, barriers, memory, now)
    gone_since = {car: memory.gone_since.get(car, now) for car in barriers}
    gone_lately = {car for car, since in gone_since.items() if now - since < ROLE_KEPT_S}
    roles_before = memory.roles
    reserved = reserved_roles(roles_before, barriers, gone_lately)
    free = tuple(car for car in subjects if car not in barriers)
    cars = CarSets(subjects, frozenset(free), frozenset({*free, *gone_lately}), roles_before)
    phase = memory.phase
    # The first phase begins before the rules are evaluated, because some rules apply only in this phase.
    if not phase.name:
        phase = follow_phase(plan, snapshot, cars, phase, {}, now, ready=False)
    rules = follow_rules(plan, snapshot, cars, phase.name, memory.rules, now)
    phase = follow_phase(plan, snapshot, cars, phase, rules, now, ready=_is_ready(snapshot, subjects, barriers, memory))
    needs = follow_needs(plan, snapshot, subjects, memory.needs, now)
    # A decision says when it would change. That depends on the phase, so drop the decisions of another phase.
    reusable = memory.decisions if phase.name == memory.phase.name else {}
    failed_modes = note_failures(memory.failed_modes, memory.mode_attempts, snapshot, barriers, now)
    memory = replace(memory, rules=rules, phase=phase, needs=needs, gone_since=gone_since, failed_modes=failed_modes)
    if now - started_at < FIRST_STATE_TIMEOUT_S and any(
        has_no_state(snapshot.cars.get(car, UNKNOWN_CAR)) for car in subjects
    ):
        return DecisionStep(memory)

    roles_in_force = plan.phases[phase.name].roles if phase.name else None
    candidates = Candidates(
        plan=plan,
        snapshot=snapshot,
        free=free,
        reserved=reserved,
        roles_before=roles_before,
        failed_modes=failed_modes,
        pinned=pinned_roles(plan, rules, subjects),
        in_force=frozenset(plan.roles) if roles_in_force is None else roles_in_force,
        needs=needs,
        now=now,
    )
    allocation = allocate(candidates)
    held_roles = _keep_roles(candidates, allocation, memory.held_roles, barriers)
    overriding = overrides(plan, snapshot, rules, subjects, allocation.roles, candidates.pinned)
    decisions = [explain_phase(plan, phase, snapshot)] if phase.name else []
    for car in subjects:
        if car in barriers:
            # After a loss of the hub, `on_hub_back` puts this time into the future, so that cars keep their roles for
            # HUB_RETURN_GRACE_S.
            kept_s = ROLE_KEPT_S if gone_since[car] <= now else HUB_RETURN_GRACE_S
            decisions.append(explain_alone(car, barriers[car], reserved.get(car), kept_s))
        elif car in overriding:
            decisions.append(explain_rule(car, overriding[car], allocation.roles.get(car)))
        elif car in held_roles:
            decisions.append(explain_role(car, held_roles[car], candidates, allocation, phase.name, reusable.get(car)))
        else:
            decisions.append(explain_idle(car, candidates, allocation))
    decisions = [_note_contradiction(decision, snapshot) for decision in decisions]
    decisions += _explain_roles(candidates, allocation, barriers, phase.name)
    decisions = [each.after(memory.decisions.get(each.subject), now) for each in decisions]
    mode_attempts, mode_commands = _command_modes(decisions, snapshot, memory.mode_attempts, now)
    led_requests, led_commands = _command_leds(plan, snapshot, rules, candidates, allocation, memory)
    blinks, blink_commands = _command_blinks(plan, snapshot, rules, candidates, allocation, memory.blinks)
    memory = replace(
        memory, held_roles=held_roles, mode_attempts=mode_attempts, led_requests=led_requests, blinks=blinks
    )
    return _conclude(memory, decisions, (*mode_commands, *blink_commands, *led_commands), allocation.roles)


def _step_stopped(
    plan: Plan,
    snapshot: FleetSnapshot,
    subjects: tuple[str, ...],
    barriers: Mapping[str, Barrier],
    memory: PolicyState,
    now: float,
) -> DecisionStep:
    """Bring the cars of a stopped plan to rest, without a hold, and leave all other cars alone."""
    mode_attempts, commands, decisions = dict[str, ModeAttempts](), list[CarCommand](), list[Decision]()
    for car in subjects:
        known, barrier = snapshot.cars.get(car, UNKNOWN_CAR), barriers.get(car)
        attempts = memory.mode_attempts.get(car, ModeAttempts(Mode.MANUAL))
        must_rest = car in memory.to_rest and _must_rest(known, attempts, barrier)
        if must_rest:
            if barrier is None and not known.busy and now >= attempts.again_at:
                attempts = replace(attempts, mode=Mode.MANUAL).after(now)
                commands.append(CarCommand(car, Mode.MANUAL))
            mode_attempts[car] = attempts
        if barrier is not None:
            decisions.append(explain_alone(car, barrier, None, 0.0))
        else:
            decisions.append(explain_stopped(car, memory.stopped_by, rests=not must_rest))
    decisions += [explain_stopped_role(name, memory.stopped_by) for name in plan.roles]
    decisions = [each.after(memory.decisions.get(each.subject), now) for each in decisions]
    missing = memory.to_rest - set(subjects)  # they come to rest when they are back
    to_rest = frozenset(mode_attempts) | missing
    return _conclude(replace(memory, mode_attempts=mode_attempts, to_rest=to_rest), decisions, commands, {})


def _must_rest(known: CarSnapshot, attempts: ModeAttempts, barrier: Barrier | None) -> bool:
    """Return True if a car of a stopped plan must still be brought to rest. False if a person has taken it."""
    if known.taken_by is not None or known.driven_by is not None:
        return False
    # A mode command may have been on its way when the plan was stopped. Only the outcome of a later command shows that
    # the earlier one is over.
    was_obeyed = attempts.count > 0 and not known.busy and known.refused is None
    is_at_rest = known.is_in_mode(Mode.MANUAL)
    cannot_be_commanded = barrier is not None  # so nothing shows yet that it is at rest
    return cannot_be_commanded or not (was_obeyed and is_at_rest)


def _conclude(
    memory: PolicyState, decisions: Iterable[Decision], commands: Iterable[CarCommand], roles: Mapping[str, str]
) -> DecisionStep:
    """Return the step with these decisions. `memory` still has the decisions of the step before."""
    before, decided = memory.decisions, tuple(decisions)
    return DecisionStep(
        memory=replace(memory, decisions={each.subject: each for each in decided}),
        decisions=decided,
        changed=tuple(each for each in decided if is_new(each, before)),
        reworded=tuple(each for each in decided if is_reworded(each, before)),
        commands=tuple(commands),
        roles=roles,
    )


# ---------------------------------------------------------------------- cars


def _cars_of(plan: Plan, snapshot: FleetSnapshot) -> tuple[str, ...]:
    """Return the cars to decide about: the cars that the plan names, and all others if the plan is open to any car."""
    return tuple(sorted({*plan.named_cars, *snapshot.cars})) if plan.is_open else tuple(sorted(plan.named_cars))


def _is_ready(
    snapshot: FleetSnapshot, subjects: tuple[str, ...], barriers: Mapping[str, Barrier], memory: PolicyState
) -> bool:
    """Return True if the state of every car is known, and every car is in the mode that was decided for it last.

    Cars that are lost, doubted, absent or taken by a person count as ready, unless no car is present yet.
    """
    cars = {car: snapshot.cars.get(car, UNKNOWN_CAR) for car in subjects}
    return any(known.present for known in cars.values()) and all(
        _is_in_decided_mode(known, memory.decisions.get(car))
        if car not in barriers
        else not _may_be_free_soon(known, barriers[car])
        for car, known in cars.items()
    )


def _may_be_free_soon(known: CarSnapshot, barrier: Barrier) -> bool:
    """Return True if this barrier should end by itself: the first state or the first reading of the car is missing."""
    if has_no_state(known):
        return True
    is_reachable = known.present and known.link != LinkState.LOST and not known.doubted
    return is_reachable and not barrier.ends_role and is_recovering(known)


def _is_in_decided_mode(known: CarSnapshot, last: Decision | None) -> bool:
    """Return True if a car is in the mode that was last decided for it, or needs none. False if it was left alone."""
    if last is None or last.kind is DecisionKind.ALONE:  # until this step, the plan could not command this car
        return False
    return last.mode is None or (known.is_in_mode(last.mode) and not known.busy)


# ---------------------------------------------------------------------- roles


def _keep_roles(
    candidates: Candidates, allocation: RoleAllocation, before: Mapping[str, HeldRole], barriers: Mapping[str, Barrier]
) -> dict[str, HeldRole]:
    """Return the role of each car, and how it got that role."""
    lost = {
        name: [car for car, last in before.items() if last.role == name and allocation.roles.get(car) != name]
        for name in candidates.plan.roles
    }
    result: dict[str, HeldRole] = {}
    for car, name in sorted(allocation.roles.items()):
        last = before.get(car)
        if last is not None and last.role == name:
            result[car] = last
            continue
        # A role for all cars has a place for each, so no car replaces another.
        predecessor = lost[name].pop(0) if lost[name] and candidates.plan.roles[name].count is not None else None
        words = "" if predecessor is None else _explain_loss(predecessor, name, candidates, allocation, barriers)
        result[car] = explain_origin(car, name, candidates, predecessor, words)
    return result


def _explain_loss(
    car: str, name: str, candidates: Candidates, allocation: RoleAllocation, barriers: Mapping[str, Barrier]
) -> str:
    """Return why this car lost this role."""
    role = candidates.plan.roles[name]
    barrier = barriers.get(car) or candidates.barrier(car, role)
    if barrier is not None:
        return barrier.why
    if candidates.has_failed(car, role):
        return f"{car} was asked for mode {role.mode} again and again, and is not in it"
    other = allocation.roles.get(car)
    return f"{car} has role {other} now" if other is not None else f"{car} fits it less"


def _explain_roles(
    candidates: Candidates, allocation: RoleAllocation, barriers: Mapping[str, Barrier], phase: str
) -> list[Decision]:
    """Explain each role of the plan: whether it is filled, vacant, or not wanted in this phase."""
    result = []
    for name in candidates.plan.roles:
        role, places = candidates.plan.roles[name], allocation.places.get(name, 0)
        # A role for all cars has no place while every car is left alone, but it still wants at least one car.
        wants_all = role.count is None and not role.by_rules and name in candidates.in_force
        if not places and not wants_all:
            result.append(explain_inactive(name, candidates, phase))
            continue
        least = 1 if role.count is None else places
        if len(allocation.holders(name)) < least:
            result.append(explain_vacancy(name, candidates, allocation, barriers))
        else:
            result.append(explain_filled(name, candidates, allocation, barriers))
    return result


# ---------------------------------------------------------------------- commands


def _note_contradiction(decision: Decision, snapshot: FleetSnapshot) -> Decision:
    known = snapshot.cars.get(decision.subject, UNKNOWN_CAR)
    if decision.mode is None or known.mode != decision.mode or known.verdict != Verdict.CONTRADICTED:
        return decision
    return explain_contradiction(decision, known.evidence)


def _command_modes(
    decisions: Iterable[Decision], snapshot: FleetSnapshot, before: Mapping[str, ModeAttempts], now: float
) -> tuple[dict[str, ModeAttempts], list[CarCommand]]:
    """Command each car that is in the wrong mode into the right one, with backoff."""
    result: dict[str, ModeAttempts] = {}
    commands = []
    for decision in decisions:
        car, mode = decision.car, decision.mode
        if car is None or mode is None:
            continue  # it is about a role or the phase, or the car is left alone, so that its attempts end
        known = snapshot.cars.get(car, UNKNOWN_CAR)
        attempts = before.get(car, ModeAttempts(mode))
        if attempts.mode != mode:
            attempts = ModeAttempts(mode)
        if known.is_in_mode(mode):
            # Forget failures only after the mode has lasted. Otherwise a car that leaves its mode again and again would
            # be commanded without a delay each time, and would never be replaced.
            fine_since = now if attempts.fine_since is None else attempts.fine_since
            result[car] = (
                ModeAttempts(mode) if now - fine_since >= MODE_RETRY_MAX_S else replace(attempts, fine_since=fine_since)
            )
            continue
        if decision.kind is DecisionKind.IDLE and known.mode == UNKNOWN:
            result[car] = attempts  # its gateway is bringing it to rest
        elif known.busy or now < attempts.again_at:
            result[car] = replace(attempts, fine_since=None)
        else:
            result[car] = attempts.after(now)
            commands.append(CarCommand(car, mode))
    return result, commands


def _command_leds(
    plan: Plan,
    snapshot: FleetSnapshot,
    rules: Mapping[int, RuleState],
    candidates: Candidates,
    allocation: RoleAllocation,
    memory: PolicyState,
) -> tuple[frozenset[LedRequest], list[CarCommand]]:
    """Set each color of a rule once, as soon as the car is in mode manual. Cars ignore colors in other modes."""
    subjects = tuple(sorted({*candidates.free, *candidates.reserved}))
    result, commands = set[LedRequest](), []
    for index, state in rules.items():
        for position, effect in enumerate(plan.rules[index].effects):
            if not state.on or effect.led is None or effect.blink_s is not None:
                continue
            of_any_car = LedRequest(index, position, state.trigger, None)
            if of_any_car in memory.led_requests:  # it was set before the coordinator restarted
                result.add(of_any_car)
                continue
            for car in targets(effect, state, subjects, allocation.roles):
                request = replace(of_any_car, car=car)
                if request in memory.led_requests:
                    result.add(request)
                elif car in candidates.free and _obeys_led(snapshot.cars.get(car, UNKNOWN_CAR)):
                    result.add(request)
                    commands.append(CarCommand(car, led=effect.led))
    return frozenset(result), commands


def _command_blinks(
    plan: Plan,
    snapshot: FleetSnapshot,
    rules: Mapping[int, RuleState],
    candidates: Candidates,
    allocation: RoleAllocation,
    before: Mapping[str, BlinkState],
) -> tuple[dict[str, BlinkState], list[CarCommand]]:
    """Switch each blinking LED when its time is over. Switch it off when it no longer blinks, if the car obeys then."""
    subjects = tuple(sorted({*candidates.free, *candidates.reserved}))
    now, result, commands = candidates.now, dict[str, BlinkState](), list[CarCommand]()
    for _, _, state, effect in effects_in_force(plan, rules):
        if effect.led is None or effect.blink_s is None:
            continue
        for car in targets(effect, state, subjects, allocation.roles):
            if car in result or car not in candidates.free or not _obeys_led(snapshot.cars.get(car, UNKNOWN_CAR)):
                continue  # an earlier rule has set its LED, or it obeys no color now
            last = before.get(car)
            if last is not None and last.color == effect.led and now - last.at < effect.blink_s:
                result[car] = last
                continue
            result[car] = BlinkState(effect.led, last is None or last.color != effect.led or not last.on, now)
            commands.append(CarCommand(car, led=effect.led if result[car].on else COLORS["off"], blink=True))
    ended = [car for car, last in before.items() if last.on and car not in result and car in candidates.free]
    commands += [CarCommand(car, led=COLORS["off"]) for car in ended if _obeys_led(snapshot.cars.get(car, UNKNOWN_CAR))]
    return result, commands


def _obeys_led(known: CarSnapshot) -> bool:
    return known.is_in_mode(Mode.MANUAL) and not known.busy and not known.lacks_led

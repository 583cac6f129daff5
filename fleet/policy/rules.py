"""Which rules are in force, which car made each so, and which phase it is. Pure; times in s."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from fleet.policy.debounce import HYSTERESIS_S, Debounced, follow
from fleet.policy.plan.plan import ALL, OTHERS, THAT, Effect, Plan, PlanCondition, PlanPhase, Quantifier, Rule
from fleet.policy.snapshot import FleetSnapshot

SETTLES_WITHIN_S: Final = 15.0
"""Maximum wait for a phase's cars before its time-out counts. Recovery and opening take 4.9 + 3.5 s
(docs/reference/protocol.md#stops and docs/reference/protocol.md#blocking-times)."""
_WHOLE: Final = ""
"""Under this name stands a condition over all cars."""
_NONE: Final[Mapping[str, Debounced]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class RuleState:
    """How far one rule is."""

    on: bool = False
    when: Mapping[str, Debounced] = field(default_factory=dict)
    """By car: since when its condition is so of it."""
    until: Mapping[str, Debounced] = field(default_factory=dict)
    that: str | None = None
    """The car that made it true."""
    since: float = 0.0
    used: tuple[str, ...] = ()
    """The readings that did, as they were."""


@dataclass(frozen=True, slots=True)
class PhaseState:
    """Which phase it is; empty: the plan has none."""

    name: str = ""
    since: float = 0.0
    until: Mapping[str, Debounced] = field(default_factory=dict)
    why: str = ""
    """What began it."""
    used: tuple[str, ...] = ()
    settled: bool = False
    """Its cars were in their modes once, or were waited for long enough."""
    waited_s: float = 0.0
    """How long they took; its time-out counts from then."""


@dataclass(frozen=True, slots=True)
class CarSets:
    """Which cars a rule may speak of."""

    subjects: tuple[str, ...]
    free: Collection[str]
    """Those that may be asked for something now."""
    there: Collection[str]
    """Those that were free a moment ago, too."""
    roles: Mapping[str, str] = field(default_factory=dict)


def follow_rules(
    plan: Plan, picture: FleetSnapshot, cars: CarSets, phase: str, before: Mapping[int, RuleState], now: float
) -> dict[int, RuleState]:
    """How far each rule is now; one that is not left out is in force or about to be."""
    found = {}
    for index, rule in enumerate(plan.rules):
        if rule.during is not None and phase not in rule.during:
            continue
        state = _follow_rule(rule, picture, cars, before.get(index, RuleState()), now)
        if state.on or state.when:
            found[index] = state
    return found


def _follow_rule(rule: Rule, picture: FleetSnapshot, cars: CarSets, before: RuleState, now: float) -> RuleState:
    when = _follow(rule.when, picture, cars, before.when, now)
    true = [car for car, steady in when.items() if steady.on]
    until = _NONE if rule.until is None else _follow(rule.until, picture, cars, before.until, now)
    ended = any(steady.on for steady in until.values())
    that = before.that if before.that in cars.there and (rule.until is not None or before.that in true) else None
    if before.on and rule.until is not None:
        on = not ended and (that is not None or before.that is None or bool(true))
    else:
        on = bool(true) and not ended
    if not on:
        return RuleState(when=when, until=until)
    if that is None and rule.when.of is not Quantifier.ALL:
        that = min(true, key=lambda car: (car not in cars.free, when[car].since, car), default=None)
    if before.on and that == before.that:
        return replace(before, when=when, until=until)
    used = _used(rule.when, picture, cars, that, now)
    return RuleState(on=True, when=when, until=until, that=that, since=now, used=used)


def _follow(
    condition: PlanCondition, picture: FleetSnapshot, cars: CarSets, before: Mapping[str, Debounced], now: float
) -> Mapping[str, Debounced]:
    if condition.of is Quantifier.ALL:
        so = _of_all([picture.holds(condition.expression, car, now) for car in _watched(condition, cars, before)])
        steady = follow(before.get(_WHOLE), so, condition.for_s, now)
        return _NONE if steady is None else {_WHOLE: steady}
    found = {}
    for car in _watched(condition, cars, before):
        steady = follow(before.get(car), picture.holds(condition.expression, car, now), condition.for_s, now)
        if steady is not None:
            found[car] = steady
    return found


def _watched(condition: PlanCondition, cars: CarSets, before: Mapping[str, Debounced]) -> list[str]:
    """The cars it speaks of; who made it true stays among them, whatever role that gave it."""
    if condition.car is not None:
        return [condition.car]
    role = condition.role
    return [
        car
        for car in cars.subjects
        if (role is None and (condition.of is Quantifier.ANY or car in cars.there))
        or (role is not None and cars.roles.get(car) == role)
        or (car in before and before[car].on)
    ]


def _of_all(each: list[bool | None]) -> bool | None:
    """Of no car nothing is known."""
    if not each:
        return None
    return False if False in each else None if None in each else True


def _used(
    condition: PlanCondition, picture: FleetSnapshot, cars: CarSets, that: str | None, now: float
) -> tuple[str, ...]:
    of = [that] if that is not None else _watched(condition, cars, _NONE)
    return tuple(told for car in of for told in picture.used(condition.expression, car, now))


def targets(effect: Effect, state: RuleState, subjects: Collection[str], roles: Mapping[str, str]) -> Iterator[str]:
    """The cars that an effect of a rule in force speaks of; `roles`: who has which."""
    match effect.who:
        case "":
            return
        case who if who == THAT:
            if state.that is not None:
                yield state.that
        case who if who == OTHERS:
            yield from (car for car in subjects if car != state.that)
        case who if who == ALL:
            yield from subjects
        case who if who in subjects:
            yield who
        case who:
            yield from (car for car in subjects if roles.get(car) == who)


def follow_phase(
    plan: Plan,
    picture: FleetSnapshot,
    cars: CarSets,
    before: PhaseState,
    rules: Mapping[int, RuleState],
    now: float,
    *,
    ready: bool,
) -> PhaseState:
    """The phase now; none is shorter than HYSTERESIS_S, so that two do not alternate.

    `ready`: every car is known and in its mode. The phase's time-out does not count before.
    """
    phase = plan.phases.get(before.name)
    if phase is None:
        return PhaseState(plan.first, now, why="the plan begins with it" if plan.first else "")
    lasted_s = now - before.since
    for index, state in rules.items():
        rule = plan.rules[index]
        for effect in rule.effects:
            # A rule that was in force before this phase began has had its say.
            if effect.phase not in (None, phase.name) and state.on and state.since >= before.since:
                if lasted_s < HYSTERESIS_S:
                    continue
                assert effect.phase is not None
                return PhaseState(effect.phase, now, why=f"{rule.name}: {rule.when.text}", used=state.used)
    if not before.settled and lasted_s > 0:
        settled = ready or lasted_s >= SETTLES_WITHIN_S
        before = replace(before, settled=settled, waited_s=before.waited_s if settled else lasted_s)
    return _by_itself(phase, picture, cars, before, lasted_s, now)


def _by_itself(
    phase: PlanPhase, picture: FleetSnapshot, cars: CarSets, before: PhaseState, lasted_s: float, now: float
) -> PhaseState:
    until = _NONE if phase.until is None else _follow(phase.until, picture, cars, before.until, now)
    true = [car for car, steady in until.items() if steady.on]
    if phase.until is not None and phase.next is not None and true and lasted_s >= HYSTERESIS_S:
        used = _used(phase.until, picture, cars, true[0] or None, now)
        return PhaseState(phase.next, now, why=f"{phase.name} ends with {phase.until.text}", used=used)
    timed_s = lasted_s - before.waited_s
    if phase.timeout_s is not None and phase.on_timeout is not None and timed_s >= max(phase.timeout_s, HYSTERESIS_S):
        return PhaseState(phase.on_timeout, now, why=f"{phase.name} lasts at most {phase.timeout_s:g} s")
    return replace(before, until=until)

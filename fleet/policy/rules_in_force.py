"""Follows the rules of a plan: which are in force, and the car that triggered each. Pure; times in s."""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.policy.debounce import Debounced, debounce
from fleet.policy.plan.plan import (
    Plan,
    PlanCondition,
    Quantifier,
    Rule,
)
from fleet.policy.snapshot import FleetSnapshot

_ALL_CARS: Final = ""
"""Used in place of a car's name if the condition is about all cars."""
NO_CARS: Final[Mapping[str, Debounced]] = MappingProxyType({})


class RuleState(Struct, frozen=True):
    """The state of one rule."""

    on: bool = False
    when: Mapping[str, Debounced] = field(default_factory=dict)
    """The debounced condition by car."""
    until: Mapping[str, Debounced] = field(default_factory=dict)
    trigger: str | None = None
    """The car that triggered the rule."""
    since: float = 0.0
    used: tuple[str, ...] = ()
    """The readings that triggered the rule, with their values at that time."""


class CarSets(Struct, frozen=True):
    """Sets of cars to which a rule may apply."""

    subjects: tuple[str, ...]
    """All cars that the plan decides about."""
    free: Collection[str]
    """The cars that can be commanded now."""
    present: Collection[str]
    """The free cars and those that were free a moment ago."""
    roles: Mapping[str, str] = field(default_factory=dict)


def follow_rules(
    plan: Plan, snapshot: FleetSnapshot, cars: CarSets, phase: str, before: Mapping[int, RuleState], now: float
) -> dict[int, RuleState]:
    """Return the new state of each rule that is in force or about to be."""
    result = {}
    for index, rule in enumerate(plan.rules):
        if rule.during is not None and phase not in rule.during:
            continue
        state = _follow_rule(rule, snapshot, cars, before.get(index, RuleState()), now)
        if state.on or state.when:
            result[index] = state
    return result


def _follow_rule(rule: Rule, snapshot: FleetSnapshot, cars: CarSets, before: RuleState, now: float) -> RuleState:
    """Return the new state of one rule.

    Without `until`, the rule is in force while its condition is true. With `until`, it stays in force until that
    condition is true, as long as the car that triggered the rule is present. If that car is gone, another car for which
    the rule's condition is true takes its place. If there is none, the rule ends.
    """
    when = debounce_by_car(rule.when, snapshot, cars, before.when, now)
    true_for = [car for car, debounced in when.items() if debounced.on]
    until = NO_CARS if rule.until is None else debounce_by_car(rule.until, snapshot, cars, before.until, now)
    ended = any(debounced.on for debounced in until.values())
    trigger = (
        before.trigger
        if before.trigger in cars.present and (rule.until is not None or before.trigger in true_for)
        else None
    )
    if before.on and rule.until is not None:
        on = not ended and (trigger is not None or before.trigger is None or bool(true_for))
    else:
        on = bool(true_for) and not ended
    if not on:
        return RuleState(when=when, until=until)
    if trigger is None and rule.when.of is not Quantifier.ALL:
        trigger = min(true_for, key=lambda car: (car not in cars.free, when[car].since, car), default=None)
    if before.on and trigger == before.trigger:
        return replace(before, when=when, until=until)
    used = readings_used(rule.when, snapshot, cars, trigger, now)
    return RuleState(on=True, when=when, until=until, trigger=trigger, since=now, used=used)


def debounce_by_car(
    condition: PlanCondition, snapshot: FleetSnapshot, cars: CarSets, before: Mapping[str, Debounced], now: float
) -> Mapping[str, Debounced]:
    """Return the debounced condition for each car, or under the name _ALL_CARS if it is about all cars."""
    if condition.of is Quantifier.ALL:
        value = _all_of(
            [snapshot.holds(condition.expression, car, now) for car in _watched_cars(condition, cars, before)]
        )
        debounced = debounce(before.get(_ALL_CARS), value, condition.for_s, now)
        return NO_CARS if debounced is None else {_ALL_CARS: debounced}
    result = {}
    for car in _watched_cars(condition, cars, before):
        debounced = debounce(before.get(car), snapshot.holds(condition.expression, car, now), condition.for_s, now)
        if debounced is not None:
            result[car] = debounced
    return result


def _watched_cars(condition: PlanCondition, cars: CarSets, before: Mapping[str, Debounced]) -> list[str]:
    """Return the cars that the condition is about.

    A car that made the condition true stays among them, even if the rule gave the car a new role.
    """
    if condition.car is not None:
        return [condition.car]
    role = condition.role
    return [
        car
        for car in cars.subjects
        if (role is None and (condition.of is Quantifier.ANY or car in cars.present))
        or (role is not None and cars.roles.get(car) == role)
        or (car in before and before[car].on)
    ]


def _all_of(each: list[bool | None]) -> bool | None:
    """Return whether all values are true (Kleene's logic). None if there are no values."""
    if not each:
        return None
    return False if False in each else None if None in each else True


def readings_used(
    condition: PlanCondition, snapshot: FleetSnapshot, cars: CarSets, trigger: str | None, now: float
) -> tuple[str, ...]:
    """Return the readings that made a condition true, with their values: of the car that triggered it, or of all."""
    read = [trigger] if trigger is not None else _watched_cars(condition, cars, NO_CARS)
    return tuple(reading for car in read for reading in snapshot.describe_readings(condition.expression, car, now))

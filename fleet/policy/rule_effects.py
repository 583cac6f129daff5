"""The effects of the rules in force (`rules_in_force`): the roles and modes that they give to cars. Pure."""

from collections.abc import Collection, Iterator, Mapping

from fleet.policy.explain import Override
from fleet.policy.plan.plan import ALL_CARS, OTHER_CARS, THIS_CAR, Effect, Plan, Rule
from fleet.policy.role_allocation import PinnedRole
from fleet.policy.rules_in_force import RuleState
from fleet.policy.snapshot import UNKNOWN_CAR, FleetSnapshot


def targets(effect: Effect, state: RuleState, subjects: Collection[str], roles: Mapping[str, str]) -> Iterator[str]:
    """Yield the cars to which an effect of a rule in force applies. `roles` has the role of each car."""
    match effect.who:
        case "":
            return
        case who if who == THIS_CAR:
            if state.trigger is not None:
                yield state.trigger
        case who if who == OTHER_CARS:
            yield from (car for car in subjects if car != state.trigger)
        case who if who == ALL_CARS:
            yield from subjects
        case who if who in subjects:
            yield who
        case who:
            yield from (car for car in subjects if roles.get(car) == who)


def effects_in_force(plan: Plan, rules: Mapping[int, RuleState]) -> Iterator[tuple[int, Rule, RuleState, Effect]]:
    """Yield each effect of the rules in force, with its rule, and the index and state of this rule."""
    for index, state in rules.items():
        if state.on:
            rule = plan.rules[index]
            for effect in rule.effects:
                yield index, rule, state, effect


def pinned_roles(plan: Plan, rules: Mapping[int, RuleState], subjects: tuple[str, ...]) -> dict[str, PinnedRole]:
    """Return the roles that rules pin, by car. If several rules pin roles of one car, the first one applies."""
    result: dict[str, PinnedRole] = {}
    for _, rule, state, effect in effects_in_force(plan, rules):
        if effect.role is not None:
            for car in targets(effect, state, subjects, {}):  # the parser refuses an effect that gives a role a role
                result.setdefault(car, PinnedRole(effect.role, rule.name))
    return result


def overrides(
    plan: Plan,
    snapshot: FleetSnapshot,
    rules: Mapping[int, RuleState],
    subjects: tuple[str, ...],
    roles: Mapping[str, str],
    pinned: Mapping[str, PinnedRole],
) -> dict[str, Override]:
    """Return the modes that rules in force give cars, whatever their roles say. The first rule applies.

    A rule skips cars that do not know its mode, or may not be in it. They would refuse it again and again.
    """
    result: dict[str, Override] = {}
    decided: set[str] = set()
    for _, rule, state, effect in effects_in_force(plan, rules):
        if effect.mode is not None:
            for car in targets(effect, state, subjects, roles):
                if car not in decided and not snapshot.cars.get(car, UNKNOWN_CAR).lacks(effect.mode):
                    decided.add(car)
                    result[car] = Override(rule, state, effect)
        elif effect.role is not None:
            # Only the first rule in force counts for a car. If that rule gives a role, no later rule gives a mode.
            decided |= {car for car in targets(effect, state, subjects, roles) if pinned[car].rule == rule.name}
    return result

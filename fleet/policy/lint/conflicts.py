"""Finds conflicts in a plan: rules that contradict each other or undo themselves. Pure."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from fleet.conditions import Expression, is_contradictory
from fleet.conditions.expression import Compare, Literal, Name, Op, ValueKind
from fleet.policy.plan.plan import ALL_CARS, OTHER_CARS, THIS_CAR, Effect, Plan, PlanCondition, Quantifier, Rule
from schemas.colors import format_color
from schemas.words import Mode

_REMEMBERED: Final = 4096
"""Maximum number of cached results for pairs of conditions: enough for each pair of rules of a large plan."""


@lru_cache(_REMEMBERED)
def _contradictory(both: Expression) -> bool:
    # `both` was joined from the trees of two conditions. Their joined texts could be longer or deeper than is allowed.
    return is_contradictory(both)


def implies(one: PlanCondition, other: PlanCondition) -> bool:
    """Return True if `other` is certainly true whenever `one` is. Return False if that cannot be shown."""
    if one.for_s < other.for_s or (other.role is not None and one.role != other.role):
        return False
    same = one.of is other.of and one.car == other.car and (one.of is not Quantifier.ALL or one.role == other.role)
    if not same and not (one.of is Quantifier.CAR and other.of is Quantifier.ANY and other.role is None):
        return False
    return _contradictory(one.expression & ~other.expression)


def _can_coincide(one: PlanCondition, other: PlanCondition) -> bool:
    """Return True if both may be true at once."""
    same = (
        one.car == other.car
        if one.of is Quantifier.CAR and other.of is Quantifier.CAR
        else one.of is Quantifier.ALL and other.of is Quantifier.ALL
    )
    return not same or not _contradictory(one.expression & other.expression)


def find_conflicts(plan: Plan) -> Iterator[tuple[Rule, str, bool]]:
    """Yield each rule that conflicts with an earlier rule or itself, a text about it, and True if it always does."""
    for index, rule in enumerate(plan.rules):
        possible: list[str] = []
        for effect in rule.effects:
            for earlier in plan.rules[:index]:
                for other in earlier.effects:
                    what = _contradiction(effect, other)
                    if not what or not _can_meet(plan, rule, effect, earlier, other):
                        continue
                    whom = effect.who if effect.who not in (THIS_CAR, OTHER_CARS, ALL_CARS) else "the same car"
                    if _always_meet(rule, effect, earlier, other):
                        words = (
                            f"it contradicts {earlier.name}: whenever it is true, that one is, too, and wants {whom} "
                            f"to be {what}"
                        )
                        yield rule, f"{words}. The first counts.", True
                    elif not implies(earlier.when, rule.when) and earlier.name not in possible:
                        possible.append(earlier.name)
        if possible:
            words = f"it may be true together with {', '.join(possible)}, and wants something else of the same car"
            yield rule, f"{words}. The first counts.", False
        yield from _find_self_conflicts(plan, rule)


def _find_self_conflicts(plan: Plan, rule: Rule) -> Iterator[tuple[Rule, str, bool]]:
    for index, effect in enumerate(rule.effects):
        for other in rule.effects[:index]:
            what = _contradiction(effect, other)
            if what and (effect.who == other.who or (ALL_CARS in (effect.who, other.who) and effect.who and other.who)):
                yield rule, f"it contradicts itself: it also wants {effect.who} to be {what}. The first counts.", True
        mode = effect.mode or (plan.roles[effect.role].mode if effect.role is not None else None)
        if effect.led is not None and mode not in (None, Mode.MANUAL):
            yield rule, f"its color is never seen. A car shows it only in mode manual, and gets mode {mode}.", True
        own = effect.who in (THIS_CAR, ALL_CARS) or (rule.when.car is not None and effect.who == rule.when.car)
        if not own or mode is None or rule.until is not None or "mode.asked" not in rule.when.expression.names:
            continue
        if _contradictory(rule.when.expression & _asked_condition(mode)):
            words = f"it undoes itself again and again. In mode {mode}, {rule.when.expression} is false."
            yield rule, f"{words} Add `until`.", True


def _asked_condition(mode: Mode) -> Expression:
    """Return the condition that a car was commanded into this mode."""
    return Expression(Compare(Name("mode.asked", ValueKind.WORD), Op.EQ, Literal(str(mode))))


def _contradiction(effect: Effect, other: Effect) -> str:
    """Return what the other effect sets (a role, mode or color) if it contradicts this one. Otherwise return ""."""
    wish, others = effect.mode or effect.role, other.mode or other.role
    if wish is not None and others is not None and (effect.mode, effect.role) != (other.mode, other.role):
        return str(others)
    if effect.led is not None and other.led is not None and (effect.led, effect.blink_s) != (other.led, other.blink_s):
        return format_color(other.led)
    return ""


def _can_meet(plan: Plan, rule: Rule, effect: Effect, earlier: Rule, other: Effect) -> bool:
    """Return True if both effects may apply to one car at the same time."""
    if rule.during is not None and earlier.during is not None and not rule.during & earlier.during:
        return False
    if not _can_coincide(rule.when, earlier.when):
        return False
    one, two = _target(rule, effect), _target(earlier, other)
    if plan.is_car(one) and plan.is_car(two):
        return one == two
    # Two different roles never meet, because a car has only one role.
    return one == two or not (one in plan.roles and two in plan.roles)


def _target(rule: Rule, effect: Effect) -> str:
    """Return the target of an effect. For THIS_CAR, return the name of the car if the condition is about one car."""
    return rule.when.car if effect.who == THIS_CAR and rule.when.car is not None else effect.who


def _always_meet(rule: Rule, effect: Effect, earlier: Rule, other: Effect) -> bool:
    """Return True if the earlier rule applies to the same cars whenever this one does."""
    if earlier.until is not None or not implies(rule.when, earlier.when):
        return False
    if earlier.during is not None and not (rule.during is not None and rule.during <= earlier.during):
        return False
    one, two = _target(rule, effect), _target(earlier, other)
    if two == ALL_CARS:
        return True
    return one == two and (one not in (THIS_CAR, OTHER_CARS) or implies(earlier.when, rule.when))

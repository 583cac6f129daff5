"""Where a plan gets into its own way: rules that fight or undo themselves, phases that alternate. Pure.

What a part can never do by itself is check.py's.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from fleet.conditions import Expression, contradictory
from fleet.conditions.expression import Compare, Literal, Name, Op, ValueKind
from fleet.policy.debounce import HYSTERESIS_S
from fleet.policy.plan.plan import ALL, OTHERS, THAT, Effect, Plan, PlanCondition, Quantifier, Rule
from gateway.protocol.enums import Mode

_REMEMBERED: Final = 4096
"""Maximum pairs of conditions whose contradiction is cached: the rules of a large plan, each against each."""


@lru_cache(_REMEMBERED)
def _contradictory(both: Expression) -> bool:
    # Conditions are joined as trees. As one text two could be longer, or deeper, than a condition may be.
    return contradictory(both)


def implies(one: PlanCondition, other: PlanCondition) -> bool:
    """Whether the other is so whenever the one is; some that are not are not found."""
    if one.for_s < other.for_s or (other.role is not None and one.role != other.role):
        return False
    same = one.of is other.of and one.car == other.car and (one.of is not Quantifier.ALL or one.role == other.role)
    if not same and not (one.of is Quantifier.CAR and other.of is Quantifier.ANY and other.role is None):
        return False
    return _contradictory(one.expression & ~other.expression)


def _together(one: PlanCondition, other: PlanCondition) -> bool:
    """Whether both may be so at once."""
    same = (
        one.car == other.car
        if one.of is Quantifier.CAR and other.of is Quantifier.CAR
        else one.of is Quantifier.ALL and other.of is Quantifier.ALL
    )
    return not same or not _contradictory(one.expression & other.expression)


def fights(plan: Plan) -> Iterator[tuple[Rule, str, bool]]:
    """Rules that want other things of a car than an earlier one does: which, how, and whether it is always so."""
    for index, rule in enumerate(plan.rules):
        doubtful: list[str] = []
        for effect in rule.effects:
            for earlier in plan.rules[:index]:
                for other in earlier.effects:
                    what = _unlike(effect, other)
                    if not what or not _meet(plan, rule, effect, earlier, other):
                        continue
                    whom = effect.who if effect.who not in (THAT, OTHERS, ALL) else "the same car"
                    if _always(rule, effect, earlier, other):
                        words = f"it fights {earlier.name}, which is true whenever it is and wants {whom} to be {what}"
                        yield rule, f"{words}: the first counts", True
                    elif not implies(earlier.when, rule.when) and earlier.name not in doubtful:
                        doubtful.append(earlier.name)
        if doubtful:
            words = f"it may be true together with {', '.join(doubtful)}, and wants something else of the same car"
            yield rule, f"{words}: the first counts", False
        yield from _with_itself(plan, rule)


def _with_itself(plan: Plan, rule: Rule) -> Iterator[tuple[Rule, str, bool]]:
    for index, effect in enumerate(rule.effects):
        for other in rule.effects[:index]:
            what = _unlike(effect, other)
            if what and (effect.who == other.who or (ALL in (effect.who, other.who) and effect.who and other.who)):
                yield rule, f"it fights itself: of {effect.who} it wants {what}, too, and the first counts", True
        mode = effect.mode or (plan.roles[effect.role].mode if effect.role is not None else None)
        if effect.led is not None and mode not in (None, Mode.MANUAL):
            yield rule, f"its colour is never seen: a car obeys it in mode manual only, and gets mode {mode}", True
        own = effect.who in (THAT, ALL) or (rule.when.car is not None and effect.who == rule.when.car)
        if not own or mode is None or rule.until is not None or "mode.asked" not in rule.when.expression.names:
            continue
        if _contradictory(rule.when.expression & _asked_for(mode)):
            words = f"it undoes itself again and again: in mode {mode}, {rule.when.expression} is not so"
            yield rule, f"{words}; give it until", True


def _asked_for(mode: Mode) -> Expression:
    """Return the condition that a car was asked for this mode."""
    return Expression(Compare(Name("mode.asked", ValueKind.WORD), Op.EQ, Literal(str(mode))))


def _unlike(effect: Effect, other: Effect) -> str:
    """What the other wants that this one wants otherwise; empty: nothing."""
    wish, others = effect.mode or effect.role, other.mode or other.role
    if wish is not None and others is not None and (effect.mode, effect.role) != (other.mode, other.role):
        return str(others)
    if effect.led is not None and other.led is not None and effect.led != other.led:
        return f"of colour {list(other.led)}"
    return ""


def _meet(plan: Plan, rule: Rule, effect: Effect, earlier: Rule, other: Effect) -> bool:
    """Whether both may be so at once, of one car."""
    if rule.during is not None and earlier.during is not None and not rule.during & earlier.during:
        return False
    if not _together(rule.when, earlier.when):
        return False
    one, two = _certain(rule, effect), _certain(earlier, other)
    if plan.is_car(one) and plan.is_car(two):
        return one == two
    # Roles exclude each other; a car is in one only.
    return one == two or not (one in plan.roles and two in plan.roles)


def _certain(rule: Rule, effect: Effect) -> str:
    """Whom it hits, the car by name if there is only one that it can be."""
    return rule.when.car if effect.who == THAT and rule.when.car is not None else effect.who


def _always(rule: Rule, effect: Effect, earlier: Rule, other: Effect) -> bool:
    """Whether the earlier rule hits the same cars whenever this one does."""
    if earlier.until is not None or not implies(rule.when, earlier.when):
        return False
    if earlier.during is not None and not (rule.during is not None and rule.during <= earlier.during):
        return False
    one, two = _certain(rule, effect), _certain(earlier, other)
    if two == ALL:
        return True
    return one == two and (one not in (THAT, OTHERS) or implies(earlier.when, rule.when))


def alternations(plan: Plan) -> Iterator[tuple[str, str]]:
    """Phases that follow each other in a circle as long as one condition is so: the first of them, and how."""
    edges = list(_edges(plan))
    told: set[frozenset[str]] = set()
    for _, _, condition, _ in edges:
        ways: dict[str, list[tuple[str, Rule | None]]] = {}
        for before, after, needed, rule in edges:
            if implies(condition, needed):
                ways.setdefault(before, []).append((after, rule))
        for circle in _circles(ways, plan):
            if frozenset(circle) not in told:
                told.add(frozenset(circle))
                way = " -> ".join([*circle, circle[0]])
                words = f"{way}: these follow each other every {HYSTERESIS_S:g} s as long as {condition.text} is so"
                yield circle[0], words


def _edges(plan: Plan) -> Iterator[tuple[str, str, PlanCondition, Rule | None]]:
    for name, phase in plan.phases.items():
        if phase.until is not None and phase.next not in (None, name):
            assert phase.next is not None
            yield name, phase.next, phase.until, None
        for rule in plan.rules:
            for effect in rule.effects:
                if effect.phase not in (None, name) and rule.during is not None and name in rule.during:
                    assert effect.phase is not None
                    yield name, effect.phase, rule.when, rule


def _circles(ways: dict[str, list[tuple[str, Rule | None]]], plan: Plan) -> Iterator[list[str]]:
    for first in plan.phases:
        way, rules = [first], list[Rule | None]()
        while (at := way[-1]) in ways and (at != first or len(way) == 1) and len(way) <= len(plan.phases) + 1:
            after, rule = ways[at][0]  # the first that is so is taken
            way.append(after)
            rules.append(rule)
        circle = way[:-1]
        if len(way) > 1 and way[-1] == first:
            # A rule that counted in the phase before, too, was in force already: it has had its say.
            before = [circle[-1], *circle[:-1]]
            if all(
                rule is None or (rule.during is not None and phase not in rule.during)
                for phase, rule in zip(before, rules, strict=True)
            ):
                yield circle

"""Finds the modes that a plan can bring each car into, and whether conditions can be measured there. Pure.

The measured readings depend on the mode (docs/reference/protocol.md#placeholders). lint.py reports the findings.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

from fleet.conditions import Expression, is_contradictory
from fleet.conditions.expression import And, Compare, Literal, Name, Node, Not, Or
from fleet.conditions.satisfiability import explain_impossible
from fleet.policy.min_cost_matching import assign
from fleet.policy.plan.plan import ALL_CARS, OTHER_CARS, THIS_CAR, Effect, Plan, PlanCondition, Role, Rule
from fleet.policy.role_allocation import find_barrier
from fleet.policy.snapshot import CarSnapshot, topic_of
from gateway import drivers
from schemas.car_profile import CarProfile
from schemas.topics import FROM_OUTSIDE
from schemas.words import Mode

ANY_CAR: Final = "a car"
"""Name for a car that neither a fleet file nor the plan names."""


def list_unmeasured(expression: Expression, profile: CarProfile, mode: Mode) -> tuple[str, ...]:
    """List the names in the expression that such a car does not measure in this mode, and nobody outside of it."""
    measured = profile.measurable(mode)
    topics = {name: topic_of(name).partition("/") for name in expression.names if topic_of(name) not in FROM_OUTSIDE}
    return tuple(name for name, (family, _, topic) in topics.items() if family == "sensor" and topic not in measured)


@cache
def can_be_true(expression: Expression, profile: CarProfile, mode: Mode) -> bool:
    """Return True if the expression can become true by what such a car measures in this mode."""
    names = frozenset(list_unmeasured(expression, profile, mode))
    return not names or not is_contradictory(Expression(_without(expression.root, names, wanted=True)))


def _without(node: Node, names: frozenset[str], *, wanted: bool) -> Node:
    """Copy a tree with every part that uses one of these names replaced by the literal `not wanted`."""
    match node:
        case Not(inner):
            return Not(_without(inner, names, wanted=not wanted))
        case And(parts):
            return And(tuple(_without(part, names, wanted=wanted) for part in parts))
        case Or(parts):
            return Or(tuple(_without(part, names, wanted=wanted) for part in parts))
        case Name() | Compare() if names.intersection(Expression(node).names):
            return Literal(not wanted)
    return node


@dataclass(frozen=True, slots=True)
class Outlook:
    """If a condition can be true. never: the reason if not, else empty. only: the only cars for it, if not any car."""

    never: str = ""
    only: str = ""


class ModeReachability:
    """The modes that the cars of a fleet (None: any cars) can get into under a plan."""

    def __init__(self, plan: Plan, fleet: Mapping[str, CarSnapshot] | None, named: Iterable[str]) -> None:
        self._plan = plan
        self._known = fleet is not None
        others = (ANY_CAR,) if plan.open else ()
        self.cars = fleet if fleet is not None else dict.fromkeys((*sorted(named), *others), CarSnapshot())
        self._able = {
            (car, name): not self.why_not(car, role) for name, role in plan.roles.items() for car in self.cars
        }
        self._takers = {name: [car for car in self.cars if self._able[car, name]] for name in plan.roles}
        self._firing: set[int] = set()
        # A rule cannot trigger itself. So rules are added in rounds: each needs only those of the rounds before.
        self._places: dict[tuple[str, ...], bool] = {}
        self._open: dict[tuple[str, str], list[Role]] = {}
        while more := {
            index for index, rule in enumerate(plan.rules) if index not in self._firing and self._can_fire(rule)
        }:
            self._firing |= more
            self._places, self._open = {}, {}

    def profiles(self, car: str) -> tuple[CarProfile, ...]:
        """Return the platform profiles that a car may have."""
        known = self.cars.get(car)
        profile = known.profile if known is not None else None
        return drivers.built_in_profiles() if profile is None else (profile,)

    def can_have(self, car: str, role: Role) -> bool:
        """Return True if this car can ever have this role."""
        return self._able[car, role.name]

    def why_not(self, car: str, role: Role) -> str:
        """Return why this car can never have this role; empty if it can."""
        if car != ANY_CAR and not self._plan.may(car, role):
            return "the plan gives it to others"
        if car == ANY_CAR and role.cars is not None:
            return "only for certain cars"
        known = self.cars.get(car)
        if known is None:
            return "the fleet file has no such car"
        if known.listed and (barrier := find_barrier(known, role, 0.0)) is not None:
            return barrier.why
        if role.needs is None or any(
            can_be_true(role.needs, each, mode) for each in self.profiles(car) for mode in Mode
        ):
            return ""
        return f"it needs {role.needs}, and never measures {_first_missing(role.needs, self.profiles(car), Mode)}"

    def blind_to(self, role: Role) -> str:
        """Say why no car can measure what this role needs before it has the role; empty if one can."""
        needs, modes, kinds = role.needs, dict[Mode, None](), dict[CarProfile, None]()
        if needs is None:
            return ""
        for car in (car for car in self.cars if self.can_have(car, role)):
            kinds |= dict.fromkeys(self.profiles(car))
            for phase in self._phases(None):
                others = [each for each in self._roles(car, phase) if each.name != role.name]
                modes |= dict.fromkeys(each.mode for each in others)
                for rule in self._in_force(phase):
                    modes |= dict.fromkeys(effect.mode for effect in rule.effects if effect.mode is not None)
                given = [each for each in others if not each.by_rules and each.needs is None]
                if not self._has_place_always(car, phase, given):
                    modes[Mode.MANUAL] = None  # the coordinator brings a car without a role there
        if not modes or any(can_be_true(needs, kind, mode) for kind in kinds for mode in modes if mode in kind.modes):
            return ""
        return f"until then they are in {_or(modes)}, and do not measure {_first_missing(needs, kinds, modes)}."

    def assess(self, condition: PlanCondition, during: Iterable[str] | None) -> Outlook:
        """Assess whether a condition can be true in one of these phases (None: any) while cars follow the plan."""
        if why := explain_impossible(condition.expression):
            return Outlook(f"{why}.")
        if condition.car is not None and condition.car not in self.cars:
            return Outlook(f"There is no car {condition.car}.")
        only, modes, kinds = "", dict[Mode, None](), dict[CarProfile, None]()
        for car in self._watched(condition):
            kinds |= dict.fromkeys(self.profiles(car))
            for phase in self._phases(during):
                for mode, doubt in self._modes(car, phase, condition).items():
                    modes[mode] = None
                    if any(
                        mode in each.modes and can_be_true(condition.expression, each, mode)
                        for each in self.profiles(car)
                    ):
                        if not doubt:
                            return Outlook()
                        only = doubt
        return Outlook(only=only) if only else Outlook(self._never(condition, tuple(modes), tuple(kinds), during))

    def _never(
        self,
        condition: PlanCondition,
        modes: tuple[Mode, ...],
        kinds: tuple[CarProfile, ...],
        during: Iterable[str] | None,
    ) -> str:
        where = f" in phase {' or '.join(sorted(during))}" if during is not None else ""
        whom = condition.car or f"cars{f' with role {condition.role}' if condition.role else ''}"
        if not modes:
            return f"There are never {whom}{where}."
        missing = _first_missing(condition.expression, kinds, modes)
        can_have = [
            mode
            for mode in Mode
            if any(mode in one.modes and can_be_true(condition.expression, one, mode) for one in kinds)
        ]
        words = f"It waits for {missing} from {whom}"
        if not can_have:
            return f"{words}, which no mode measures there."
        they = "it is" if condition.car else "they are"
        return f"{words}, but {they} always in {_or(modes)}{where}. A car measures it only in {_or(can_have)}."

    # ------------------------------------------------------------------ reachable modes

    def _can_fire(self, rule: Rule) -> bool:
        return not self.assess(rule.when, rule.during).never

    def _phases(self, during: Iterable[str] | None) -> Iterable[str]:
        return (self._plan.phases or ("",)) if during is None else during

    def _watched(self, condition: PlanCondition) -> Iterable[str]:
        if condition.car is not None:
            return (condition.car,)
        return self.cars if self._plan.open else [car for car in self._plan.named if car in self.cars]

    def _modes(self, car: str, phase: str, condition: PlanCondition) -> dict[Mode, str]:
        """Return the modes that the plan can bring an observed car into, with the only cars in each (empty: any)."""
        roles, role = self._roles(car, phase), condition.role
        result = {each.mode: "" for each in roles if role in (None, each.name)}
        if role is not None and not result:
            return {}
        for rule in self._in_force(phase):
            for effect in rule.effects:
                if effect.mode is not None and self._affects(rule, effect, car, role, roles):
                    result[effect.mode] = ""
        if role is None and result.get(Mode.MANUAL) is None and (idle := self._idle(car, phase, roles)) is not None:
            known = {topic_of(name) for name in condition.expression.names}
            weak = [each for each in roles if each.needs is not None and known & set(map(topic_of, each.needs.names))]
            result[Mode.MANUAL] = "" if weak else idle  # a rule about a role's needs is for the cars that lack them
        return result

    def _in_force(self, phase: str) -> Iterator[Rule]:
        for index in self._firing:
            rule = self._plan.rules[index]
            if rule.during is None or phase in rule.during:
                yield rule

    def _roles(self, car: str, phase: str) -> list[Role]:
        """Return the roles that a car may have in this phase, from the cache."""
        if (car, phase) not in self._open:
            self._open[car, phase] = self._roles_now(car, phase)
        return self._open[car, phase]

    def _roles_now(self, car: str, phase: str) -> list[Role]:
        counting = self._plan.phases[phase].roles if phase else None
        can_have = [role for name, role in self._plan.roles.items() if self._able.get((car, name))]
        return [
            role
            for role in can_have
            if (counting is None or role.name in counting) and (not role.by_rules or self._is_called(car, role, phase))
        ]

    def _is_called(self, car: str, role: Role, phase: str) -> bool:
        given = (
            effect.role == role.name and not (self._plan.is_car(effect.who) and effect.who != car)
            for rule in self._in_force(phase)
            for effect in rule.effects
        )
        return any(given) or any(other.if_none == role.name for other in self._plan.roles.values())

    def _affects(self, rule: Rule, effect: Effect, car: str, role: str | None, roles: list[Role]) -> bool:
        when = rule.when
        match effect.who:
            case who if who == THIS_CAR:
                # A car that triggered the rule in another role may have this role by now, if `until` ends the rule.
                own = role is None or rule.until is not None or when.role in (None, role)
                could = when.role is None or rule.until is not None or any(each.name == when.role for each in roles)
                return when.car in (None, car) and own and could
            case who if who == OTHER_CARS:
                return when.car != car
            case who if who in (ALL_CARS, car):
                return True
            case who:
                return any(each.name == who for each in roles) and role in (None, who)

    def _idle(self, car: str, phase: str, roles: list[Role]) -> str | None:
        """Return None if a car always has a role, empty if it may be without one, else the only case of that."""
        own_roles = [role for role in roles if not role.by_rules]
        if self._has_place_always(car, phase, [role for role in own_roles if role.needs is None]):
            return None
        if not self._has_place_always(car, phase, own_roles):
            return ""
        lacks = " or ".join(dict.fromkeys(role.needs_text for role in own_roles if role.needs is not None))
        return f"a car that has no role because it has not {lacks}"

    def _has_place_always(self, car: str, phase: str, own_roles: list[Role]) -> bool:
        """Return True if one of these roles always has a place for this car."""
        for role in own_roles:
            takers = self._takers[role.name]
            if role.count is None or (ANY_CAR not in takers and len(takers) <= role.count):
                return True
        if not self._known or not own_roles:
            return False
        # The result is the same for all cars that may have the same roles.
        key = (phase, *(role.name for role in own_roles))
        if key not in self._places:
            self._places[key] = self._is_needed(car, phase, own_roles)
        return self._places[key]

    def _is_needed(self, car: str, phase: str, own_roles: list[Role]) -> bool:
        """Return True if fewer places would be filled without this car."""
        names = {role.name: role.count or 0 for role in own_roles}
        costs = {
            other: {role.name: -1 for role in self._roles(other, phase) if role.name in names} for other in self.cars
        }
        rest = {other: row for other, row in costs.items() if other != car}
        return len(assign(costs, names)) > len(assign(rest, names))


def _first_missing(expression: Expression, kinds: Iterable[CarProfile], modes: Iterable[Mode]) -> str:
    """Return the first name that none of these modes measures; all names if only no mode measures all."""
    measured = [
        set(list_unmeasured(expression, profile, mode)) for profile in kinds for mode in modes if mode in profile.modes
    ]
    never = set.intersection(*measured) if measured else set()
    return next((name for name in expression.names if name in never), f"all of {', '.join(expression.names)}")


def _or(modes: Iterable[str]) -> str:
    return " or ".join(modes)


def describe_unmeasured(expression: Expression, cars: Iterable[tuple[CarSnapshot, str]], more: str = "") -> str:
    """Return ` (light.left is not measured in mode tracking)` if no car can measure the expression in its mode."""
    names, modes = dict[str, None](), dict[str, None]()
    for known, mode in cars:
        missing = _list_unmeasured(expression, known.platform, mode)
        if not missing:
            return ""
        names |= dict.fromkeys(missing)
        modes[mode] = None
    words = f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not measured in mode {_or(modes)}{more}"
    return f" ({words})" if modes else ""


@cache  # called in each step; by the platform's name, as its hash is faster than a profile's
def _list_unmeasured(expression: Expression, platform: str, mode: str) -> tuple[str, ...]:
    """List the names that keep a car from measuring the expression in this mode; none if unknown."""
    profile = CarSnapshot(platform=platform).profile
    if profile is None or mode not in set(Mode) or can_be_true(expression, profile, Mode(mode)):
        return ()
    return list_unmeasured(expression, profile, Mode(mode))

"""Finds the modes that a plan can bring each car into, and whether cars can measure conditions in these modes. Pure.

Which readings a car measures depends on its mode (docs/reference/protocol.md#placeholders). lint.py reports the faults.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Final

from msgspec import Struct

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
"""Stands for any car that is neither in a fleet file nor in the plan."""


def list_unmeasured(expression: Expression, profile: CarProfile, mode: Mode) -> tuple[str, ...]:
    """List the readings in the expression that a car with this profile does not measure in this mode.

    Readings that a program outside the car may publish are not in the list.
    """
    measured = profile.measurable(mode)
    topics = {name: topic_of(name).partition("/") for name in expression.names if topic_of(name) not in FROM_OUTSIDE}
    return tuple(name for name, (family, _, topic) in topics.items() if family == "sensor" and topic not in measured)


@cache
def can_be_true(expression: Expression, profile: CarProfile, mode: Mode) -> bool:
    """Return True if the expression can become true by what a car with this profile measures in this mode."""
    names = frozenset(list_unmeasured(expression, profile, mode))
    return not names or not is_contradictory(Expression(_assume(expression.root, names, value=False)))


def _assume(node: Node, names: frozenset[str], *, value: bool) -> Node:
    """Copy a tree. A part that uses one of these names becomes the literal `value`, or its opposite under a `not`."""
    match node:
        case Not(inner):
            return Not(_assume(inner, names, value=not value))
        case And(parts):
            return And(tuple(_assume(part, names, value=value) for part in parts))
        case Or(parts):
            return Or(tuple(_assume(part, names, value=value) for part in parts))
        case Name() | Compare() if names.intersection(Expression(node).names):
            return Literal(value)
    return node


class Outlook(Struct, frozen=True):
    """Says whether a condition can be true. If both texts are empty, it can be true for any car."""

    never: str = ""
    """The reason why the condition is never true."""
    only_when: str = ""
    """The only case in which the condition can be true, such as `a car has no role because ...`."""


class ModeReachability:
    """The modes that cars can get into under a plan.

    `fleet` has the cars in the fleet file. If it is None, the cars are those that the plan names. If the plan is open
    to other cars, ANY_CAR is among them.
    """

    def __init__(self, plan: Plan, fleet: Mapping[str, CarSnapshot] | None, named: Iterable[str]) -> None:
        self._plan = plan
        self._has_fleet_file = fleet is not None
        others = (ANY_CAR,) if plan.is_open else ()
        self.cars = fleet if fleet is not None else dict.fromkeys((*sorted(named), *others), CarSnapshot())
        self._able = {
            (car, name): not self.explain_barrier(car, role) for name, role in plan.roles.items() for car in self.cars
        }
        self._cars_of_role = {name: [car for car in self.cars if self._able[car, name]] for name in plan.roles}
        self._firing: set[int] = set()
        """Indexes of the rules that can fire."""
        self._place_cache: dict[tuple[str, ...], bool] = {}
        self._role_cache: dict[tuple[str, str], list[Role]] = {}
        # A rule cannot trigger itself. So find the rules in rounds: the first can fire without any other rule, the next
        # because of rules that were found before.
        while more := self._list_more_firing():
            self._firing |= more
            self._place_cache, self._role_cache = {}, {}

    def profiles(self, car: str) -> tuple[CarProfile, ...]:
        """Return the platform profiles that a car may have."""
        snapshot = self.cars.get(car)
        profile = snapshot.profile if snapshot is not None else None
        return drivers.built_in_profiles() if profile is None else (profile,)

    def can_have(self, car: str, role: Role) -> bool:
        """Return True if this car can ever have this role."""
        return self._able[car, role.name]

    def explain_barrier(self, car: str, role: Role) -> str:
        """Return the reason why this car can never have this role, or an empty text if it can."""
        if car != ANY_CAR and not self._plan.may(car, role):
            return "the plan gives it to others"
        if car == ANY_CAR and role.cars is not None:
            return "only for certain cars"
        snapshot = self.cars.get(car)
        if snapshot is None:
            return "the fleet file has no such car"
        if snapshot.listed and (barrier := find_barrier(snapshot, role, 0.0)) is not None:
            return barrier.why
        if role.needs is None or any(
            can_be_true(role.needs, each, mode) for each in self.profiles(car) for mode in Mode
        ):
            return ""
        return f"it needs {role.needs}, and never measures {_first_missing(role.needs, self.profiles(car), Mode)}"

    def explain_blindness(self, role: Role) -> str:
        """Return why no car can get this role: without the role, no car measures what the role needs.

        The text is empty if some car measures it.
        """
        needs = role.needs
        if needs is None:
            return ""
        modes, kinds = dict[Mode, None](), dict[CarProfile, None]()
        for car in (car for car in self.cars if self.can_have(car, role)):
            kinds |= dict.fromkeys(self.profiles(car))
            for phase in self._list_phases(None):
                other_roles = [each for each in self._list_roles(car, phase) if each.name != role.name]
                modes |= dict.fromkeys(each.mode for each in other_roles)
                for rule in self._list_firing_rules(phase):
                    modes |= dict.fromkeys(effect.mode for effect in rule.effects if effect.mode is not None)
                unconditional = [each for each in other_roles if not each.by_rules and each.needs is None]
                if not self._always_has_place(car, phase, unconditional):
                    modes[Mode.MANUAL] = None  # the coordinator brings a car without a role into this mode
        if not modes or any(can_be_true(needs, kind, mode) for kind in kinds for mode in modes if mode in kind.modes):
            return ""
        return f"until then they are in {_join_or(modes)}, and do not measure {_first_missing(needs, kinds, modes)}."

    def assess(self, condition: PlanCondition, during: Iterable[str] | None) -> Outlook:
        """Assess whether a condition can be true in one of these phases while cars follow the plan.

        If `during` is None, all phases count.
        """
        if why := explain_impossible(condition.expression):
            return Outlook(f"{why}.")
        if condition.car is not None and condition.car not in self.cars:
            return Outlook(f"There is no car {condition.car}.")
        only_when, modes, kinds = "", dict[Mode, None](), dict[CarProfile, None]()
        for car in self._list_watched_cars(condition):
            kinds |= dict.fromkeys(self.profiles(car))
            for phase in self._list_phases(during):
                for mode, case in self._find_modes(car, phase, condition).items():
                    modes[mode] = None
                    if any(
                        mode in each.modes and can_be_true(condition.expression, each, mode)
                        for each in self.profiles(car)
                    ):
                        if not case:
                            return Outlook()
                        only_when = case
        if only_when:
            return Outlook(only_when=only_when)
        return Outlook(self._explain_never(condition, tuple(modes), tuple(kinds), during))

    def _explain_never(
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
        measuring_modes = [
            mode
            for mode in Mode
            if any(mode in each.modes and can_be_true(condition.expression, each, mode) for each in kinds)
        ]
        words = f"It waits for {missing} from {whom}"
        if not measuring_modes:
            return f"{words}, and no mode measures it."
        they = "it is" if condition.car else "they are"
        only_in = _join_or(measuring_modes)
        return f"{words}, but {they} always in {_join_or(modes)}{where}. A car measures it only in {only_in}."

    # ------------------------------------------------------------------ reachable modes

    def _list_more_firing(self) -> set[int]:
        """List the rules that can fire because of the rules that are known to fire."""
        return {
            index
            for index, rule in enumerate(self._plan.rules)
            if index not in self._firing and not self.assess(rule.when, rule.during).never
        }

    def _list_phases(self, during: Iterable[str] | None) -> Iterable[str]:
        return (self._plan.phases or ("",)) if during is None else during

    def _list_watched_cars(self, condition: PlanCondition) -> Iterable[str]:
        if condition.car is not None:
            return (condition.car,)
        return self.cars if self._plan.is_open else [car for car in self._plan.named_cars if car in self.cars]

    def _find_modes(self, car: str, phase: str, condition: PlanCondition) -> dict[Mode, str]:
        """Return the modes that the plan can bring a watched car into.

        If the plan brings the car into a mode in only one case, the mode has a text about this case. Otherwise its text
        is empty.
        """
        roles, role = self._list_roles(car, phase), condition.role
        result = {each.mode: "" for each in roles if role in (None, each.name)}
        if role is not None and not result:
            return {}
        for rule in self._list_firing_rules(phase):
            for effect in rule.effects:
                if effect.mode is not None and self._affects(rule, effect, car, role, roles):
                    result[effect.mode] = ""
        if role is not None or Mode.MANUAL in result:
            return result
        idle_case = self._find_idle_case(car, phase, roles)
        if idle_case is not None:
            topics = {topic_of(name) for name in condition.expression.names}
            # A condition about a role's needs is meant for cars that do not meet them.
            is_about_needs = any(
                role.needs is not None and topics.intersection(map(topic_of, role.needs.names)) for role in roles
            )
            result[Mode.MANUAL] = "" if is_about_needs else idle_case
        return result

    def _list_firing_rules(self, phase: str) -> Iterator[Rule]:
        for index in self._firing:
            rule = self._plan.rules[index]
            if rule.during is None or phase in rule.during:
                yield rule

    def _list_roles(self, car: str, phase: str) -> list[Role]:
        """Return the roles that a car may have in this phase, from the cache."""
        if (car, phase) not in self._role_cache:
            self._role_cache[car, phase] = self._find_roles(car, phase)
        return self._role_cache[car, phase]

    def _find_roles(self, car: str, phase: str) -> list[Role]:
        counting = self._plan.phases[phase].roles if phase else None
        can_have = [role for name, role in self._plan.roles.items() if self._able.get((car, name))]
        return [
            role
            for role in can_have
            if (counting is None or role.name in counting) and (not role.by_rules or self._is_given(car, role, phase))
        ]

    def _is_given(self, car: str, role: Role, phase: str) -> bool:
        """Return True if a rule or another role (by its `if_none`) can give this role to the car."""
        by_rules = (
            effect.role == role.name and not (self._plan.is_car(effect.who) and effect.who != car)
            for rule in self._list_firing_rules(phase)
            for effect in rule.effects
        )
        return any(by_rules) or any(other.if_none == role.name for other in self._plan.roles.values())

    def _affects(self, rule: Rule, effect: Effect, car: str, role: str | None, roles: list[Role]) -> bool:
        """Return True if the effect can reach the car while it has this role. If `role` is None, any role counts."""
        when = rule.when
        match effect.who:
            case who if who == THIS_CAR:
                # A rule with `until` lasts. So a car that triggered it in another role may have this role by now.
                own_role = role is None or rule.until is not None or when.role in (None, role)
                triggers = when.role is None or rule.until is not None or any(each.name == when.role for each in roles)
                return when.car in (None, car) and own_role and triggers
            case who if who == OTHER_CARS:
                return when.car != car
            case who if who in (ALL_CARS, car):
                return True
            case who:
                return any(each.name == who for each in roles) and role in (None, who)

    def _find_idle_case(self, car: str, phase: str, roles: list[Role]) -> str | None:
        """Find out when a car has no role in this phase.

        Returns None if the car always has a role.
        Returns an empty text if the car may have no role in several cases.
        Otherwise returns the only case, in words.
        """
        own_roles = [role for role in roles if not role.by_rules]
        if self._always_has_place(car, phase, [role for role in own_roles if role.needs is None]):
            return None
        if not self._always_has_place(car, phase, own_roles):
            return ""
        needs = " or ".join(dict.fromkeys(role.needs_text for role in own_roles if role.needs is not None))
        return f"a car has no role because it does not meet {needs}"

    def _always_has_place(self, car: str, phase: str, own_roles: list[Role]) -> bool:
        """Return True if there is always a place for this car in one of these roles."""
        for role in own_roles:
            competitors = self._cars_of_role[role.name]
            if role.count is None or (ANY_CAR not in competitors and len(competitors) <= role.count):
                return True
        if not self._has_fleet_file or not own_roles:
            return False
        # The result is the same for all cars that may have the same roles.
        key = (phase, *(role.name for role in own_roles))
        if key not in self._place_cache:
            self._place_cache[key] = self._is_needed(car, phase, own_roles)
        return self._place_cache[key]

    def _is_needed(self, car: str, phase: str, own_roles: list[Role]) -> bool:
        """Return True if fewer places would be filled without this car."""
        places = {role.name: role.count or 0 for role in own_roles}
        costs = {
            other: {role.name: -1 for role in self._list_roles(other, phase) if role.name in places}
            for other in self.cars
        }
        without_car = {other: row for other, row in costs.items() if other != car}
        return len(assign(costs, places)) > len(assign(without_car, places))


def _first_missing(expression: Expression, kinds: Iterable[CarProfile], modes: Iterable[Mode]) -> str:
    """Return the first name that no kind of car measures in any of these modes.

    If each name is measured in some mode, return all: the expression fails only because no mode measures all of them.
    """
    unmeasured = [
        set(list_unmeasured(expression, profile, mode)) for profile in kinds for mode in modes if mode in profile.modes
    ]
    never_measured = set.intersection(*unmeasured) if unmeasured else set()
    return next((name for name in expression.names if name in never_measured), f"all of {', '.join(expression.names)}")


def _join_or(modes: Iterable[str]) -> str:
    return " or ".join(modes)


def describe_unmeasured(expression: Expression, cars: Iterable[tuple[CarSnapshot, str]], more: str = "") -> str:
    """Describe the readings that no car measures in its mode: ` (light.left is not measured in mode tracking)`.

    `cars` has each car's snapshot and mode. The text is empty if a car can measure the expression.
    """
    names, modes = dict[str, None](), dict[str, None]()
    for snapshot, mode in cars:
        missing = _list_unmeasured(expression, snapshot.platform, mode)
        if not missing:
            return ""
        names |= dict.fromkeys(missing)
        modes[mode] = None
    words = f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not measured in mode {_join_or(modes)}{more}"
    return f" ({words})" if modes else ""


# Each step of a plan calls this. The key is the platform's name, because its hash is faster than a profile's.
@cache
def _list_unmeasured(expression: Expression, platform: str, mode: str) -> tuple[str, ...]:
    """List the readings in the expression that a car does not measure in this mode. Unknown modes give none."""
    profile = CarSnapshot(platform=platform).profile
    if profile is None or mode not in set(Mode) or can_be_true(expression, profile, Mode(mode)):
        return ()
    return list_unmeasured(expression, profile, Mode(mode))

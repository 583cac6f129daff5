"""In which modes a plan brings its cars, and whether a condition can be seen to be so there. Pure.

What a car measures depends on its mode (docs/reference/protocol.md#placeholders); which findings follow is
check.py's.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

from fleet.conditions import Expression, contradictory
from fleet.conditions.domains import outside
from fleet.conditions.expression import And, Compare, Literal, Name, Node, Not, Or
from fleet.policy.allocation import unfit
from fleet.policy.assignment import assign
from fleet.policy.plan.plan import ALL, OTHERS, THAT, Effect, Plan, PlanCondition, Role, Rule
from fleet.policy.snapshot import NAMES, CarSnapshot, topic_of
from gateway.protocol.enums import Mode
from gateway.protocol.platforms import OPTIONS, Platform, Profile, parse_platform

ANY_CAR: Final = "a car"
"""Without a fleet file: a car that the plan does not name."""
_KINDS: Final = tuple(
    parse_platform("+".join((kind, *sorted(OPTIONS)))) for kind in Platform if kind is not Platform.UNKNOWN
)


def unmeasured(expression: Expression, profile: Profile, mode: Mode) -> tuple[str, ...]:
    """The names in it that such a car does not measure in this mode."""
    there = profile.measurable(mode)
    topics = {name: topic_of(name).partition("/") for name in expression.names}
    return tuple(name for name, (family, _, topic) in topics.items() if family == "sensor" and topic not in there)


@cache
def seen(expression: Expression, profile: Profile, mode: Mode) -> bool:
    """Whether it can be so by what such a car measures in this mode."""
    names = frozenset(unmeasured(expression, profile, mode))
    return not names or not contradictory(Expression(_without(expression.root, names, wanted=True)))


def _without(node: Node, names: frozenset[str], *, wanted: bool) -> Node:
    """The same where nothing that looks at one of these names is as it is wanted."""
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
    """Whether a condition can be so. never: why not, empty if it can. only: of which cars alone, empty: of any."""

    never: str = ""
    only: str = ""


class ModeReachability:
    """Where the cars of a fleet (None: of any) get to under a plan."""

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
        # What only the rule itself would bring about does not make it true: the rules that others make true come first.
        self._places: dict[tuple[str, ...], bool] = {}
        self._open: dict[tuple[str, str], list[Role]] = {}
        while more := {index for index, rule in enumerate(plan.rules) if index not in self._firing and self._can(rule)}:
            self._firing |= more
            self._places, self._open = {}, {}

    def profiles(self, car: str) -> tuple[Profile, ...]:
        """What it may be."""
        known = self.cars.get(car)
        profile = known.profile if known is not None else None
        return _KINDS if profile is None else (profile,)

    def able(self, car: str, role: Role) -> bool:
        """Whether it can have this role at all."""
        return self._able[car, role.name]

    def why_not(self, car: str, role: Role) -> str:
        """Why this car can never have this role; empty if it can."""
        if car != ANY_CAR and not self._plan.may(car, role):
            return "the plan gives it to others"
        if car == ANY_CAR and role.cars is not None:
            return "only for certain cars"
        known = self.cars.get(car)
        if known is None:
            return "the fleet file has no such car"
        if known.listed and (barrier := unfit(known, role, 0.0)) is not None:
            return barrier.why
        if role.needs is None or any(seen(role.needs, each, mode) for each in self.profiles(car) for mode in Mode):
            return ""
        return (
            f"it needs {role.needs}, and {_first_missing(role.needs, self.profiles(car), Mode)} is never measured on it"
        )

    def outlook(self, condition: PlanCondition, during: Iterable[str] | None) -> Outlook:
        """Whether it can be so in one of these phases (None: in any), of a car that is as the plan wants it."""
        if why := outside(condition.expression, NAMES):
            return Outlook(why)
        if condition.car is not None and condition.car not in self.cars:
            return Outlook(f"there is no car {condition.car}")
        only, modes, kinds = "", dict[Mode, None](), dict[Profile, None]()
        for car in self._watched(condition):
            kinds |= dict.fromkeys(self.profiles(car))
            for phase in self._phases(during):
                for mode, doubt in self._modes(car, phase, condition).items():
                    modes[mode] = None
                    if any(
                        mode in each.modes and seen(condition.expression, each, mode) for each in self.profiles(car)
                    ):
                        if not doubt:
                            return Outlook()
                        only = doubt
        return Outlook(only=only) if only else Outlook(self._never(condition, tuple(modes), tuple(kinds), during))

    def _never(
        self,
        condition: PlanCondition,
        modes: tuple[Mode, ...],
        kinds: tuple[Profile, ...],
        during: Iterable[str] | None,
    ) -> str:
        where = f" in phase {' or '.join(sorted(during))}" if during is not None else ""
        whom = condition.car or f"{condition.of} car{f' with role {condition.role}' if condition.role else ''}"
        if not modes:
            return f"there is never {whom.replace(f'{condition.of} ', 'a ', 1)}{where}"
        missing = _first_missing(condition.expression, kinds, modes)
        able = [
            mode for mode in Mode if any(mode in one.modes and seen(condition.expression, one, mode) for one in kinds)
        ]
        words = f"{missing} is never measured on {whom}: this plan lets it be in {_or(modes)} only{where}"
        if not able:
            return f"{missing} is never measured on {whom}, in no mode"
        return f"{words}, and it is measured in {_or(able)}: let {condition.car or 'a car'} be in such a mode then"

    # ------------------------------------------------------------------ where the cars get to

    def _can(self, rule: Rule) -> bool:
        return not self.outlook(rule.when, rule.during).never

    def _phases(self, during: Iterable[str] | None) -> Iterable[str]:
        return (self._plan.phases or ("",)) if during is None else during

    def _watched(self, condition: PlanCondition) -> Iterable[str]:
        if condition.car is not None:
            return (condition.car,)
        return self.cars if self._plan.open else [car for car in self._plan.named if car in self.cars]

    def _modes(self, car: str, phase: str, condition: PlanCondition) -> dict[Mode, str]:
        """The modes that a car the condition looks at is brought into, each with the only cars that are, if not any."""
        roles, role = self._roles(car, phase), condition.role
        found = {each.mode: "" for each in roles if role in (None, each.name)}
        if role is not None and not found:
            return {}
        for rule in self._in_force(phase):
            for effect in rule.effects:
                if effect.mode is not None and self._hits(rule, effect, car, role, roles):
                    found[effect.mode] = ""
        if role is None and found.get(Mode.MANUAL) is None and (idle := self._idle(car, phase, roles)) is not None:
            known = {topic_of(name) for name in condition.expression.names}
            weak = [each for each in roles if each.needs is not None and known & set(map(topic_of, each.needs.names))]
            found[Mode.MANUAL] = "" if weak else idle  # a rule about what a role needs is meant for those that lack it
        return found

    def _in_force(self, phase: str) -> Iterator[Rule]:
        for index in self._firing:
            rule = self._plan.rules[index]
            if rule.during is None or phase in rule.during:
                yield rule

    def _roles(self, car: str, phase: str) -> list[Role]:
        """The roles that it may have in this phase."""
        if (car, phase) not in self._open:
            self._open[car, phase] = self._roles_now(car, phase)
        return self._open[car, phase]

    def _roles_now(self, car: str, phase: str) -> list[Role]:
        counting = self._plan.phases[phase].roles if phase else None
        able = [role for name, role in self._plan.roles.items() if self._able.get((car, name))]
        return [
            role
            for role in able
            if (counting is None or role.name in counting) and (not role.on_call or self._called(car, role, phase))
        ]

    def _called(self, car: str, role: Role, phase: str) -> bool:
        given = (
            effect.role == role.name and not (self._plan.is_car(effect.who) and effect.who != car)
            for rule in self._in_force(phase)
            for effect in rule.effects
        )
        return any(given) or any(other.fallback == role.name for other in self._plan.roles.values())

    def _hits(self, rule: Rule, effect: Effect, car: str, role: str | None, roles: list[Role]) -> bool:
        when = rule.when
        match effect.who:
            case who if who == THAT:
                # One that was made so in another role may have this one by now, as long as only `until` ends the rule.
                own = role is None or rule.until is not None or when.role in (None, role)
                could = when.role is None or rule.until is not None or any(each.name == when.role for each in roles)
                return when.car in (None, car) and own and could
            case who if who == OTHERS:
                return when.car != car
            case who if who in (ALL, car):
                return True
            case who:
                return any(each.name == who for each in roles) and role in (None, who)

    def _idle(self, car: str, phase: str, roles: list[Role]) -> str | None:
        """Whether it may be without a role: empty if so, None if not; else when alone."""
        mine = [role for role in roles if not role.on_call]
        if self._always(car, phase, [role for role in mine if role.needs is None]):
            return None
        if not self._always(car, phase, mine):
            return ""
        lacks = " or ".join(dict.fromkeys(role.needs_text for role in mine if role.needs is not None))
        return f"a car that has no role because it has not {lacks}"

    def _always(self, car: str, phase: str, mine: list[Role]) -> bool:
        """Whether one of these roles always has a place for it."""
        for role in mine:
            takers = self._takers[role.name]
            if role.count is None or (ANY_CAR not in takers and len(takers) <= role.count):
                return True
        if not self._known or not mine:
            return False
        # The answer is the same for all cars that may have the same roles.
        key = (phase, *(role.name for role in mine))
        if key not in self._places:
            self._places[key] = self._needed(car, phase, mine)
        return self._places[key]

    def _needed(self, car: str, phase: str, mine: list[Role]) -> bool:
        """Whether fewer places are filled without it."""
        names = {role.name: role.count or 0 for role in mine}
        costs = {
            other: {role.name: -1 for role in self._roles(other, phase) if role.name in names} for other in self.cars
        }
        rest = {other: row for other, row in costs.items() if other != car}
        return len(assign(costs, names)) > len(assign(rest, names))


def _first_missing(expression: Expression, kinds: Iterable[Profile], modes: Iterable[Mode]) -> str:
    """What is measured in none of these modes; or all, if it is only never measured together."""
    there = [set(unmeasured(expression, profile, mode)) for profile in kinds for mode in modes if mode in profile.modes]
    never = set.intersection(*there) if there else set()
    return next((name for name in expression.names if name in never), f"all of {', '.join(expression.names)}")


def _or(modes: Iterable[str]) -> str:
    return " or ".join(modes)


def blind(expression: Expression, cars: Iterable[tuple[CarSnapshot, str]], more: str = "") -> str:
    """` (light.left is not measured in mode tracking)` if none of these cars can see it to be so, each in this mode."""
    names, modes = dict[str, None](), dict[str, None]()
    for known, mode in cars:
        missing = _blind(expression, known.platform, mode)
        if not missing:
            return ""
        names |= dict.fromkeys(missing)
        modes[mode] = None
    told = f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not measured in mode {_or(modes)}{more}"
    return f" ({told})" if modes else ""


@cache  # asked for at each decision: by the platform's name, which is looked up faster than a profile
def _blind(expression: Expression, platform: str, mode: str) -> tuple[str, ...]:
    """What keeps a car from seeing it to be so in this mode; nothing if it can, or that is not known."""
    profile = CarSnapshot(platform=platform).profile
    if profile is None or mode not in set(Mode) or seen(expression, profile, Mode(mode)):
        return ()
    return unmeasured(expression, profile, Mode(mode))

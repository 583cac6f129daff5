"""A plan as values: roles for cars, rules that change them, phases that follow each other. Pure.

plan_parser.py reads a plan from its text, lint.py finds parts of it that can never work, decide.py follows it.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from msgspec import Struct

from fleet.conditions import Expression
from schemas.colors import Rgb
from schemas.words import Mode

THIS_CAR: Final = "this_car"
OTHER_CARS: Final = "other_cars"
ALL_CARS: Final = "all_cars"
RESERVED: Final = frozenset({THIS_CAR, OTHER_CARS, ALL_CARS, "all"})
"""Words with a meaning in rules. The parser refuses them as names of roles, phases and the cars in `fixed`."""


class Quantifier(StrEnum):
    """The cars for which a condition must be true."""

    ANY = "any_car"
    ALL = "all_cars"
    CAR = "car"


_WORDS: Final = {Quantifier.ANY: "any car", Quantifier.ALL: "all cars"}


@dataclass(frozen=True, slots=True)
class PlanCondition:
    """An expression, the cars for which it must be true, and for how many seconds without a break."""

    of: Quantifier
    expression: Expression
    car: str | None = None
    """The car, with Quantifier.CAR."""
    role: str | None = None
    """With ANY and ALL: look only at cars that have this role."""
    for_s: float = 0.0
    text: str = field(init=False, compare=False)
    """The condition in words."""

    def __post_init__(self) -> None:
        # Compute the text once, because it is used ten times a second for each car.
        object.__setattr__(self, "text", self._text())

    def _text(self) -> str:
        who = (
            self.car
            if self.of is Quantifier.CAR
            else f"{_WORDS[self.of]}{f' with role {self.role}' if self.role else ''}"
        )
        lasting = f" for {self.for_s:g} s" if self.for_s else ""
        return f"{who}: {self.expression}{lasting}"


@dataclass(frozen=True, slots=True)
class Role:
    """A mode for some cars, and the cars that may have it."""

    name: str
    mode: Mode
    needs: Expression | None = None
    count: int | None = 1
    """Number of cars, or None for any number."""
    priority: int = 0
    cars: tuple[str, ...] | None = None
    """The only cars that may have the role, best first, or None if any car may."""
    capabilities: frozenset[str] = frozenset()
    platforms: tuple[str, ...] | None = None
    if_none: str | None = None
    """The fallback: for each place of this role that no car can fill, the fallback gets one more place."""
    by_rules: bool = False
    """True if only rules give this role to cars."""
    needs_text: str = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "needs_text", "" if self.needs is None else str(self.needs))


class Effect(Struct, frozen=True):
    """A role, mode or color that a rule gives to some cars, or the phase that a rule begins."""

    who: str = ""
    role: str | None = None
    mode: Mode | None = None
    led: Rgb | None = None
    blink_s: float | None = None
    """Time for which a blinking LED is on, and then off. None if it does not blink."""
    phase: str | None = None


class Rule(Struct, frozen=True):
    """Effects that are in force while `when` is true. With `until`, they stay in force until `until` is true."""

    name: str
    when: PlanCondition
    effects: tuple[Effect, ...]
    until: PlanCondition | None = None
    during: frozenset[str] | None = None


class PlanPhase(Struct, frozen=True):
    """A part of the job."""

    name: str
    roles: frozenset[str] | None = None
    """The roles that cars may have in this phase. None for all roles."""
    until: PlanCondition | None = None
    timeout_s: float | None = None
    next: str | None = None
    on_timeout: str | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan for the coordinator. If several rules are about one car, the first rule in force applies."""

    roles: Mapping[str, Role]
    fixed: Mapping[str, str]
    """By car: the only role that the car may have."""
    rules: tuple[Rule, ...]
    phases: Mapping[str, PlanPhase]
    idle: Mode | None
    """The mode of cars that have no role. None if the plan leaves them alone."""
    text: str
    places: Mapping[str, tuple[int, int]] = field(default_factory=dict, compare=False)
    """Line and column of each role, rule, phase and named car in the text, by the name that the lint's findings use."""

    @property
    def version(self) -> str:
        """The first digits of a hash of the plan's text."""
        return version_of(self.text)

    @property
    def first_phase(self) -> str:
        """The first phase, or an empty text if there are none."""
        return next(iter(self.phases), "")

    @property
    def is_open(self) -> bool:
        """True if the plan may affect cars that it does not name."""
        if any(role.cars is None for role in self.roles.values()):
            return True
        return any(effect.who in (THIS_CAR, OTHER_CARS, ALL_CARS) for rule in self.rules for effect in rule.effects)

    @property
    def named_cars(self) -> tuple[str, ...]:
        """The cars that the plan names in `fixed`, in roles and in effects, but not those only in conditions."""
        targets = (effect.who for rule in self.rules for effect in rule.effects)
        cars = [*self.fixed, *(car for role in self.roles.values() for car in role.cars or ())]
        return tuple(dict.fromkeys([*cars, *(who for who in targets if who and self.is_car(who))]))

    @property
    def conditions(self) -> Iterable[PlanCondition]:
        """Every condition in the plan."""
        for rule in self.rules:
            yield rule.when
            if rule.until is not None:
                yield rule.until
        for phase in self.phases.values():
            if phase.until is not None:
                yield phase.until

    @property
    def read_names(self) -> frozenset[str]:
        """The names (snapshot.NAMES) of the values that the plan's expressions read."""
        needs = [role.needs for role in self.roles.values() if role.needs is not None]
        used = [*needs, *(condition.expression for condition in self.conditions)]
        return frozenset(name for expression in used for name in expression.names)

    def is_car(self, who: str) -> bool:
        """Return True if this name in an effect is the name of a car."""
        return who not in RESERVED and who not in self.roles

    def may(self, car: str, role: Role) -> bool:
        """Return True if the plan lets this car have this role."""
        if car in self.fixed:
            return self.fixed[car] == role.name
        return role.cars is None or car in role.cars


def version_of(text: str) -> str:
    """Return the version of the plan with this text."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]

"""A plan as values: roles for cars, rules that change them, phases that follow each other. Pure.

It is read from a text in reader.py; what can never work in it, check.py finds; what follows from it is decide.py's.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from fleet.conditions import Expression
from gateway.protocol.enums import Mode

THAT: Final = "that"
OTHERS: Final = "others"
ALL: Final = "all"
RESERVED: Final = frozenset({THAT, OTHERS, ALL, "any"})
"""Words of rules, so no names of cars, roles or phases."""


class Quantifier(StrEnum):
    """Of which cars a condition must be so."""

    ANY = "any"
    ALL = "all"
    CAR = "car"


@dataclass(frozen=True, slots=True)
class PlanCondition:
    """An expression, of which cars it must be so, and for how long without a break, s."""

    of: Quantifier
    expression: Expression
    car: str | None = None
    """With Of.CAR."""
    role: str | None = None
    """Only of the cars that have this role."""
    for_s: float = 0.0
    text: str = field(init=False, compare=False)
    """As it is told."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", self._text())  # asked for ten times a second, for each car

    def _text(self) -> str:
        who = self.car if self.of is Quantifier.CAR else f"{self.of} {f'with role {self.role}' if self.role else 'car'}"
        lasting = f" for {self.for_s:g} s" if self.for_s else ""
        return f"{who}: {self.expression}{lasting}"


@dataclass(frozen=True, slots=True)
class Role:
    """What some cars should do, and which may."""

    name: str
    mode: Mode
    needs: Expression | None = None
    count: int | None = 1
    """How many cars; None: any number."""
    priority: int = 0
    cars: tuple[str, ...] | None = None
    """The only ones that may have it, best first; None: any."""
    capabilities: frozenset[str] = frozenset()
    platforms: tuple[str, ...] | None = None
    fallback: str | None = None
    on_call: bool = False
    needs_text: str = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "needs_text", "" if self.needs is None else str(self.needs))


@dataclass(frozen=True, slots=True)
class Effect:
    """What a rule does to whom (that, others, all, a car, a role); or the phase that it begins."""

    who: str = ""
    role: str | None = None
    mode: Mode | None = None
    led: tuple[int, int, int] | None = None
    phase: str | None = None


@dataclass(frozen=True, slots=True)
class Rule:
    """While `when` is so, or once it was and `until` is not, its effects count."""

    name: str
    when: PlanCondition
    effects: tuple[Effect, ...]
    until: PlanCondition | None = None
    during: frozenset[str] | None = None


@dataclass(frozen=True, slots=True)
class PlanPhase:
    """A part of the job."""

    name: str
    roles: frozenset[str] | None = None
    """Those that count; None: all."""
    until: PlanCondition | None = None
    timeout_s: float | None = None
    next: str | None = None
    on_timeout: str | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """What the coordinator keeps true. Of several rules for one car the first that is true counts."""

    roles: Mapping[str, Role]
    fixed: Mapping[str, str]
    """Cars that may have one role only."""
    rules: tuple[Rule, ...]
    phases: Mapping[str, PlanPhase]
    idle: Mode | None
    """The mode of a car without a role; None: it is left alone."""
    text: str

    @property
    def version(self) -> str:
        """The same for the same text."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]

    @property
    def first(self) -> str:
        """The phase that begins; empty if there are none."""
        return next(iter(self.phases), "")

    @property
    def open(self) -> bool:
        """Whether cars that it does not name may be given something."""
        if any(role.cars is None for role in self.roles.values()):
            return True
        return any(effect.who in (THAT, OTHERS, ALL) for rule in self.rules for effect in rule.effects)

    @property
    def named(self) -> tuple[str, ...]:
        """The cars that it names to do something."""
        targets = (effect.who for rule in self.rules for effect in rule.effects)
        cars = [*self.fixed, *(car for role in self.roles.values() for car in role.cars or ())]
        return tuple(dict.fromkeys([*cars, *(who for who in targets if who and self.is_car(who))]))

    @property
    def conditions(self) -> Iterable[PlanCondition]:
        """Every condition in it."""
        for rule in self.rules:
            yield rule.when
            if rule.until is not None:
                yield rule.until
        for phase in self.phases.values():
            if phase.until is not None:
                yield phase.until

    @property
    def names(self) -> frozenset[str]:
        """What its expressions look at: names of picture.NAMES."""
        needs = [role.needs for role in self.roles.values() if role.needs is not None]
        used = [*needs, *(condition.expression for condition in self.conditions)]
        return frozenset(name for expression in used for name in expression.names)

    def is_car(self, who: str) -> bool:
        """Whether a name in an effect is a car's."""
        return who not in RESERVED and who not in self.roles

    def may(self, car: str, role: Role) -> bool:
        """Whether the plan lets this car have this role."""
        if car in self.fixed:
            return self.fixed[car] == role.name
        return role.cars is None or car in role.cars

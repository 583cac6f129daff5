"""The models of a plan's file: names, types and ranges of its fields. plan.py says what they mean. Pure."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from schemas import keys
from schemas.colors import COLOR_PATTERN, parse_color
from schemas.words import Mode
from schemas.yaml_document.document import Entry

_Name = Annotated[str, Field(description=keys.NAME_RULE)]
"""Only plan_parser.py checks names. If pydantic rejected a key, faults in the value under it would stay hidden."""
_Seconds = Annotated[float, Field(ge=0, le=86_400)]


def _check_color(text: str) -> str:
    parse_color(text)
    return text


_Color = Annotated[str, AfterValidator(_check_color), Field(json_schema_extra={"pattern": COLOR_PATTERN})]


class GivenBy(StrEnum):
    """Source of a role: the plan itself, or only its rules."""

    PLAN = "plan"
    RULES = "rules"


class WithoutRole(StrEnum):
    """Behavior of a car without a role."""

    MANUAL = "manual"
    LEAVE_ALONE = "leave_alone"


class ConditionEntry(Entry):
    """A condition, and the cars for which it must be true: exactly one of the fields any_car, all_cars and car."""

    any_car: str | None = Field(
        None, description="an expression that must be true for at least one car, such as light.left"
    )
    all_cars: str | None = Field(None, description="an expression that must be true for every car")
    car: _Name | None = Field(None, description="the car for which `is` must be true")
    is_: str | None = Field(None, alias="is", description="with `car`: an expression that must be true for this car")
    with_role: _Name | None = Field(None, description="with any_car or all_cars: look only at cars that have this role")
    for_s: _Seconds = Field(0.0, description="minimum time for which it must be true without a break, s")


Condition = str | ConditionEntry
"""A text alone is the expression of any_car."""


class BlinkEntry(Entry):
    """A blinking LED."""

    color: _Color = Field(description='the color while the LED is on: red, or "#ff0000" in quotes')
    blink_s: float = Field(0.5, ge=0.5, le=60, description="how long the LED is on, and how long it is off then, s")


class EffectEntry(Entry):
    """An effect of a rule on some cars."""

    who: _Name | None = Field(
        None,
        description="the cars: this_car (for which the condition is true), other_cars, all_cars, or the name of a car "
        "or role",
    )
    role: _Name | None = Field(None, description="the role that these cars get")
    mode: Mode | None = Field(None, description="the mode that these cars get, whatever their roles say")
    led: _Color | BlinkEntry | None = Field(
        None,
        description='color of their color LEDs, set once: red, or "#ff0000"; or {color: red, blink_s: 0.5}, to blink',
    )
    phase: _Name | None = Field(None, description="the phase that begins; its effect has no other field")


class RuleEntry(Entry):
    """A rule: its effects (`then`) are in force while `when` is true. With `until`, they stay until `until` is true."""

    name: str = Field("", max_length=60, description="name of the rule, which `fleet why` shows")
    when: Condition = Field(
        description="the condition: an expression, which must be true for at least one car, or a Condition such as "
        "`{any_car: light.left, for_s: 1}`"
    )
    until: Condition | None = Field(None, description="the condition that ends the rule; left out: `when` ends it")
    then: EffectEntry | list[EffectEntry] = Field(
        description="the effect: `{who: this_car, role: rest}`, or a list of effects"
    )
    during: list[_Name] | None = Field(
        None, min_length=1, description="the phases in which the rule counts; left out: all"
    )


class FixedEntry(Entry):
    """The only role or the only mode that a certain car gets."""

    role: _Name | None = Field(None, description="a role of this plan")
    mode: Mode | None = Field(None, description="a mode, instead of a role")


class RoleEntry(Entry):
    """A role: a mode for some cars."""

    mode: Mode = Field(description=f"the mode of the cars with this role, one of {', '.join(Mode)}")
    needs: str | None = Field(None, description="an expression that must be true for a car to get this role")
    count: Annotated[int, Field(ge=1, le=1000)] | Literal["all"] = Field(
        1, description="how many cars get this role; all: as many as there are"
    )
    priority: int = Field(0, ge=-100, le=100, description="roles with a higher number are filled first")
    cars: list[_Name] | None = Field(
        None, min_length=1, description="the only cars that may have this role, the preferred one first"
    )
    capabilities: list[str] = Field(default=[], description="what a car must be able to do, such as arm")
    platforms: list[str] | None = Field(None, min_length=1, description="the only platforms that may have this role")
    if_none: _Name | None = Field(
        None, description="the fallback: another role, which gets one more car for each car that this role lacks"
    )
    given_by: GivenBy = Field(GivenBy.PLAN, description="plan: the best car gets the role; rules: only a rule gives it")


class PhaseEntry(Entry):
    """A part of the plan. It lasts until a condition is true or its time is over."""

    roles: list[_Name] | None = Field(None, description="the roles that are given in this phase; left out: all")
    until: Condition | None = Field(None, description="the condition that ends the phase; then `next` begins")
    timeout_s: float | None = Field(
        None,
        gt=0,
        le=86_400,
        description="maximum duration of the phase, counted from when its cars are in their modes, s",
    )
    next: _Name | None = Field(None, description="the phase that follows; required with `until`")
    on_timeout: _Name | None = Field(
        None, description="the phase that follows if timeout_s has passed; left out: `next`"
    )


class PlanEntry(Entry):
    """A plan: roles for cars, cars with a fixed role or mode, rules, and phases."""

    roles: dict[_Name, RoleEntry] = Field(default={}, description="the roles that the plan gives to cars")
    fixed: dict[_Name, FixedEntry] = Field(
        default={}, description="the only role or mode of certain cars, such as `blue: {mode: manual}`"
    )
    rules: list[RuleEntry] = Field(
        default=[],
        max_length=200,
        description="changes while a condition is true; if several apply to one car, the first one is used",
    )
    phases: dict[_Name, PhaseEntry] = Field(
        default={}, description="parts of the plan; the plan begins with the first one"
    )
    without_role: WithoutRole = Field(
        WithoutRole.MANUAL,
        description="manual: a car without a role goes to mode manual; leave_alone: it stays as it is",
    )

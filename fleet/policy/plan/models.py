"""The models of a plan's file: names, types and ranges of its fields. plan.py says what they mean. Pure."""

from typing import Annotated, Literal

from pydantic import Field

from gateway.protocol.enums import Mode
from schemas import keys
from schemas.yaml_document.document import Entry

_Name = Annotated[str, Field(description=keys.NAME_RULE)]
"""Only parser.py checks names. If pydantic refused a key, faults in its value would stay hidden."""
_Seconds = Annotated[float, Field(ge=0, le=86_400)]
_Byte = Annotated[int, Field(ge=0, le=255)]


class ConditionEntry(Entry):
    """A condition, and the cars of which it must be true: exactly one of any, all, car."""

    any: str | None = Field(None, description="an expression that must be true of at least one car: light.left")
    all: str | None = Field(None, description="an expression that must be true of every car")
    car: _Name | None = Field(None, description="the car of which `is` must be true")
    is_: str | None = Field(None, alias="is", description="an expression over the readings of `car`")
    role: _Name | None = Field(None, description="any, all: only of the cars that have this role")
    for_s: _Seconds = Field(0.0, description="minimum time without a break, s")


class EffectEntry(Entry):
    """An effect of a rule on some cars."""

    who: _Name | None = Field(None, description="that (the car that made the rule true), others, all, a car or a role")
    role: _Name | None = Field(None, description="the role that they take")
    mode: Mode | None = Field(None, description="the mode that they are in, whatever their role says")
    led: tuple[_Byte, _Byte, _Byte] | None = Field(None, description="the colour LED, set once: [r, g, b]")
    phase: _Name | None = Field(None, description="the phase that begins")


class RuleEntry(Entry):
    """Effects (`then`) that count while `when` is true; with `until`, from then on until that is true."""

    name: str = Field("", max_length=60, description="its name in explanations")
    when: ConditionEntry = Field(description="the condition, as `{any: light.left, for_s: 1}`")
    until: ConditionEntry | None = None
    then: EffectEntry | list[EffectEntry] = Field(description="what follows, as `{who: that, role: rest}`, or a list")
    during: list[_Name] | None = Field(None, description="the phases in which it counts; all, if left out")


class RoleEntry(Entry):
    """A mode for some cars."""

    mode: Mode = Field(description=f"the mode of a car that has it, one of {', '.join(Mode)}")
    needs: str | None = Field(None, description="an expression that must be true of a car that has it")
    count: Annotated[int, Field(ge=1, le=1000)] | Literal["all"] = Field(1, description="how many cars, or all")
    priority: int = Field(0, ge=-100, le=100, description="the higher is filled first")
    cars: list[_Name] | None = Field(None, min_length=1, description="the only cars that may have it, best first")
    capabilities: list[str] = Field(default=[], description="capabilities that a car must have")
    platforms: list[str] | None = Field(None, min_length=1, description="the platforms that may have it")
    fallback: _Name | None = Field(None, description="the role that gets a place for each that no car can take here")
    on_call: bool = Field(default=False, description="only a rule gives it to a car")


class PhaseEntry(Entry):
    """A part of the job: it lasts until a condition is true or its time is over."""

    roles: list[_Name] | None = Field(None, description="the roles that count; all, if left out")
    until: ConditionEntry | None = None
    timeout_s: float | None = Field(None, gt=0, le=86_400)
    next: _Name | None = Field(None, description="the phase after it")
    on_timeout: _Name | None = Field(None, description="the phase after it when its time is over (next, if left out)")


class PlanEntry(Entry):
    """A plan: cars with a fixed role or mode, roles, rules, phases (the first one begins)."""

    cars: dict[_Name, _Name] = Field(default={}, description="a role, or a mode, for a certain car: red: tracking")
    roles: dict[_Name, RoleEntry] = Field(default={}, description="the roles for cars, by name")
    rules: list[RuleEntry] = Field(default=[], max_length=200)
    phases: dict[_Name, PhaseEntry] = Field(default={}, description="parts of the job, the first one begins")
    idle: Literal["manual", "leave"] = Field(
        "manual", description="the mode of a car without a role: manual, or the mode it has (leave)"
    )

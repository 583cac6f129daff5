"""What may stand in a plan's file: names, types and ranges of its fields. What they mean is plan.py's. Pure."""

from typing import Annotated, Literal

from pydantic import Field

from gateway.protocol.enums import Mode
from schemas import keys
from schemas.yaml_document.document import Entry

_Name = Annotated[str, Field(description=keys.NAME_RULE)]
"""Checked by reader.py, which goes on with a name that is not allowed: a refused key would hide what it has."""
_Seconds = Annotated[float, Field(ge=0, le=86_400)]
_Byte = Annotated[int, Field(ge=0, le=255)]


class ConditionEntry(Entry):
    """What must be so, of which car: exactly one of any, all, car."""

    any: str | None = Field(None, description="an expression that must be so of one car at least: light.left")
    all: str | None = Field(None, description="an expression that must be so of every car")
    car: _Name | None = Field(None, description="the car of which `is` must be so")
    is_: str | None = Field(None, alias="is", description="an expression over the readings of `car`")
    role: _Name | None = Field(None, description="any, all: only of the cars that have this role")
    for_s: _Seconds = Field(0.0, description="s for which it must have been so without a break")


class EffectEntry(Entry):
    """What a rule does: to whom, and what."""

    who: _Name | None = Field(None, description="that (the car that made the rule true), others, all, a car or a role")
    role: _Name | None = Field(None, description="the role that they take")
    mode: Mode | None = Field(None, description="the mode that they are in, whatever their role says")
    led: tuple[_Byte, _Byte, _Byte] | None = Field(None, description="the colour LED, set once: [r, g, b]")
    phase: _Name | None = Field(None, description="the phase that begins")


class RuleEntry(Entry):
    """While `when` is so (or from then on until `until` is), `then`."""

    name: str = Field("", max_length=60, description="as it is called in explanations")
    when: ConditionEntry = Field(description="the condition, as `{any: light.left, for_s: 1}`")
    until: ConditionEntry | None = None
    then: EffectEntry | list[EffectEntry] = Field(description="what follows, as `{who: that, role: rest}`, or a list")
    during: list[_Name] | None = Field(None, description="the phases in which it counts; all, if left out")


class RoleEntry(Entry):
    """What some cars should do."""

    mode: Mode = Field(description=f"the mode of a car that has it, one of {', '.join(Mode)}")
    needs: str | None = Field(None, description="an expression that must be so of a car that has it")
    count: Annotated[int, Field(ge=1, le=1000)] | Literal["all"] = Field(1, description="how many cars, or all")
    priority: int = Field(0, ge=-100, le=100, description="the higher is filled first")
    cars: list[_Name] | None = Field(None, min_length=1, description="the only cars that may have it, best first")
    capabilities: list[str] = Field(
        default=[], description="what a car must be able to, as its gateway or fleet file says"
    )
    platforms: list[str] | None = Field(None, min_length=1, description="the platforms that may have it")
    fallback: _Name | None = Field(None, description="the role that gets a place for each that no car can take here")
    on_call: bool = Field(default=False, description="only a rule gives it to a car")


class PhaseEntry(Entry):
    """A part of the job: it lasts until a condition is so or its time is over."""

    roles: list[_Name] | None = Field(None, description="the roles that count; all, if left out")
    until: ConditionEntry | None = None
    timeout_s: float | None = Field(None, gt=0, le=86_400)
    next: _Name | None = Field(None, description="the phase after it")
    on_timeout: _Name | None = Field(None, description="the phase after it when its time is over (next, if left out)")


class PlanEntry(Entry):
    """A plan: cars with a fixed role or mode, roles, rules, phases (the first one begins)."""

    cars: dict[_Name, _Name] = Field(default={}, description="a role, or a mode, for a certain car: red: tracking")
    roles: dict[_Name, RoleEntry] = Field(default={}, description="what cars may be given to do, by name")
    rules: list[RuleEntry] = Field(default=[], max_length=200)
    phases: dict[_Name, PhaseEntry] = Field(default={}, description="parts of the job, the first one begins")
    idle: Literal["manual", "leave"] = Field(
        "manual", description="what a car without a role gets: mode manual, or nothing"
    )

"""What mode each car of a plan should be in now, and why. Pure and deterministic: time is an argument.

A car that is on hold, that someone else drives, or that cannot be reached is left alone, whatever the plan says.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from fleet.policy.plan import Condition, Plan
from gateway.protocol.values import Mode
from schemas import topics

CONTRADICTED: Final = "contradicted"
LOST: Final = "lost"


@dataclass(frozen=True, slots=True)
class Seen:
    """The fields of one reading that were measured, and when it came."""

    fields: Mapping[str, object]
    at: float


@dataclass(frozen=True, slots=True)
class CarPicture:
    """What is known of one car."""

    present: bool = False
    """Its gateway is on the bus."""
    mode: str = ""
    """The mode it was last asked for, as its gateway says; empty: not heard yet."""
    verdict: str = ""
    link: str = ""
    """As its gateway says; empty: not heard yet."""
    estopped_by: str | None = None
    held_by: str | None = None
    driven_by: str | None = None
    """Who holds a motion; a coordinator never does."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What the coordinator knows."""

    cars: Mapping[str, CarPicture] = field(default_factory=dict)
    readings: Mapping[tuple[str, str], Seen] = field(default_factory=dict)
    """By car and topic."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What is wanted of one car."""

    car: str
    mode: Mode | None
    """The mode it should be in; None: it is left alone."""
    cause: str
    """What decided; the same as long as the same thing decides."""
    why: str
    readings: tuple[str, ...]
    """Those that were used, key=value."""
    would_change: str
    ask: bool
    """The car is not as it should be: ask for the mode."""


@dataclass(frozen=True, slots=True)
class Decisions:
    """One for each car of the plan, and since when each rule's test has passed: give it to the next call."""

    decisions: tuple[Decision, ...]
    since: Mapping[int, float]


def decide(plan: Plan, picture: Picture, since: Mapping[int, float], now: float) -> Decisions:
    """Decide for every car of the plan; `since` is that of the last call, empty at the start."""
    passing = {
        index: since.get(index, now) for index, rule in enumerate(plan.rules) if _passes(rule.when, picture, now)
    }
    true = {index for index, began in passing.items() if now - began >= plan.rules[index].when.for_s}
    decisions = tuple(_of_car(car, plan, picture, true) for car in plan.cars)
    return Decisions(decisions, passing)


def _of_car(car: str, plan: Plan, picture: Picture, true: set[int]) -> Decision:
    known = picture.cars.get(car, CarPicture())
    alone = _left_alone(car, known)
    if alone is not None:
        return alone
    rules = [index for index, rule in enumerate(plan.rules) if rule.car == car]
    for index in rules:
        if index in true:
            rule = plan.rules[index]
            used = (f"{rule.when.car}/{rule.when.reading} {rule.when.field}={_value(rule.when, picture)}",)
            why, change = f"rule {index + 1}: {rule.when}", "that no longer being so, or its reading growing old"
            return _wanted(car, rule.mode, f"rule {index + 1}", why, used, change, known)
    change = "; ".join(str(plan.rules[index].when) for index in rules) or "nothing but a hold"
    return _wanted(car, plan.cars[car], "plan", "the plan", (), change, known)


def _wanted(
    car: str, mode: Mode, cause: str, why: str, used: tuple[str, ...], change: str, known: CarPicture
) -> Decision:
    ask = known.mode != mode or known.verdict == CONTRADICTED
    return Decision(car, mode, cause, why, used, change, ask)


def _left_alone(car: str, known: CarPicture) -> Decision | None:
    if not known.present:
        why, change = f"{car} is not on the bus", "its gateway coming up"
    elif not known.mode:  # so it is not known either whether there is a hold
        why, change = f"{car} has not said yet how it is", "its first states"
    elif known.estopped_by is not None:
        why, change = f"{car} is e-stopped by {known.estopped_by}", "a resume by a person or script"
    elif known.held_by is not None:
        why, change = f"{car} is on hold by {known.held_by}", "a drive, mode or resume by a person or script"
    elif known.driven_by is not None:
        why, change = f"{car} is driven by {known.driven_by}", "the end of that drive"
    elif known.link == LOST:
        why, change = f"the link of {car} is lost", "its return"
    else:
        return None
    return Decision(car, None, why, why, (), change, ask=False)


def _passes(when: Condition, picture: Picture, now: float) -> bool:
    """Whether the field was measured, is fresh, and passes; a field that is not there passes nothing."""
    seen = picture.readings.get((when.car, when.reading))
    if seen is None or when.field not in seen.fields:
        return False
    stale_after_s = topics.TOPICS[when.reading].stale_after_s
    if stale_after_s is not None and now - seen.at > stale_after_s:
        return False
    return when.holds(seen.fields[when.field])


def _value(when: Condition, picture: Picture) -> object:
    value = picture.readings[when.car, when.reading].fields[when.field]
    return f"{value:.4g}" if isinstance(value, float) else value

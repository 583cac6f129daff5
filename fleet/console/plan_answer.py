"""The answer to a page about a plan written there: its faults, its roles, what it changes, and a dry run. Pure.

The dry run is the first decision that the coordinator's own code would make, for the cars as the console knows them.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from msgspec import Struct, field

from fleet.coordinator.observer import FleetObserver
from fleet.policy.lint.lint import PlanFault, find_faults
from fleet.policy.plan.plan import Plan
from fleet.policy.plan.plan_model import PlanEntry
from fleet.policy.plan.plan_parser import BadPlan, parse, parse_entry
from fleet.policy.plan_changes import plan_changes
from fleet.policy.snapshot import CarSnapshot
from fleet.policy.trial import PlanInForce, Trial, try_plan
from schemas.bus import Sample

MAX_TOLD: Final = 100
"""Maximum number of changes, of cars, and of roles without a car in an answer. A page shows no more."""
MAX_TOLD_CHARACTERS: Final = 500
"""Maximum length of one text. A plan with 300 roles gives a reason of 30,000 characters for one idle car."""


class PlanQuestion(Struct, frozen=True):
    """A plan to check, and what the console knows of the fleet. Ages and times: s."""

    text: str
    present: tuple[str, ...] = ()
    """The cars whose gateways are on the bus."""
    samples: tuple[tuple[float, Sample], ...] = ()
    """The newest messages of the cars, each with its age."""
    before: str = ""
    """The plan in force. Empty if none runs."""
    roles: Mapping[str, str] = field(default_factory=dict)
    """The role of each car under the plan in force."""
    phase: str = ""


def answer_to(question: PlanQuestion, listed: Mapping[str, CarSnapshot]) -> dict[str, Any]:
    """Return faults, roles, changes and dry run as JSON values. `listed` has the cars in the fleet file, if any."""
    try:
        entry, plan = parse_entry(question.text)
    except BadPlan as error:
        return {"ok": False, "words": str(error)}
    faults = find_faults(plan, listed or None, question.present)
    found: dict[str, Any] = {
        "ok": not faults.errors,
        "words": _lines(faults.errors),
        "warnings": _lines(faults.warnings),
        "roles": _roles(entry),
    }
    if faults.errors:
        return found
    before = _parsed(question.before)
    in_force = None if before is None else PlanInForce(before, question.roles, question.phase)
    tried = try_plan(plan, _observed(question, listed).snapshot(()), in_force, 0.0)
    return found | {"changes": None if before is None else _changes(before, plan)} | _told(tried)


def _parsed(text: str) -> Plan | None:
    try:
        return parse(text) if text else None
    except BadPlan:  # a plan of a coordinator of another version
        return None


def _observed(question: PlanQuestion, listed: Mapping[str, CarSnapshot]) -> FleetObserver:
    observer = FleetObserver(listed)
    for car in question.present:
        observer.on_token(car, 0.0, alive=True)
    for age_s, sample in question.samples:
        observer.on_sample(sample, -age_s, None)
    return observer


def _lines(faults: Iterable[PlanFault]) -> str:
    return "\n".join(each.at("plan") for each in list(faults)[:MAX_TOLD])


def _roles(entry: PlanEntry) -> list[list[Any]]:
    """Return the name and the written fields of each role.

    A form shows some of the fields, and leaves the rest as they are.
    """
    return [
        [name, each.model_dump(mode="json", by_alias=True, exclude_unset=True)] for name, each in entry.roles.items()
    ]


def _changes(before: Plan, after: Plan) -> list[dict[str, Any]]:
    return [
        {
            "part": each.part,
            "added": not each.before,
            "removed": not each.after,
            "fields": [[_short(words) for words in change] for change in each.fields],
        }
        for each in plan_changes(before, after)[:MAX_TOLD]
    ]


def _told(tried: Trial) -> dict[str, Any]:
    return {
        "cars": [
            {
                "car": each.car,
                "role_before": each.role_before,
                "role": each.role,
                "mode_before": each.mode_before,
                "decided": str(each.decision.decided),
                "changed": each.is_changed,
                "why": _short(each.decision.why),
            }
            for each in tried.cars[:MAX_TOLD]
        ],
        "lacking": [
            {"role": each.role, "decided": each.decided, "why": _short(each.why)} for each in tried.places[:MAX_TOLD]
        ],
    }


def _short(words: str) -> str:
    return words if len(words) <= MAX_TOLD_CHARACTERS else f"{words[: MAX_TOLD_CHARACTERS - 1]}…"

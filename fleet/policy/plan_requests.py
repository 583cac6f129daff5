"""Requests of people for the plan in force: restart, next phase, stop. Pure; times in s."""

from enum import StrEnum
from typing import Final

from msgspec.structs import replace

from fleet.policy.denial_words import fleet_refusal
from fleet.policy.phases import PhaseState
from fleet.policy.plan.plan import Plan
from fleet.policy.state import PolicyState
from schemas import keys
from schemas.rights import People
from schemas.words import Reason

HOW_TO_RUN_AGAIN: Final = "`fleet plan restart` or `fleet plan set` runs a plan again"


class PlanRequest(StrEnum):
    """A request for the plan in force. Its value is the last part of the key of the request."""

    RESTART = "restart"
    NEXT = "next"
    STOP = "stop"


EVENTS: Final = {
    PlanRequest.RESTART: ("plan_restarted", "restarted the plan"),
    PlanRequest.NEXT: ("plan_next", "went on to the next phase"),
    PlanRequest.STOP: ("plan_stopped", "stopped the plan"),
}
"""Code and words of the event for each request. The sender comes before the words."""


class RequestRefused(Exception):
    """The request cannot be carried out. The text says why, and ends with the reason's code in brackets."""

    def __init__(self, words: str, reason: Reason = Reason.UNSUPPORTED) -> None:
        super().__init__(f"{words} [{reason}]")
        self.reason: Final = reason


def check_sender(people: People, by: str) -> None:
    """Raise RequestRefused if the sender `by` may not set, restart or stop the plan, or end its phase.

    The supervisor may do so, because it sets the plan of the fleet file.
    """
    words = "" if by == keys.SUPERVISOR else fleet_refusal(people, keys.person_of(by))
    if words:
        raise RequestRefused(f"{words} Say who you are with `--as NAME` or FLEET_AS.", Reason.NOT_ALLOWED)


def on_request(request: PlanRequest, plan: Plan, memory: PolicyState, by: str, now: float) -> tuple[PolicyState, str]:
    """Return the state after the request of the sender `by`, and a text about it. Raises RequestRefused."""
    match request:
        case PlanRequest.RESTART:
            begins = f" with phase {plan.first_phase}" if plan.first_phase else ""
            return PolicyState(started_at=memory.started_at), f"plan {plan.version} starts again{begins}"
        case PlanRequest.NEXT:
            name = _next_phase(plan, memory)
            phase = PhaseState(name, now, why=f"{keys.name_of(by)} went on to it from {memory.phase.name}")
            return replace(memory, phase=phase), f"phase {memory.phase.name} is over. The next phase: {name}"
        case PlanRequest.STOP:
            return _stop(memory, by)


def _next_phase(plan: Plan, memory: PolicyState) -> str:
    if memory.stopped_by:
        raise RequestRefused(f"The plan is stopped (by {keys.name_of(memory.stopped_by)}): {HOW_TO_RUN_AGAIN}.")
    if not plan.phases:
        raise RequestRefused("The plan has no phases.")
    phase = plan.phases.get(memory.phase.name)
    if phase is None:
        raise RequestRefused("No phase has begun yet. Try again.")
    name = phase.next or phase.on_timeout
    if name is None:
        raise RequestRefused(
            f"Phase {phase.name} is the last one: `next` names none after it. "
            f"`fleet plan restart` begins with {plan.first_phase}."
        )
    return name


def _stop(memory: PolicyState, by: str) -> tuple[PolicyState, str]:
    """Release all cars. The cars that the plan commands are first brought to rest, without a hold."""
    if memory.stopped_by:
        return memory, f"the plan is stopped already (by {keys.name_of(memory.stopped_by)}): {HOW_TO_RUN_AGAIN}"
    commanded = {each.car for each in memory.decisions.values() if each.car is not None and each.mode is not None}
    cars = sorted(commanded | memory.held_roles.keys())
    stopped = PolicyState(started_at=memory.started_at, stopped_by=by, to_rest=frozenset(cars))
    rest = f"{', '.join(cars)} brought to rest" if cars else "it commanded no car"
    return stopped, f"the plan is stopped: {rest}. {HOW_TO_RUN_AGAIN}"

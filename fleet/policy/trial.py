"""A dry run: the first decisions that a plan would make for the cars as they are now. Pure: nothing is commanded."""

from collections.abc import Mapping

from msgspec import Struct

from fleet.policy.decide import FIRST_STATE_TIMEOUT_S, step
from fleet.policy.decision import Decision, DecisionKind
from fleet.policy.phases import PhaseState
from fleet.policy.plan.plan import Plan
from fleet.policy.snapshot import UNKNOWN_CAR, FleetSnapshot
from fleet.policy.state import HeldRole, PolicyState, carry_over


class PlanInForce(Struct, frozen=True):
    """The state of the coordinator now: its plan, the role of each car, and its phase."""

    plan: Plan
    roles: Mapping[str, str]
    phase: str = ""


class CarTrial(Struct, frozen=True):
    """The first decision of a plan about one car, with the car's state before."""

    car: str
    role_before: str
    """Empty if the car has no role."""
    role: str
    mode_before: str
    """Empty if the mode is not known."""
    decision: Decision

    @property
    def is_changed(self) -> bool:
        """True if the car would get another role, or a mode that it is not in."""
        mode = self.decision.mode
        if mode is None:  # the car is left alone
            return False
        return self.role != self.role_before or mode != self.mode_before


class Trial(Struct, frozen=True):
    """The first decisions of a plan."""

    cars: tuple[CarTrial, ...]
    places: tuple[Decision, ...]
    """Roles that would lack cars, each with the reason."""


def try_plan(plan: Plan, snapshot: FleetSnapshot, in_force: PlanInForce | None, now: float) -> Trial:
    """Return the first decisions of this plan for these cars. The durations of conditions are counted from now.

    `in_force` is None if no plan runs. Roles and the phase remain if both plans have them, as with `fleet plan set`.
    """
    # The states of all cars that publish them are already known, so there is nothing to wait for.
    begun = now - FIRST_STATE_TIMEOUT_S
    memory = PolicyState(started_at=begun)
    if in_force is not None:
        held = {car: HeldRole(role) for car, role in in_force.roles.items() if role in in_force.plan.roles}
        phase = PhaseState(in_force.phase, begun) if in_force.phase in in_force.plan.phases else PhaseState()
        memory = carry_over(PolicyState(started_at=begun, held_roles=held, phase=phase), in_force.plan, plan)
    decided = step(plan, snapshot, memory, now)
    # The coordinator also publishes the cars that have no role. Leave them out.
    own = () if in_force is None else in_force.roles.items()
    roles_before = {car: role for car, role in own if in_force is not None and role in in_force.plan.roles}
    cars = tuple(
        CarTrial(
            each.subject,
            roles_before.get(each.subject, ""),
            decided.roles.get(each.subject, ""),
            snapshot.cars.get(each.subject, UNKNOWN_CAR).mode,
            each,
        )
        for each in decided.decisions
        if each.kind in _OF_CARS
    )
    return Trial(cars, tuple(each for each in decided.decisions if each.kind is DecisionKind.VACANT))


_OF_CARS = frozenset({DecisionKind.ROLE, DecisionKind.RULE, DecisionKind.IDLE, DecisionKind.ALONE})

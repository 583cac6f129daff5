"""Why a plan leaves a car alone: a person has it, it is stopped, out of reach, or not in a known state. Pure."""

from fleet.policy.role_allocation import Barrier
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, FleetSnapshot
from schemas.keys import name_of
from schemas.words import LinkState, Motors, Verdict


def find_barriers(subjects: tuple[str, ...], snapshot: FleetSnapshot) -> dict[str, Barrier]:
    """Return the cars that are left alone, and why."""
    found = {car: _find_barrier(car, snapshot.cars.get(car, UNKNOWN_CAR)) for car in subjects}
    return {car: barrier for car, barrier in found.items() if barrier is not None}


def _find_barrier(car: str, known: CarSnapshot) -> Barrier | None:
    """Return why the car is left alone. None if it is not."""
    if not known.present:
        return Barrier(f"{car} is not on the bus", "its gateway comes up")
    if not known.mode:  # without a state, a hold is not known either
        return Barrier(f"{car} has published no state yet", "its gateway publishes its first states")
    if known.estopped_by is not None:
        return Barrier(
            f"{car} is e-stopped by {name_of(known.estopped_by)}",
            f"a person or script ends it (`fleet resume {car} --estops`)",
            ends_role=True,
        )
    if known.paused_by is not None:
        return Barrier(
            f"{car} is paused with the whole fleet by {name_of(known.paused_by)}",
            "somebody ends it (`fleet unpause`)",
            ends_role=True,
        )
    if known.lent_to is not None:
        return Barrier(f"{car} is lent to {known.lent_to}", f"the loan ends (`fleet lend {car} --end`)", ends_role=True)
    if known.held_by is not None:
        return Barrier(
            f"{car} is on hold by {name_of(known.held_by)}",
            f"a person or script drives it, gives it a mode, or resumes it (`fleet resume {car}`)",
            ends_role=True,
        )
    if known.driven_by is not None:
        return Barrier(f"{car} is driven by {name_of(known.driven_by)}", "that drive ends")
    if known.link == LinkState.LOST:
        return Barrier(f"the link of {car} is lost", "its link is back")
    if known.doubted:  # people may command the car, because they see what it does
        ends = (
            f"it shows a stop (`fleet stop {car}`), or a person who has looked at it resumes it (`fleet resume {car}`)"
        )
        return Barrier(f"{car} is in doubt: it has not shown its last stop", ends)
    if is_recovering(known):
        return Barrier(f"{car} is not in a known state yet", "its recovery ends: a reading comes from it")
    return None


def has_no_state(known: CarSnapshot) -> bool:
    """Return True if the first states of a car on the bus are still missing."""
    return known.present and not known.mode


def is_recovering(known: CarSnapshot) -> bool:
    """Return True if the gateway is still bringing the car to a known state."""
    return known.motors == Motors.UNKNOWN and known.verdict != Verdict.CONTRADICTED

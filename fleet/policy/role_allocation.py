"""Gives open roles to cars. Pure; times in s.

What counts, the most important first: filled places, above all those of high priority; cars that keep their roles; few
changes of mode; the order in the plan. Within one priority, the places of a role with a number come before the places
of a role for all cars.
"""

from collections.abc import Container, Mapping
from typing import Final, NamedTuple

from msgspec import Struct

from fleet.conditions import Expression
from fleet.policy.debounce import HYSTERESIS_S, Settled, settle
from fleet.policy.min_cost_matching import assign
from fleet.policy.plan.plan import Plan, Role
from fleet.policy.snapshot import UNKNOWN_CAR, CarSnapshot, FleetSnapshot
from schemas.platform_name import kind_of
from schemas.words import LinkState, Reason

ROLE_KEPT_S: Final = HYSTERESIS_S
"""Time for which a car that cannot be reached keeps its role. Then another car gets the role."""
REFUSED_MODE_RETRY_S: Final = 10.0
"""Delay before the next request of a mode that a car refused."""
_REFUSALS: Final = frozenset({Reason.BATTERY_LOW, Reason.UNSUPPORTED, Reason.LINK_DOWN, Reason.WRITE_FAILED})
"""Reasons of a refusal that lie with the car itself. Holds and leases are left out, because the car's states show
them."""
_STAND_IN: Final = "/"
"""Suffix of a role's name. It marks the places of the role that stand in for another role."""
_ROLE_LOSS_COST: Final = 1_000_000_000
_MODE_CHANGE_COST: Final = 1_000_000
_LINK_DOUBT_COST: Final = 10_000
"""For one car, each of these costs is higher than all lower ones together."""


class Barrier(Struct, frozen=True):
    """Reason why a car may not do something, and what would change that."""

    why: str
    change: str
    looks_at: Expression | None = None
    """The expression from which the barrier follows."""
    ends_role: bool = False
    """True if a person has taken the car for a longer time, so that the car loses its role at once."""


def reserved_roles(roles: Mapping[str, str], barriers: Mapping[str, Barrier], lately: Container[str]) -> dict[str, str]:
    """Return the role of each car that cannot be commanded and still keeps it.

    `roles` are those before this step, and `lately` the cars whose barrier began within ROLE_KEPT_S.
    """
    return {
        car: roles[car] for car, barrier in barriers.items() if not barrier.ends_role and car in roles and car in lately
    }


class PinnedRole(NamedTuple):
    """The only role that a rule in force lets a car have."""

    role: str
    rule: str


class Candidates(Struct, frozen=True):
    """The cars that may get roles, and everything that decides which car may have which role."""

    plan: Plan
    snapshot: FleetSnapshot
    free: tuple[str, ...]
    reserved: Mapping[str, str]
    """Cars that cannot be commanded for a moment, each with the role that is reserved for it."""
    roles_before: Mapping[str, str]
    """The role of each car before this step."""
    failed_modes: Container[tuple[str, str]]
    """Cars and the modes that they have lately failed to change to (`state.note_failures`)."""
    pinned: Mapping[str, PinnedRole]
    """The roles that rules pin, by car."""
    in_force: frozenset[str]
    """The roles that count in this phase."""
    needs: Mapping[tuple[str, str], Settled]
    now: float

    def readings_of(self, car: str, barrier: Barrier | None) -> tuple[str, ...]:
        """Return the readings from which a barrier follows."""
        if barrier is None or barrier.looks_at is None:
            return ()
        return self.snapshot.describe_readings(barrier.looks_at, car, self.now)

    def barrier(self, car: str, role: Role) -> Barrier | None:
        """Return why this car may not have this role, or None if it may."""
        name = role.name
        pinned = self.pinned.get(car)
        if pinned is not None and pinned.role != name:
            return Barrier(f"{pinned.rule} lets it have only role {pinned.role}", f"{pinned.rule} ends")
        if not self.plan.may(car, role):
            return Barrier("the plan does not give it to this car", "another plan is put in force")
        if role.by_rules and pinned is None and not any(name == other.if_none for other in self.plan.roles.values()):
            return Barrier("only a rule gives it", "a rule gives it to the car")
        known = self.snapshot.cars.get(car, UNKNOWN_CAR)
        return find_barrier(known, role, self.now) or self._needy(car, role, known)

    def has_failed(self, car: str, role: Role) -> bool:
        """Return True if the car has lately failed to change to the mode of the role, and is not in it now."""
        known = self.snapshot.cars.get(car, UNKNOWN_CAR)
        return (car, role.mode) in self.failed_modes and not known.is_in_mode(role.mode)

    def _needy(self, car: str, role: Role, known: CarSnapshot) -> Barrier | None:
        if role.needs is None:
            return None
        settled = self.needs.get((car, role.name))
        if settled is not None and settled.value:
            return None
        if settled is not None:
            return Barrier(f"it needs {role.needs_text}", f"{role.needs_text} becomes true", role.needs)
        # In most modes, a car measures little. So a car that is already in the role's mode keeps the role, although
        # nobody knows whether the car meets the role's needs.
        if self.roles_before.get(car) == role.name or (car not in self.roles_before and known.mode == role.mode):
            return None
        why, change = f"it needs {role.needs_text}, and that is not known", f"{role.needs_text} is measured"
        return Barrier(why, change, role.needs)


def find_barrier(known: CarSnapshot, role: Role, now: float) -> Barrier | None:
    """Return the barrier between a car and a role, as far as it does not depend on readings. None if there is none."""
    if known.roles is not None and role.name not in known.roles:
        return Barrier("the fleet file does not let it take this role", "the fleet file lets it")
    profile = known.profile
    if profile is not None and role.mode not in profile.modes:
        knows = ", ".join(sorted(profile.modes))
        return Barrier(
            f"{known.platform} cars do not know mode {role.mode}; they know {knows}", "the car has another platform"
        )
    if known.listed and role.mode not in known.capabilities:
        return Barrier(f"the fleet file does not let it do mode {role.mode}", "the fleet file lets it")
    if role.platforms is not None and (
        profile is None or not {kind_of(profile.name), profile.name} & set(role.platforms)
    ):
        return Barrier(
            f"it wants platform {' or '.join(role.platforms)}, this is {known.platform or 'not known'}",
            "the car has such a platform",
        )
    missing = sorted(role.capabilities - known.capabilities)
    if missing:
        return Barrier(f"it cannot {', '.join(missing)}", "it becomes able to")
    refused = known.refusal_of(role.mode)
    if refused is not None and refused.reason in _REFUSALS and now - refused.at < REFUSED_MODE_RETRY_S:
        return Barrier(
            f"it refused mode {refused.mode}: {refused.reason}: {refused.words}",
            "it accepts the mode at the next request, after 10 s",
        )
    return None


class RoleAllocation(Struct, frozen=True):
    """The roles of the cars, and the number of places of each role."""

    roles: Mapping[str, str]
    places: Mapping[str, int]
    stands_in: Mapping[str, str]
    """Roles with extra places, each with the role that it stands in for."""

    def holders(self, role: str) -> list[str]:
        """Return the cars that have this role."""
        return [car for car, name in self.roles.items() if name == role]


def follow_needs(
    plan: Plan, snapshot: FleetSnapshot, cars: tuple[str, ...], before: Mapping[tuple[str, str], Settled], now: float
) -> dict[tuple[str, str], Settled]:
    """Evaluate the needs of each role for each car. For a value that is not measured now, use the last one."""
    result = {}
    values: dict[tuple[str, str], bool | None] = {}
    for role in plan.roles.values():
        if role.needs is None:
            continue
        for car in cars:
            if plan.may(car, role):
                key = role.needs_text, car  # several roles may have the same needs
                if key not in values:
                    values[key] = snapshot.holds(role.needs, car, now, old=True)
                settled = settle(before.get((car, role.name)), values[key], now)
                if settled is not None:
                    result[car, role.name] = settled
    return result


def allocate(candidates: Candidates) -> RoleAllocation:
    """Give the roles in force to cars.

    For each car that a role lacks, the role's fallback (`if_none`) gets one more place.
    """
    plan, cars = candidates.plan, (*candidates.free, *candidates.reserved)
    counts = {
        name: _count_places(candidates, plan.roles[name], len(cars))
        for name in plan.roles
        if name in candidates.in_force
    }
    costs = _costs(candidates)
    places, stands_in = dict(counts), dict[str, str]()
    # A fallback may lack cars, too, and may have a fallback of its own. So repeat until no places are added.
    while True:
        open_places = {name: min(places[name], counts.get(name, 0)) for name in plan.roles if name in places}
        open_places |= {
            f"{name}{_STAND_IN}": places[name] - count for name, count in open_places.items() if places[name] > count
        }
        roles = {car: place.removesuffix(_STAND_IN) for car, place in assign(costs, open_places).items()}
        wanted = dict(counts)
        for name in _fallback_order(plan):
            role = plan.roles[name]
            # A role for any number of cars lacks a car only if it has none.
            lacks = max(0, (1 if role.count is None else wanted.get(name, 0)) - list(roles.values()).count(name))
            if role.if_none is not None and name in wanted and lacks:
                wanted[role.if_none] = wanted.get(role.if_none, 0) + lacks
                stands_in[role.if_none] = name
        wanted = {name: max(count, places.get(name, 0)) for name, count in wanted.items()}
        if wanted == places:
            return RoleAllocation(
                roles, places, {name: of for name, of in stands_in.items() if places[name] > counts.get(name, 0)}
            )
        places = wanted


def _count_places(candidates: Candidates, role: Role, cars: int) -> int:
    count = cars if role.count is None else role.count
    if not role.by_rules:
        return count
    return min(count, sum(pinned.role == role.name for pinned in candidates.pinned.values()))


def _fallback_order(plan: Plan) -> list[str]:
    """Return the roles, sorted so that each comes before its fallback."""
    depth = dict.fromkeys(plan.roles, 0)
    for name in plan.roles:
        at, steps = name, 0
        while (after := plan.roles[at].if_none) is not None:
            at, steps = after, steps + 1
            depth[at] = max(depth[at], steps)
    return sorted(plan.roles, key=lambda name: depth[name])


def _rank(role: Role) -> tuple[int, bool, int]:
    return role.priority, role.count is not None, 0


def _stand_in_ranks(plan: Plan) -> dict[str, tuple[int, bool, int]]:
    """Rank the places of each fallback just below the role that it stands in for."""
    result: dict[str, tuple[int, bool, int]] = {}
    for name in _fallback_order(plan):
        after = plan.roles[name].if_none
        if after is not None:
            priority, _, depth = max(_rank(plan.roles[name]), result.get(name, _rank(plan.roles[name])))
            result[after] = max(result.get(after, (-1000, True, 0)), (priority, True, depth - 1))
    return result


def _costs(candidates: Candidates) -> dict[str, dict[str, int]]:
    """Return the cost of each car in each role that it may have."""
    plan = candidates.plan
    cars = sorted({*candidates.free, *candidates.reserved})
    stand_in_ranks = _stand_in_ranks(plan)
    all_ranks = sorted({*(_rank(role) for role in plan.roles.values()), *stand_in_ranks.values()})
    # One place of a higher rank is worth more than all places of lower ranks, and any place is worth more than
    # everything else.
    worth = {rank: (len(cars) + 1) ** (order + 1) * _ROLE_LOSS_COST * 10 for order, rank in enumerate(all_ranks)}
    result: dict[str, dict[str, int]] = {}
    for car in cars:
        row: dict[str, int] = {}
        known = candidates.snapshot.cars.get(car, UNKNOWN_CAR)
        for order, role in enumerate(plan.roles.values()):
            # Include roles without a place now: they get one if another role lacks a car. assign() looks at the places.
            reserved_role = candidates.reserved.get(car)
            if reserved_role is not None:
                pinned = candidates.pinned.get(car)
                if reserved_role != role.name or (pinned is not None and pinned.role != reserved_role):
                    continue
            elif candidates.barrier(car, role) is not None:
                continue
            cost = order - worth[_rank(role)]
            is_holder = candidates.roles_before.get(car) == role.name
            if role.count is not None and candidates.has_failed(car, role):
                # Of several cars that have failed, the holder stays. Otherwise they would take turns.
                cost += _ROLE_LOSS_COST - (2 * _MODE_CHANGE_COST if is_holder else 0)
            elif is_holder:
                # The loss of a role for all cars counts half, so that its holder may move to a role with a number.
                cost -= _ROLE_LOSS_COST if role.count is not None else _ROLE_LOSS_COST // 2
            if not known.is_in_mode(role.mode):
                cost += _MODE_CHANGE_COST
            if known.link not in (LinkState.ONLINE, LinkState.QUIET):
                cost += _LINK_DOUBT_COST
            if role.cars is not None and car in role.cars:
                cost += role.cars.index(car) * 10
            row[role.name] = cost
            if role.name in stand_in_ranks:
                row[f"{role.name}{_STAND_IN}"] = cost + worth[_rank(role)] - worth[stand_in_ranks[role.name]]
        result[car] = row
    return result

"""Which roles are open, who may take which, and who does. Pure; times in s.

To keep a place filled counts for most (of one priority the places that are counted, before those for all that are
left), then that nobody who has a role loses it, then that few cars change their mode, then the order in the plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from fleet.conditions import Expression
from fleet.policy.assignment import assign
from fleet.policy.debounce import Settled, settle
from fleet.policy.plan.plan import Plan, Role
from fleet.policy.snapshot import CONTRADICTED, NOBODY, CarSnapshot, FleetSnapshot

REFUSED_S: Final = 10.0
"""So long a car that refused a mode is not asked for it again."""
_REFUSALS: Final = frozenset({"battery_low", "unsupported", "link_down", "write_failed"})
"""Reasons that lie with the car; a hold or a lease its states tell."""
_SLOT: Final = "/"
"""At the end of a role's name: a place in it in place of another role's."""
_KEEP: Final = 1_000_000_000
_SWITCH: Final = 1_000_000
_DOUBT: Final = 10_000
"""Each worth more than all of the next together."""


@dataclass(frozen=True, slots=True)
class Barrier:
    """Why not, and what would change it."""

    why: str
    change: str
    looks_at: Expression | None = None
    """What it was seen by."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """The cars to be given roles, and what is known of each."""

    plan: Plan
    picture: FleetSnapshot
    free: tuple[str, ...]
    reserved: Mapping[str, str]
    """Cars that cannot be asked just now, and the role that is kept for each."""
    has: Mapping[str, str]
    """The role that each car has had."""
    in_vain: frozenset[str]
    """Cars that were asked for their mode more than once, and are not in it."""
    pinned: Mapping[str, tuple[str, str]]
    """The only role that a rule leaves a car, and the rule's name."""
    in_force: frozenset[str]
    needs: Mapping[tuple[str, str], Settled]
    now: float

    def seen(self, car: str, barrier: Barrier | None) -> tuple[str, ...]:
        """The readings that a barrier was seen by."""
        if barrier is None or barrier.looks_at is None:
            return ()
        return self.picture.used(barrier.looks_at, car, self.now)

    def barrier(self, car: str, role: Role) -> Barrier | None:
        """Why this car may not have this role."""
        name = role.name
        pinned = self.pinned.get(car)
        if pinned is not None and pinned[0] != name:
            return Barrier(f"{pinned[1]} leaves it {pinned[0]} only", f"the end of {pinned[1]}")
        if not self.plan.may(car, role):
            return Barrier("the plan does not give it to this car", "another plan")
        if role.on_call and pinned is None and not any(name == other.fallback for other in self.plan.roles.values()):
            return Barrier("only a rule gives it", "such a rule coming true")
        known = self.picture.cars.get(car, NOBODY)
        return unfit(known, role, self.now) or self._needy(car, role, known)

    def _needy(self, car: str, role: Role, known: CarSnapshot) -> Barrier | None:
        if role.needs is None:
            return None
        settled = self.needs.get((car, role.name))
        if settled is not None and settled.value:
            return None
        if settled is not None:
            return Barrier(f"it needs {role.needs_text}", role.needs_text, role.needs)
        # In most modes little is measured: what is in the role's mode already is not taken out of it to find out.
        if self.has.get(car) == role.name or (car not in self.has and known.mode == role.mode):
            return None
        why, change = f"it needs {role.needs_text}, and that is not known", f"{role.needs_text} being measured"
        return Barrier(why, change, role.needs)


def unfit(known: CarSnapshot, role: Role, now: float) -> Barrier | None:
    """What a car is, or has said, that keeps it from a role whatever its readings."""
    if known.roles is not None and role.name not in known.roles:
        return Barrier("the fleet file does not let it take this role", "the fleet file")
    profile = known.profile
    if profile is not None and role.mode not in profile.modes:
        knows = ", ".join(sorted(profile.modes))
        return Barrier(f"{known.platform} cars do not know mode {role.mode}; they know {knows}", "another car")
    if known.listed and role.mode not in known.capabilities:
        return Barrier(f"the fleet file does not let it do mode {role.mode}", "the fleet file")
    if role.platforms is not None and (profile is None or not {profile.kind, profile.name} & set(role.platforms)):
        return Barrier(
            f"it wants platform {' or '.join(role.platforms)}, this is {known.platform or 'not known'}", "another car"
        )
    missing = sorted(role.capabilities - known.capabilities)
    if missing:
        return Barrier(f"it cannot {', '.join(missing)}", "another car")
    refused = known.refused
    if (
        refused is not None
        and refused.mode == role.mode
        and refused.reason in _REFUSALS
        and now - refused.at < REFUSED_S
    ):
        return Barrier(f"it refused mode {refused.mode}: {refused.reason}: {refused.words}", "asking again after 10 s")
    return None


@dataclass(frozen=True, slots=True)
class RoleAllocation:
    """Who has which role, and the places that there are."""

    roles: Mapping[str, str]
    places: Mapping[str, int]
    stands_in: Mapping[str, str]
    """Roles that have more places than they want themselves, and for which role."""

    def holders(self, role: str) -> list[str]:
        """The cars that have it."""
        return [car for car, name in self.roles.items() if name == role]


def follow_needs(
    plan: Plan, picture: FleetSnapshot, cars: tuple[str, ...], before: Mapping[tuple[str, str], Settled], now: float
) -> dict[tuple[str, str], Settled]:
    """Whether each car has what each role needs; a value that nothing measures now counts as it was."""
    found = {}
    values: dict[tuple[str, str], bool | None] = {}
    for role in plan.roles.values():
        if role.needs is None:
            continue
        for car in cars:
            if plan.may(car, role):
                same = role.needs_text, car
                if same not in values:
                    values[same] = picture.holds(role.needs, car, now, old=True)
                so = values[same]
                settled = settle(before.get((car, role.name)), so, now)
                if settled is not None:
                    found[car, role.name] = settled
    return found


def fill(staff: Candidates) -> RoleAllocation:
    """Give the roles in force to cars; a role with a fallback that cannot be filled opens as many places there."""
    plan, cars = staff.plan, (*staff.free, *staff.reserved)
    wanted = {name: _wanted(staff, plan.roles[name], len(cars)) for name in plan.roles if name in staff.in_force}
    costs = _costs(staff)
    places, stands_in = dict(wanted), dict[str, str]()
    while True:
        open_ = {name: min(places[name], wanted.get(name, 0)) for name in plan.roles if name in places}
        open_ |= {f"{name}{_SLOT}": places[name] - count for name, count in open_.items() if places[name] > count}
        roles = {car: place.removesuffix(_SLOT) for car, place in assign(costs, open_).items()}
        more = dict(wanted)
        for name in _fallback_order(plan):
            role = plan.roles[name]
            # A role of any number of cars lacks one only when it has none.
            lacks = max(0, (1 if role.count is None else more.get(name, 0)) - list(roles.values()).count(name))
            if role.fallback is not None and name in more and lacks:
                more[role.fallback] = more.get(role.fallback, 0) + lacks
                stands_in[role.fallback] = name
        more = {name: max(count, places.get(name, 0)) for name, count in more.items()}
        if more == places:
            return RoleAllocation(
                roles, places, {name: of for name, of in stands_in.items() if places[name] > wanted.get(name, 0)}
            )
        places = more


def _wanted(staff: Candidates, role: Role, cars: int) -> int:
    count = cars if role.count is None else role.count
    if not role.on_call:
        return count
    return min(count, sum(name == role.name for name, _ in staff.pinned.values()))


def _fallback_order(plan: Plan) -> list[str]:
    """A role before the one that stands in for it."""
    depth = dict.fromkeys(plan.roles, 0)
    for name in plan.roles:
        at, steps = name, 0
        while (after := plan.roles[at].fallback) is not None:
            at, steps = after, steps + 1
            depth[at] = max(depth[at], steps)
    return sorted(plan.roles, key=lambda name: depth[name])


def _rank(role: Role) -> tuple[int, bool, int]:
    return role.priority, role.count is not None, 0


def _stand_in_ranks(plan: Plan) -> dict[str, tuple[int, bool, int]]:
    """A place in place of another is worth less than that one, and more than what is worth less than that one."""
    found: dict[str, tuple[int, bool, int]] = {}
    for name in _fallback_order(plan):
        after = plan.roles[name].fallback
        if after is not None:
            priority, _, depth = max(_rank(plan.roles[name]), found.get(name, _rank(plan.roles[name])))
            found[after] = max(found.get(after, (-1000, True, 0)), (priority, True, depth - 1))
    return found


def _costs(staff: Candidates) -> dict[str, dict[str, int]]:
    """What each car costs in each role that it may have."""
    plan = staff.plan
    cars = sorted({*staff.free, *staff.reserved})
    slots = _stand_in_ranks(plan)
    every = sorted({*(_rank(role) for role in plan.roles.values()), *slots.values()})
    ranks = {rank: order for order, rank in enumerate(every)}
    # One place of a higher rank is worth more than all of the lower ones, and any place more than all else.
    worth = {rank: (len(cars) + 1) ** (order + 1) * _KEEP * 10 for rank, order in ranks.items()}
    found: dict[str, dict[str, int]] = {}
    for car in cars:
        row: dict[str, int] = {}
        known = staff.picture.cars.get(car, NOBODY)
        for order, role in enumerate(plan.roles.values()):
            # Also a role that is open only if another lacks a car: assign() takes what has places.
            kept = staff.reserved.get(car)
            if kept is not None:
                pinned = staff.pinned.get(car)
                if kept != role.name or (pinned is not None and pinned[0] != kept):
                    continue
            elif staff.barrier(car, role) is not None:
                continue
            cost = order - worth[_rank(role)]
            if car in staff.in_vain and known.verdict == CONTRADICTED and role.count is not None:
                cost += _KEEP
            elif staff.has.get(car) == role.name:
                # Less for a place that any car has: it holds nobody back from taking over a counted one.
                cost -= _KEEP if role.count is not None else _KEEP // 2
            if known.mode != role.mode or known.verdict == CONTRADICTED:
                cost += _SWITCH
            if known.link != "online" and known.link != "quiet":
                cost += _DOUBT
            if role.cars is not None and car in role.cars:
                cost += role.cars.index(car) * 10
            row[role.name] = cost
            if role.name in slots:
                row[f"{role.name}{_SLOT}"] = cost + worth[_rank(role)] - worth[slots[role.name]]
        found[car] = row
    return found

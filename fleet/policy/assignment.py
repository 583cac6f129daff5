"""Which car gets which role at the least cost: the Hungarian method, a role's places counted instead of listed. Pure.

What a role on a car costs is staffing.py's; here only the sum is made the least.
"""

from collections import deque
from collections.abc import Mapping


def assign(costs: Mapping[str, Mapping[str, int]], places: Mapping[str, int]) -> dict[str, str]:
    """Each car's role: at most one a car, at most `places[role]` cars a role, the sum of costs the least.

    `costs[car][role]` is what it costs if the car has the role; below 0 it is worth it; 0 is having none. A role that
    the car may not have is left out. Of equal sums the order of cars and roles decides, so the same input gives the
    same answer.
    """
    matching = _Matching(costs, places)
    for car in costs:
        matching.insert(car)
    return {car: role for role in places for car in matching.members[role]}


class _Matching:
    """The best assignment of the cars so far; each insert finds the cheapest chain of moves that makes room."""

    def __init__(self, costs: Mapping[str, Mapping[str, int]], places: Mapping[str, int]) -> None:
        self._places = places
        self._costs = {
            car: {role: cost for role, cost in row.items() if places.get(role, 0) > 0} for car, row in costs.items()
        }
        self.members: dict[str, list[str]] = {role: [] for role in places}

    def insert(self, car: str) -> None:
        """Find the cheapest way to let this car in: Bellman-Ford over the roles, for some moves are worth something."""
        costs = self._costs[car]
        reached: dict[str | None, int] = {None: 0}
        reached.update(costs)
        via: dict[str | None, tuple[str, str]] = {}
        changed = deque(role for role in costs if self._full(role))
        while changed:
            role = changed.popleft()
            for mover in self.members[role]:
                row = self._costs[mover]
                left = reached[role] - row[role]
                for other, cost in (*row.items(), (None, 0)):
                    if other != role and (other not in reached or left + cost < reached[other]):
                        reached[other] = left + cost
                        via[other] = (role, mover)
                        if other is not None and self._full(other) and other not in changed:
                            changed.append(other)
        end = min((role for role in reached if role is None or not self._full(role)), key=lambda role: reached[role])
        while end in via:
            role, mover = via[end]
            self.members[role].remove(mover)
            if end is not None:
                self.members[end].append(mover)
            end = role
        if end is not None:
            self.members[end].append(car)

    def _full(self, role: str) -> bool:
        return len(self.members[role]) >= self._places[role]

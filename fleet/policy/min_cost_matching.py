"""Assigns cars to roles at the lowest total cost: the Hungarian method with several places per role. Pure.

role_allocation.py sets the costs.
"""

from collections import deque
from collections.abc import Mapping


def assign(costs: Mapping[str, Mapping[str, int]], places: Mapping[str, int]) -> dict[str, str]:
    """Return each car's role: at most one per car, at most `places[role]` cars per role, at the lowest total cost.

    `costs[car][role]` is the cost of the car in the role. A car without a role costs 0. `costs[car]` has only the roles
    that the car may have. If several results have the same total cost, the order of cars and roles decides, so the
    result is deterministic.
    """
    matching = _Matching(costs, places)
    for car in costs:
        matching.insert(car)
    return {car: role for role in places for car in matching.members[role]}


class _Matching:
    """The best assignment of the cars inserted so far."""

    def __init__(self, costs: Mapping[str, Mapping[str, int]], places: Mapping[str, int]) -> None:
        self._places = places
        self._costs = {
            car: {role: cost for role, cost in row.items() if places.get(role, 0) > 0} for car, row in costs.items()
        }
        self.members: dict[str, list[str]] = {role: [] for role in places}

    def insert(self, car: str) -> None:
        """Insert a car by the cheapest chain of moves that makes room for it."""
        # Bellman-Ford over the roles, as some moves have a negative cost.
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

"""The assignment has the minimum cost of all assignments."""

from itertools import product

from hypothesis import given
from hypothesis import strategies as st

from fleet.policy.min_cost_matching import assign

ROLES = ("a", "b", "c")


@st.composite
def problems(draw: st.DrawFn) -> tuple[dict[str, dict[str, int]], dict[str, int]]:
    cars = [f"car{number}" for number in range(draw(st.integers(0, 5)))]
    cost = st.integers(-20, 5)
    costs = {car: draw(st.dictionaries(st.sampled_from(ROLES), cost)) for car in cars}
    return costs, {role: draw(st.integers(0, 3)) for role in ROLES}


def _total(costs: dict[str, dict[str, int]], roles: dict[str, str]) -> int:
    return sum(costs[car][role] for car, role in roles.items())


@given(problems())
def test_no_assignment_costs_less(problem: tuple[dict[str, dict[str, int]], dict[str, int]]) -> None:
    costs, places = problem
    found = assign(costs, places)
    assert all(role in costs[car] for car, role in found.items())
    assert all(list(found.values()).count(role) <= places[role] for role in ROLES)
    least = 0
    for chosen in product(*([None, *costs[car]] for car in costs)):
        roles = {car: role for car, role in zip(costs, chosen, strict=True) if role is not None}
        if all(list(roles.values()).count(role) <= places[role] for role in ROLES):
            least = min(least, _total(costs, roles))
    assert _total(costs, found) == least
    assert found == assign(costs, places)


def test_car_makes_room_by_moving_others() -> None:
    costs = {"x": {"a": -10, "b": -9}, "y": {"a": -10}, "z": {"b": -9, "c": -8}}
    assert assign(costs, {"a": 1, "b": 1, "c": 1}) == {"y": "a", "x": "b", "z": "c"}


def test_role_that_is_worth_nothing_stays_empty() -> None:
    assert assign({"x": {"a": 3}}, {"a": 1}) == {}

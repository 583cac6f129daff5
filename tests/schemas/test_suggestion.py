"""Names near a word: real misspellings and beginnings, but no names with a vague similarity."""

import pytest

from schemas.suggestion import did_you_mean, misspelled, near_names
from schemas.words import Mode, Motion

CARS = ["red", "green", "blue"]


@pytest.mark.parametrize(
    ("wrong", "names", "near"),
    [
        ("rad", CARS, ["red"]),
        ("rde", CARS, ["red"]),
        ("Green", CARS, ["green"]),
        ("gren", CARS, ["green"]),
        ("yellow", CARS, []),
        ("purple", CARS, []),
        ("track", Mode, ["tracking"]),
        ("trakcing", Mode, ["tracking"]),
        ("parking", Mode, []),
        ("racing", Mode, ["tracking"]),
        ("avoid", Mode, ["obstacle_avoidance"]),
        ("tracking mode", Mode, ["tracking"]),
        ("foward", Motion, ["forward"]),
        ("upward", Motion, []),
        ("patrol", ["1-patrol"], ["1-patrol"]),
        ("x", ["a"], []),
        ("", ["a"], []),
    ],
)
def test_only_real_neighbors_are_near(wrong: str, names: list[str], near: list[str]) -> None:
    assert near_names(wrong, names) == near


def test_likeliest_name_comes_first() -> None:
    assert did_you_mean("rang", ["ranges", "range"], 2) == "Did you mean range or ranges?"


def test_beginning_is_no_misspelling() -> None:
    assert misspelled("other", ["other_cars"]) == []
    assert misspelled("other_car", ["other_cars"]) == ["other_cars"]

"""The use of cars that differ, on a whole link, in 200 episodes that never change. `make soak` plays 10,000."""

import pytest

from tests.fuzz.any_car import play

PARTS = 2
EPISODES = 100


@pytest.mark.parametrize("part", range(PARTS))
def test_random_cars_are_usable_whatever_they_show(part: int) -> None:
    uses = [play(seed) for seed in range(part * EPISODES, (part + 1) * EPISODES)]
    assert not [use for use in uses if use.violations]
    assert sum(len(use.commands) for use in uses) > 4 * EPISODES


@pytest.mark.parametrize("seed", [1356, 38195, 40198])
def test_usability_regression_seeds(seed: int) -> None:
    """Cars that report by a timer, and block. A recovery began in the block of the `MODE00` before it."""
    assert not play(seed).violations

"""The use of 10,000 cars that differ, on a whole link. `ANY_CAR=FROM:TO make soak` plays other seeds."""

import pytest

from tests.fuzz.any_car import play
from tests.support.soaks import play_all, seeds_from

SEEDS = seeds_from("ANY_CAR", "1000:11000")


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_cars_are_usable() -> None:
    bad = [use for use in play_all(play, SEEDS) if use.violations]
    print(f"{len(bad)} violations")
    assert not bad, "\n".join(f"seed {use.seed}: {use.violations} {use.car} {use.commands}" for use in bad[:10])

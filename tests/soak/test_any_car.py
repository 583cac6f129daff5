"""The use of 10,000 cars that differ, on a whole link. `ANY_CAR=FROM:TO make soak` plays other seeds."""

import os
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.fuzz.any_car import play

FIRST, BEHIND = (int(seed) for seed in os.environ.get("ANY_CAR", "1000:11000").split(":"))


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_cars_are_usable() -> None:
    with ProcessPoolExecutor(2) as pool:
        bad = [use for use in pool.map(play, range(FIRST, BEHIND), chunksize=50) if use.violations]
    print(f"\nseeds {FIRST} to {BEHIND - 1}: {len(bad)} violations")
    assert not bad, "\n".join(f"seed {use.seed}: {use.violations} {use.car} {use.commands}" for use in bad[:10])

"""The search for needless and missing decisions of a plan, over 10,000 fleets. `POLICY_SEARCH=FROM:TO` plays others."""

import os
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.fuzz.policy_search import play

FIRST, BEHIND = (int(seed) for seed in os.environ.get("POLICY_SEARCH", "1000:11000").split(":"))


def faults(seed: int) -> tuple[int, list[str]]:
    """Return the seed, and its faults."""
    return seed, play(seed).faults


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_fleets() -> None:
    with ProcessPoolExecutor(2) as pool:
        found = {seed: words for seed, words in pool.map(faults, range(FIRST, BEHIND), chunksize=50) if words}
    assert found == {}

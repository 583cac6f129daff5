"""The search for false, late and missing outcomes, with 10,000 cars. `OUTCOME_SEARCH=FROM:TO` plays other ones."""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.fuzz.outcome_search import play

FIRST, BEHIND = (int(seed) for seed in os.environ.get("OUTCOME_SEARCH", "1000:11000").split(":"))


def faults(seed: int) -> tuple[int, list[str], Counter[str]]:
    """Return the seed, its violations, and what was told."""
    told = play(seed)
    return seed, told.violations, told.outcomes


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_outcomes_of_ten_thousand_cars() -> None:
    outcomes: Counter[str] = Counter()
    found = {}
    with ProcessPoolExecutor(2) as pool:
        for seed, violations, told in pool.map(faults, range(FIRST, BEHIND), chunksize=50):
            outcomes += told
            if violations:
                found[seed] = violations
    print(f"\n{outcomes.total()} outcomes, seeds {FIRST} to {BEHIND - 1}")
    assert found == {}

"""The search for false, late and missing outcomes, with 10,000 cars. `OUTCOME_SEARCH=FROM:TO` plays other ones."""

from collections import Counter

import pytest

from tests.fuzz.outcome_search import play
from tests.support.soaks import play_all, seeds_from

SEEDS = seeds_from("OUTCOME_SEARCH", "1000:11000")


def faults(seed: int) -> tuple[int, list[str], Counter[str]]:
    """Return the seed, its violations, and what was told."""
    told = play(seed)
    return seed, told.violations, told.outcomes


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_outcomes_of_ten_thousand_cars() -> None:
    outcomes: Counter[str] = Counter()
    found = {}
    for seed, violations, told in play_all(faults, SEEDS):
        outcomes += told
        if violations:
            found[seed] = violations
    print(f"{outcomes.total()} outcomes")
    assert found == {}

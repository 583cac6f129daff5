"""The search for needless and missing decisions of a plan, over 10,000 fleets. `POLICY_SEARCH=FROM:TO` plays others."""

import pytest

from tests.fuzz.policy_search import play
from tests.support.soaks import play_all, seeds_from

SEEDS = seeds_from("POLICY_SEARCH", "1000:11000")


def faults(seed: int) -> tuple[int, list[str]]:
    """Return the seed, and its faults."""
    return seed, play(seed).faults


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_fleets() -> None:
    assert {seed: words for seed, words in play_all(faults, SEEDS) if words} == {}

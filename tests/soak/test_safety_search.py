"""The search for e-stops and pauses that are lost or come back, with 20,000 fleets.

`SAFETY_SEARCH=FROM:TO` plays other ones.
"""

from collections import Counter

import pytest

from tests.fuzz.safety_search import play
from tests.support.soaks import play_all, seeds_from

SEEDS = seeds_from("SAFETY_SEARCH", "1000:21000")


def faults(seed: int) -> tuple[int, list[str], Counter[str]]:
    """Return the seed, its violations, and how many e-stops and pauses were begun and ended."""
    episode = play(seed)
    counts = Counter({f"{kind}s begun": len(ids) for kind, ids in episode.begun.items()})
    counts += Counter({f"{kind}s ended": len(ids) for kind, ids in episode.ended.items()})
    return seed, episode.violations, counts


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_gateways_of_twenty_thousand_fleets_agree_in_the_end() -> None:
    counts: Counter[str] = Counter()
    found = {}
    for seed, violations, counted in play_all(faults, SEEDS):
        counts += counted
        if violations:
            found[seed] = violations
    print(dict(counts))
    assert found == {}

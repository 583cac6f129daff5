"""The search for e-stops and pauses that are lost or come back, with 20,000 fleets.

`SAFETY_SEARCH=FROM:TO` plays other ones.
"""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.fuzz.safety_search import play

FIRST, BEHIND = (int(seed) for seed in os.environ.get("SAFETY_SEARCH", "1000:21000").split(":"))


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
    with ProcessPoolExecutor(2) as pool:
        for seed, violations, counted in pool.map(faults, range(FIRST, BEHIND), chunksize=50):
            counts += counted
            if violations:
                found[seed] = violations
    print(f"\n{dict(counts)}, seeds {FIRST} to {BEHIND - 1}")
    assert found == {}

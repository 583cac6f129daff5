"""Twenty thousand episodes with cars of the second family. The seeds change each day; FUZZ_SEED repeats a run."""

import os
from datetime import UTC, datetime

import pytest

from tests.fuzz import ugv_search
from tests.support.soaks import play_all

SEED = int(os.environ.get("FUZZ_SEED", datetime.now(UTC).strftime("%Y%m%d"))) * 100_000
EPISODES = 20_000


def faults(seed: int) -> tuple[int, list[str], int, int]:
    """Return the seed, its faults, and the numbers of drives and of shown stops."""
    episode = ugv_search.play(seed)
    return seed, episode.faults, episode.drives, episode.shown


@pytest.mark.soak
def test_twenty_thousand_episodes() -> None:
    found = list(play_all(faults, range(SEED, SEED + EPISODES)))
    print(f"{sum(each[2] for each in found)} drives, {sum(each[3] for each in found)} shown")
    assert {seed: words for seed, words, _, _ in found if words} == {}

"""The search for messages that a recorder loses or writes twice, with 10,000 recordings.

`RECORDING_SEARCH=FROM:TO` plays other ones.
"""

import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from tests.fuzz.recording_search import play

FIRST, BEHIND = (int(seed) for seed in os.environ.get("RECORDING_SEARCH", "1000:11000").split(":"))


def faults(seed: int) -> tuple[int, list[str], int]:
    """Return the seed, its violations, and the number of messages."""
    with tempfile.TemporaryDirectory() as directory:
        episode = play(seed, Path(directory))
    return seed, episode.violations, len(episode.published)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_recordings_lose_nothing_silently() -> None:
    published, found = 0, {}
    with ProcessPoolExecutor(2) as pool:
        for seed, violations, count in pool.map(faults, range(FIRST, BEHIND), chunksize=50):
            published += count
            if violations:
                found[seed] = violations
    print(f"\n{published} messages, seeds {FIRST} to {BEHIND - 1}")
    assert found == {}

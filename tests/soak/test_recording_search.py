"""The search for messages that a recorder loses or writes twice, with 10,000 recordings.

`RECORDING_SEARCH=FROM:TO` plays other ones.
"""

import tempfile
from pathlib import Path

import pytest

from tests.fuzz.recording_search import play
from tests.support.soaks import play_all, seeds_from

SEEDS = seeds_from("RECORDING_SEARCH", "1000:11000")


def faults(seed: int) -> tuple[int, list[str], int]:
    """Return the seed, its violations, and the number of messages."""
    with tempfile.TemporaryDirectory() as directory:
        episode = play(seed, Path(directory))
    return seed, episode.violations, len(episode.published)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_ten_thousand_recordings_lose_nothing_silently() -> None:
    published, found = 0, {}
    for seed, violations, count in play_all(faults, SEEDS):
        published += count
        if violations:
            found[seed] = violations
    print(f"{published} messages")
    assert found == {}

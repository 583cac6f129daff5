"""The search for a stop that is claimed and false: 400 episodes, the same every time. `make soak` plays 30,000."""

import pytest

from tests.fuzz.stop_search import explain, search

PARTS = 4
EPISODES = 100


@pytest.mark.parametrize("part", range(PARTS))
def test_no_stop_is_claimed_and_false(part: int) -> None:
    total = search(range(part * EPISODES, (part + 1) * EPISODES))
    assert not total.failures, explain(total)
    assert total.ends["complete"] > EPISODES // 4
    assert total.ends["sent"] > 0
    assert total.ends["failed"] > 0

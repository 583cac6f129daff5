"""The search for false claims of stops, over 30,000 episodes. With any rule taken out, the search finds one.

`STOP_SEARCH=FROM:TO make soak` plays the episodes of other seeds.
"""

import pytest

from tests.fuzz.rules_removed import RULES
from tests.fuzz.stop_search import explain, found_at, search
from tests.support.soaks import seeds_from

SEEDS = seeds_from("STOP_SEARCH", "1000:31000")
WITHIN = 1200
"""Maximum number of episodes until the search finds the fault that a rule prevents."""
RARE = {
    "one block gap is not enough": 60_000,  # since a block gap is compared with the car's own block, one in 15,000
    "a frame with a silence in it is none": 7_400,  # since light seeking reports at the measured rate, one in 8,000
    # Since the first reading of a mode comes as late as measured, one in 3,000:
    "a report long after MODE00 does not show that a mode was left": 3_000,
    "nor one after more frames than MODE00": 3_000,
}
"""First seed for a rule whose fault is rare."""


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_thirty_thousand_episodes() -> None:
    total = search(SEEDS, processes=2)
    print(f"\nseeds {SEEDS.start} to {SEEDS.stop - 1}\n{total}")
    assert not total.failures, explain(total)


@pytest.mark.soak
@pytest.mark.parametrize("rule", RULES)
def test_search_finds_what_each_rule_prevents(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    RULES[rule](monkeypatch.setattr)
    first = RARE.get(rule, 0)
    found = found_at(range(first, first + WITHIN))
    print(f"\nwithout {rule!r}: {found}")
    assert found, f"{rule} is redundant, or the search is blind to it"

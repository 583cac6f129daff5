"""The search for needless and missing decisions of a plan, with 80 fleets. `make soak` plays 10,000."""

import pytest

from fleet.policy import state
from fleet.policy.state import ModeAttempts
from tests.fuzz.policy_search import play

EPISODES = 80


def test_eighty_fleets_have_no_needless_and_no_missing_decision() -> None:
    episodes = [play(seed) for seed in range(EPISODES)]
    assert {episode.seed: episode.faults for episode in episodes if episode.faults} == {}
    assert sum(episode.switches for episode in episodes) > 200
    assert sum(episode.commands for episode in episodes) > 500


def test_search_finds_that_a_car_is_replaced_while_it_changes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ModeAttempts, "failed", lambda self, now, *, busy: self.count)
    assert any("loses" in fault for seed in range(EPISODES) for fault in play(seed).faults)


def test_search_finds_that_broken_cars_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "FAILED_MODE_KEPT_S", 0.0)
    # In these two, two cars that ignore modes are in one fleet, and nothing happens to them at the end.
    assert play(815).faults
    assert play(842).faults

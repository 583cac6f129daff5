"""The search for false, late and missing outcomes, with 250 cars. `make soak` plays 10,000."""

import pytest

from fleet.client import outcome
from gateway.control.controller import Controller
from tests.fuzz.outcome_search import play

EPISODES = 250


def test_outcomes_of_250_cars_are_true_and_in_time() -> None:
    episodes = [play(seed) for seed in range(EPISODES)]
    assert {episode.seed: episode.violations for episode in episodes if episode.violations} == {}
    told = sum((episode.outcomes for episode in episodes[1:]), episodes[0].outcomes)
    assert told.total() > 1200
    assert len(told) > 60, "kinds of outcomes"


@pytest.mark.parametrize("seed", [1080, 1902])
def test_blinking_that_has_begun_does_not_wait_for_a_stop(seed: int) -> None:
    told = play(seed)
    assert told.violations == []
    assert told.outcomes["find sent "] >= 1


def test_drive_that_was_extended_has_an_end() -> None:
    assert play(3371).violations == []


def test_search_finds_a_client_that_gives_up_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome, "MAX_EVIDENCE_TIMEOUT_S", 0.0)
    monkeypatch.setattr(outcome, "MAX_QUEUE_TIME_S", 0.0)
    assert any("nothing was lost" in each for seed in range(EPISODES) for each in play(seed).violations)


def test_search_finds_a_drive_whose_end_nobody_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Controller, "_pass_drive_on", lambda self, _, new, how, now: self._done(new, how, now))
    assert play(3371).violations

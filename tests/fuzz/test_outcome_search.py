"""The search for false, late and missing outcomes, with 30 cars. `make soak` plays 10,000."""

import pytest

from fleet.client import outcome
from fleet.client.commands import drive_request
from gateway.control.controller import Controller
from schemas.words import Motion
from tests.fuzz.outcome_search import AFTER_S, CONNECT_S, Outcomes, play

EPISODES = 30


def test_outcomes_of_30_cars_are_true_and_in_time() -> None:
    episodes = [play(seed) for seed in range(EPISODES)]
    assert {episode.seed: episode.violations for episode in episodes if episode.violations} == {}
    told = sum((episode.outcomes for episode in episodes[1:]), episodes[0].outcomes)
    assert told.total() > 150
    assert len(told) > 30, "kinds of outcomes"


def violations_of_an_extended_drive() -> list[str]:
    """Extend a drive by more than a client waits beyond its end."""
    episode = Outcomes(0)
    episode.people = ["p0"]
    episode.played.connect()
    episode.run(CONNECT_S)
    episode.ask(drive_request(Motion.FORWARD, 1.0))
    episode.run(0.5)
    episode.ask(drive_request(Motion.FORWARD, 9.5))
    episode.run(AFTER_S)
    assert episode.report.outcomes.total() == 2
    return episode.report.violations


def test_drive_that_was_extended_has_an_end() -> None:
    assert violations_of_an_extended_drive() == []


def test_search_finds_a_client_that_gives_up_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome, "MAX_EVIDENCE_TIMEOUT_S", 0.0)
    monkeypatch.setattr(outcome, "MAX_QUEUE_TIME_S", 0.0)
    assert any("nothing was lost" in each for seed in range(EPISODES) for each in play(seed).violations)


def test_search_finds_a_drive_whose_end_nobody_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Controller, "_pass_drive_on", lambda self, _, new, how, now: self._done(new, how, now))
    assert violations_of_an_extended_drive()

"""The search for messages that a recorder loses or writes twice, with 40 recordings. `make soak` plays 10,000."""

from pathlib import Path

import pytest

from fleet.recording.sequence_tracker import SequenceTracker
from fleet.recording.writing.backfill_plan import BackfillPlan
from fleet.recording.writing.session_writer import SessionWriter
from tests.fuzz.recording_search import play

EPISODES = 40


def test_40_recordings_lose_nothing_silently_and_have_nothing_twice(tmp_path: Path) -> None:
    episodes = {seed: play(seed, tmp_path / str(seed)) for seed in range(EPISODES)}
    assert {seed: episode.violations for seed, episode in episodes.items() if episode.violations} == {}
    assert sum(episode.kills for episode in episodes.values()) > EPISODES // 2
    assert sum(len(episode.paths) for episode in episodes.values()) > 3 * EPISODES
    assert sum(len(episode.published) for episode in episodes.values()) > 400 * EPISODES


@pytest.mark.parametrize(
    ("place", "name", "broken", "seed", "words"),
    [
        (BackfillPlan, "add_newcomers", lambda *_: None, 3, "lacks"),
        (SessionWriter, "_request", lambda *_: None, 9, "lacks"),
        (SessionWriter, "_is_recorded", lambda *_: False, 13, "twice"),
        (SequenceTracker, "_skip", lambda *_: None, 9, "says"),
    ],
    ids=["newcomers", "gaps", "known", "count"],
)
def test_search_finds(
    place: object, name: str, broken: object, seed: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(place, name, broken)
    assert any(words in each for each in play(seed, tmp_path).violations)


def test_gap_behind_an_answer_that_broke_off_is_asked_for(tmp_path: Path) -> None:
    """In this recording, the rest of an answer was asked for only from the time of this answer on."""
    assert play(50788, tmp_path).violations == []


def test_gap_that_an_answer_shows_is_asked_for(tmp_path: Path) -> None:
    """In this recording, an answer does not go back to the message before it, and the next one follows it."""
    assert play(693, tmp_path).violations == []


def test_original_behind_two_answers_is_not_written_again(tmp_path: Path) -> None:
    """In this recording, an older message is in the second of two answers, and all originals come after them."""
    assert play(8462, tmp_path).violations == []


def test_answer_about_a_reconnect_is_none_about_the_whole_recording(tmp_path: Path) -> None:
    """In this recording, a car answers at once, but it was asked only for what came after a reconnect."""
    assert play(7372, tmp_path).violations == []


def test_gap_behind_a_message_of_the_interrupted_session_is_asked_for(tmp_path: Path) -> None:
    """In this recording, the answer before the gap has only what the killed recorder had recorded."""
    assert play(11173, tmp_path).violations == []

"""The search for e-stops and pauses that are lost or come back, with 150 fleets. `make soak` plays 20,000."""

from collections.abc import Iterable
from typing import Any

import pytest

from gateway.bus.estop_sync import Copy, copy_for_others
from gateway.control.safety_state import Safety
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import Estop
from tests.fuzz import safety_search
from tests.fuzz.safety_search import play

EPISODES = 150


def test_gateways_of_150_fleets_agree_in_the_end() -> None:
    episodes = {seed: play(seed) for seed in range(EPISODES)}
    assert {seed: episode.violations for seed, episode in episodes.items() if episode.violations} == {}
    for kind in ("estop", "pause"):
        assert sum(len(episode.begun[kind]) for episode in episodes.values()) > 2 * EPISODES
        assert sum(len(episode.ended[kind]) for episode in episodes.values()) > EPISODES


def copy_that_ends_all(*of_command: Any) -> Copy | None:
    """Return the copy of a command, which ends all pauses if it is that of an unpause."""
    copy = copy_for_others(*of_command)
    if isinstance(copy, pb.UnpauseCommand):
        copy.ClearField("ids")
    return copy


MERGE = Safety.merge


def merge_and_forget(safety: Safety, estops: Iterable[Estop], ended: Iterable[str]) -> object:
    """Merge what another gateway knows, and remember no ended e-stop that was not in force here."""
    known = {*safety.ended, *(each.id for each in safety.estops)}
    merged = MERGE(safety, estops, ended)
    safety._ended = {each: None for each in safety.ended if each in known}
    return merged


@pytest.mark.parametrize(
    ("place", "name", "broken", "words"),
    [
        (safety_search, "ROUND_S", 1e6, "lacks"),
        (safety_search, "copy_for_others", copy_that_ends_all, "nobody wanted"),
        (safety_search, "copy_for_others", lambda *_: None, "after 2.0 s"),
        (Safety, "merge", merge_and_forget, "begins again"),
    ],
    ids=["no-rounds", "unpause-of-all", "no-copies", "no-memory"],
)
def test_search_finds(place: Any, name: str, broken: object, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(place, name, broken)
    assert any(words in each for seed in range(EPISODES) for each in play(seed).violations)

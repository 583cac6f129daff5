"""The fuzzing of `make soak`, for seconds instead of minutes. The seeds are fixed, so every run has the same result."""

import pytest

from tests.fuzz import controller, decoder, driven, ugv_search


@pytest.mark.parametrize("seed", range(4))
def test_fuzzed_controller(seed: int) -> None:
    written, stopped = controller.run(seed, 10_000, stop_every=100)
    assert written > 500
    assert stopped > 80


@pytest.mark.parametrize("seed", range(4))
def test_fuzzed_driven_car(seed: int) -> None:
    done = driven.run(seed, 400)
    assert done.stops > 15
    assert len(done.states) > 5


@pytest.mark.parametrize("seed", range(2))
def test_fuzzed_decoder(seed: int) -> None:
    assert decoder.run(seed, 50_000) > 40_000


def test_fuzzed_waveshare_car() -> None:
    episodes = [ugv_search.play(seed) for seed in (*range(25), 1048, 1218, 4657, 2026112916709)]
    assert {each.seed: each.faults for each in episodes if each.faults} == {}
    assert sum(each.drives for each in episodes) >= 25, "what may be done is done"
    assert sum(each.shown for each in episodes) >= 6, "some can show their stops"

"""The fuzzing of `make soak`, for seconds instead of minutes. The seeds are fixed, so every run has the same result."""

import pytest

from tests.fuzz import controller, decoder, driven


@pytest.mark.parametrize("seed", range(4))
def test_a_controller_to_which_anything_happens(seed: int) -> None:
    written, stopped = controller.run(seed, 10_000, stop_every=100)
    assert written > 500
    assert stopped > 80


@pytest.mark.parametrize("seed", range(4))
def test_a_driven_car_to_which_anything_happens(seed: int) -> None:
    done = driven.run(seed, 400)
    assert done.stops > 15
    assert len(done.states) > 5


@pytest.mark.parametrize("seed", range(2))
def test_a_decoder_that_is_fed_anything(seed: int) -> None:
    assert decoder.run(seed, 50_000) > 40_000

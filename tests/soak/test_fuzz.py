"""Ten million steps of fuzzing: decoder, controller with its refusals, and controller with a simulated car.

The seeds change each day, and FUZZ_SEED repeats a run. A failure names its seed and step.
"""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from typing import Any

import pytest

from tests.fuzz import controller, decoder, driven

SEED = int(os.environ.get("FUZZ_SEED", datetime.now(UTC).strftime("%Y%m%d"))) * 10_000
DECODER_STEPS, CONTROLLER_STEPS, DRIVEN_STEPS = 7_000_000, 2_950_000, 50_000
PARTS = 50


def every(run: Callable[..., Any], steps: int) -> list[Any]:
    """Run a part of the steps with each seed, on all processors."""
    with ProcessPoolExecutor() as pool:
        return list(pool.map(run, range(SEED, SEED + PARTS), [steps // PARTS] * PARTS))


@pytest.mark.soak
def test_seven_million_pieces_for_the_decoder() -> None:
    print(f"\n{sum(every(decoder.run, DECODER_STEPS))} events, seeds from {SEED}")


@pytest.mark.soak
def test_three_million_steps_of_a_controller() -> None:
    done = every(controller.run, CONTROLLER_STEPS)
    print(f"\n{sum(written for written, _ in done)} frames, {sum(stops for _, stops in done)} stops, seeds from {SEED}")


@pytest.mark.soak
def test_fifty_thousand_steps_of_a_driven_car() -> None:
    done = every(driven.run, DRIVEN_STEPS)
    states = sorted(set().union(*(each.states for each in done)))
    print(f"\n{sum(each.stops for each in done)} stops in {len(states)} states, seeds from {SEED}: {'; '.join(states)}")

"""Marks cases of a test that run only in `make soak`, and plays the episodes of a search there."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Final, TypeVar

import pytest

R = TypeVar("R")
PROCESSES: Final = 2
EPISODES_AT_ONCE: Final = 50
"""Number of episodes that a process gets together."""


def only_in_soak(cases: Iterable[Any]) -> list[Any]:
    """Return the cases for `parametrize`."""
    return [pytest.param(each, marks=pytest.mark.soak) for each in cases]


def seeds_from(variable: str, usual: str) -> range:
    """Return the seeds FROM:TO that an environment variable names, without TO, or the usual ones."""
    first, behind = (int(seed) for seed in os.environ.get(variable, usual).split(":"))
    return range(first, behind)


def play_all(play: Callable[[int], R], seeds: range) -> Iterator[R]:
    """Play an episode for each seed, in processes of their own, and yield the results in the order of the seeds."""
    with ProcessPoolExecutor(PROCESSES) as pool:
        yield from pool.map(play, seeds, chunksize=EPISODES_AT_ONCE)
    print(f"\nseeds {seeds.start} to {seeds.stop - 1}")

"""What tests/e2e kills and cuts once, many times and with nothing added for a busy machine: `make soak` runs alone."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.kills import OPERATORS, Took, kill_operators
from tests.support.ports import free_endpoint
from tests.support.processes import Fleet

ROUNDS = 5
NO_ECHO_S = 1.0 + 1.1
"""protocol.md: without echo a report blocks 1.0 s, and a soft stop takes 1.1 s more if a frame may be in the buffer."""


def fleets(directory: Path, rounds: int) -> Iterator[Fleet]:
    """A new fleet for each round."""
    for number in range(rounds):
        place = directory / str(number)
        place.mkdir()
        fleet = Fleet(free_endpoint(), place)
        try:
            yield fleet
        finally:
            fleet.close()


def show(found: dict[str, list[Took]]) -> None:
    print(f"\n{'what':60} {'best':>7} {'worst':>7} {'limit':>7}")
    for what, took in found.items():
        times = sorted(each.took_s for each in took)
        print(f"{what:60} {times[0]:7.3f} {times[-1]:7.3f} {took[0].limit_s:7.2f}")


@pytest.mark.soak
@pytest.mark.parametrize("world", ["room", "open"])
def test_killed_operators(tmp_path: Path, world: str) -> None:
    more_s = NO_ECHO_S if world == "open" else 0.0
    operators = tuple(replace(each, block_s=each.block_s + more_s) for each in OPERATORS)
    found: dict[str, list[Took]] = {}
    for fleet in fleets(tmp_path, ROUNDS):
        for case, took in kill_operators(fleet, operators, world).items():
            found.setdefault(case, []).append(took)
    show(found)
    assert not [f"{case}: {each}" for case, took in found.items() for each in took if each.late]

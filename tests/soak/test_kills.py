"""Repeats the kills and cuts of tests/e2e many times, with strict limits: `make soak` runs alone."""

import random
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.authority import want_for_ever
from tests.support.flooding import FLIGHT_S, PER_S, flood
from tests.support.kills import (
    DOINGS,
    MORE_DOINGS,
    OPERATORS,
    Took,
    cut_links,
    kill_gateways,
    kill_operators,
    stop_in_every_mode,
)
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

ROUNDS = 5
NO_ECHO_S = 1.0 + 1.1
"""docs/reference/protocol.md#stops: without echo a report blocks 1.0 s, and a soft stop takes 1.1 s more if a frame may
be in the buffer."""


def fleets(directory: Path, rounds: int) -> Iterator[FleetProcesses]:
    """Yield a new fleet for each round."""
    for number in range(rounds):
        place = directory / str(number)
        place.mkdir()
        fleet = FleetProcesses(free_endpoint(), place)
        try:
            yield fleet
        finally:
            fleet.close()


def judged(rounds: Iterable[dict[str, Took]]) -> None:
    """Print the times of all rounds. Fail if one is over its limit."""
    found: dict[str, list[Took]] = {}
    for each in rounds:
        for what, took in each.items():
            found.setdefault(what, []).append(took)
    print(f"\n{'what':60} {'best':>7} {'worst':>7} {'limit':>7}")
    for what, every in found.items():
        times = sorted(each.took_s for each in every)
        print(f"{what:60} {times[0]:7.3f} {times[-1]:7.3f} {every[0].limit_s:7.2f}")
    assert not [f"{what}: {each}" for what, every in found.items() for each in every if each.late]


@pytest.mark.soak
@pytest.mark.parametrize("world", ["room", "open"])
def test_killed_operators(tmp_path: Path, world: str) -> None:
    more_s = NO_ECHO_S if world == "open" else 0.0
    operators = tuple(replace(each, block_s=each.block_s + more_s) for each in OPERATORS)
    judged(kill_operators(fleet, operators, world) for fleet in fleets(tmp_path, ROUNDS))


@pytest.mark.soak
def test_killed_gateways(tmp_path: Path) -> None:
    judged(
        kill_gateways(fleet, doings)
        for fleet, doings in zip(fleets(tmp_path, 2 * ROUNDS), (DOINGS, MORE_DOINGS) * ROUNDS, strict=True)
    )


@pytest.mark.soak
def test_cut_links(tmp_path: Path) -> None:
    judged(cut_links(fleet, tmp_path / str(number)) for number, fleet in enumerate(fleets(tmp_path, ROUNDS)))


@pytest.mark.soak
def test_minute_of_10000_drives_a_second(tmp_path: Path) -> None:
    for fleet in fleets(tmp_path, 1):
        found = flood(fleet, seconds=60.0, stops=12)
    print(
        f"\n{found.published} drives in 62 s, {found.left_out} left out, {len(found.frames)} frames on the wire, "
        f"at least {min(found.apart_s):.3f} s apart; a stop's first frame after {max(found.stopped_s):.3f} s at most; "
        f"memory {found.rss_mb[0]:.1f} MB, then {min(found.rss_mb):.1f} to {max(found.rss_mb):.1f}"
    )
    assert found.published > 0.95 * 62 * PER_S
    assert all(data.count(b"$") == 1 for _, data in found.frames)
    assert min(found.apart_s) > FLIGHT_S - 0.001
    assert max(found.rss_mb) < found.rss_mb[0] + 20.0
    assert not found.drove_on_s, "nobody has let go"
    assert max(found.stopped_s) < FLIGHT_S + 0.05


@pytest.mark.soak
def test_five_stops_in_every_mode(tmp_path: Path) -> None:
    for fleet in fleets(tmp_path, 1):
        found = stop_in_every_mode(fleet, rounds=5, moments=random.Random(4))
    print(f"\n{'stop in':24} {'took, of what was announced'}")
    for what, took in found.items():
        print(f"{what:24} {', '.join(str(each) for each in took)}")
    assert all(len(took) == 5 for took in found.values())
    assert not [f"{what}: {each}" for what, took in found.items() for each in took if each.late]
    assert not [
        what for what, took in found.items() for each in took if each.took_s > 4.0 and what != "obstacle_avoidance"
    ]


@pytest.mark.soak
def test_coordinator_never_moves_a_stopped_car(tmp_path: Path) -> None:
    killed = ["gateway", "coordinator", "gateway and coordinator"] * 4
    for fleet in fleets(tmp_path, 1):
        assert want_for_ever(fleet, tmp_path, killed) == []

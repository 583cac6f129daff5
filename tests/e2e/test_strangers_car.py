"""Stops of a stranger's car, behind a wire that swallows bytes around them: no false claim, and the car stands.

The car's own program judges (strangers_car.py). Many more gaps: tests/soak/test_strangers_car.py.
"""

import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.gap import Direction, Gap, Wire
from tests.support.kills import BUSY_S
from tests.support.ports import free_endpoint
from tests.support.processes import Fleet, Process, wait_for
from tests.support.strangers import MODES, PROGRAM, SHOWN_S, STANDS_S, Stranger, Strangers, gaps
from tests.support.up import Up

pytestmark = pytest.mark.xdist_group("strangers")


def start(fleet: Fleet, modes: list[str], seed: int) -> Strangers:
    """Cars and wires, without gateways."""
    cars = []
    for number, mode in enumerate(modes):
        process = fleet.start(str(PROGRAM), "--seed", str(seed + number))
        cars.append(Stranger(mode, process, Wire(process.line()["port"])))
    return Strangers(cars)


class Lot:
    """Seven cars, one for each mode, with their gateways."""

    def __init__(self, directory: Path, seed: int) -> None:
        self.fleet = Fleet(free_endpoint(), directory)
        self.cars = start(self.fleet, list(MODES), seed)
        for car in self.cars:
            car.follow(self.fleet.bus)
        self.gateways: dict[str, Process] = {
            car.mode: self.fleet.gateway(car.wire.link, "--longest-drive", "60", car=car.mode) for car in self.cars
        }

    def ready(self) -> None:
        """Wait until each car is in a known state."""
        for car in self.cars:
            self.fleet.ready(car.mode)

    def close(self) -> None:
        self.cars.close()
        self.fleet.close()


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lot]:
    started = Lot(tmp_path_factory.mktemp("strangers"), seed=1)
    try:
        started.ready()
        yield started
    finally:
        started.close()


def stop_all(lot: Lot, seed: int) -> list[str]:
    """Stop all cars with `fleet stop`; what was wrong."""
    wanted = gaps(MODES, seed)
    lot.cars.enter_modes(lot.fleet)
    lot.cars.run(random.Random(seed).uniform(0.0, 4.0))
    lot.cars.arm(wanted)
    began = time.time()
    stopping = lot.fleet.start("-m", "fleet.cli", "stop")
    code = stopping.wait()
    said = stopping.lines()
    found = judge(lot.cars, wanted, began)
    records = {car.mode: [each.phase for each in car.stop_records(began)] for car in lot.cars}
    found += [f"{mode}: ends as {phases}" for mode, phases in records.items() if len(phases) != 1]
    if (code == 0) != all(phases in (["complete"], ["sent"]) for phases in records.values()):
        found.append(f"fleet stop: exit code {code} for {records}: {said}")
    return found


def judge(cars: Strangers, wanted: dict[str, Gap], began: float) -> list[str]:
    """Wait until each car stands and has shown it; what was wrong meanwhile, each with its story."""
    found: list[str] = []
    for car in cars:
        whole_at = wait_for(lambda car=car: car.wire.whole_at, f"a frame is written to {car.mode}")
        wrong = []
        try:
            wait_for(lambda car=car, at=whole_at: car.shown and car.stays(at), f"{car.mode} has shown it", SHOWN_S)
        except AssertionError as error:
            wrong.append(str(error))
        found += told(car, wanted[car.mode], began, wrong + verdict(car, began, whole_at))
    return found


def verdict(car: Stranger, began: float, whole_at: float) -> list[str]:
    """What was wrong with one car after a stop."""
    wrong = car.false_claims(began)
    if (late_s := car.late_s(max(began, whole_at))) > STANDS_S + BUSY_S:
        wrong.append(f"{car.mode}: moved until {late_s:.1f} s after the wire was whole")
    return wrong


def told(car: Stranger, gap: Gap, began: float, wrong: list[str]) -> list[str]:
    """One text of what was wrong, with the story."""
    return ["\n".join([*wrong, f"({gap})", car.story(began)])] if wrong else []


@pytest.mark.timeout(240)
def test_fleet_stop_claims_what_is_true_and_every_car_stands(lot: Lot) -> None:
    found = stop_all(lot, seed=10)
    assert not found, "\n\n".join(found)


@pytest.mark.timeout(240)
def test_a_gateway_that_is_told_to_end_has_stopped_its_car_or_says_that_it_has_not(lot: Lot) -> None:
    """One wire is broken for good; the others have gaps."""
    wanted = gaps(MODES, 20) | {"light_seeking": Gap(Direction.BOTH, 3600.0)}
    lot.cars.enter_modes(lot.fleet)
    lot.cars.arm(wanted)
    began = time.time()
    for gateway in lot.gateways.values():
        gateway.popen.terminate()
    found = []
    for car in lot.cars:
        gateway = lot.gateways[car.mode]
        code, gap = gateway.wait(), wanted[car.mode]
        ended = time.time()
        wrong = car.false_claims(began)
        if code == 0:
            wait_for(lambda car=car, at=ended: car.look().heard_until > at, f"{car.mode} goes on")
            if car.late_s(ended) > 0:
                wrong.append(f"{car.mode}: moves, but its gateway has ended with exit code 0")
        elif code != 1 or f"{car.mode} may still be moving" not in gateway.stderr:
            wrong.append(f"{car.mode}: exit code {code}: {gateway.stderr}")
        if gap.length_s > 60 and code == 0:
            wrong.append(f"{car.mode}: exit code 0 on a dead wire")
        found += told(car, gap, began, wrong)
    assert not found, "\n\n".join(found)


@pytest.mark.timeout(240)
def test_fleet_down_says_stopped_of_cars_that_stand(tmp_path: Path, fleet: Fleet) -> None:
    modes = ["manual", "tracking", "obstacle_avoidance", "remote_control"]
    endpoint = free_endpoint()
    cars = start(fleet, modes, seed=30)
    wanted = gaps(modes, 30)
    links = "".join(
        f"  {car.mode}: {{link: '{car.wire.link}', platform: arduino, limits: {{longest_drive_s: 60}}}}\n"
        for car in cars
    )
    (tmp_path / "up").mkdir()
    file = tmp_path / "fleet.yaml"
    file.write_text(f"cars:\n{links}")
    try:
        with Up(tmp_path / "up", endpoint, str(file), "--no-record") as up:
            for car in cars:
                car.follow(up.bus)
            for car in cars:
                up.ready(car.mode)
            cars.enter_modes(up)
            cars.arm(wanted)
            began = time.time()
            done = up.fleet("down")
            ended = time.time()
            found = []
            for car in cars:
                assert f"{car.mode}: " in done.stdout, done
                wrong = car.false_claims(began)
                if f"{car.mode}: stopped" in done.stdout:
                    wait_for(lambda car=car, at=ended: car.look().heard_until > at, f"{car.mode} goes on")
                    if car.late_s(ended) > 0:
                        wrong.append(f"{car.mode}: moves, but fleet down says: stopped")
                if car.late_s(max(began, car.wire.whole_at or began)) > STANDS_S + BUSY_S:
                    wrong.append(f"{car.mode}: moves for too long")
                found += told(car, wanted[car.mode], began, wrong)
            assert not found, "\n\n".join(found)
            assert done.returncode == 0, done
    finally:
        cars.close()

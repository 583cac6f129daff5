"""Stops of a foreign car behind a wire that loses bytes around them: no claim is false, and the car stands.

The car's own program judges (strangers_car.py). tests/soak/test_strangers_car.py has many more gaps.
"""

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.foreign_cars import MODES, STANDS_S, ForeignLot, gaps, report, start, stop_all
from tests.support.gap_proxy import ByteGap, GapDirection
from tests.support.kills import BUSY_S
from tests.support.ports import free_endpoint
from tests.support.processes import TAKEN, FleetProcesses, wait_for
from tests.support.up import Up


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForeignLot]:
    started = ForeignLot(tmp_path_factory.mktemp("strangers"))
    try:
        started.ready()
        yield started
    finally:
        started.close()


@pytest.mark.soak
@pytest.mark.timeout(240)
def test_fleet_stop_claims_what_is_true_and_every_car_stands(lot: ForeignLot) -> None:
    found = stop_all(lot, gaps(MODES, seed=10))
    assert not found, "\n\n".join(found)


@pytest.mark.timeout(240)
def test_terminated_gateway_stops_car_or_says_not_stopped(lot: ForeignLot) -> None:
    """One wire is broken for good, and the others have gaps."""
    wanted = gaps(MODES, 20) | {"light_seeking": ByteGap(GapDirection.BOTH, 3600.0)}
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
        found += report(car, gap, began, wrong)
    assert not found, "\n\n".join(found)


@pytest.mark.soak
@pytest.mark.timeout(240)
def test_unreachable_cars_are_named_at_end_and_stopped_until_second_ctrl_c(
    tmp_path: Path, fleet: FleetProcesses
) -> None:
    """The wires pass the cars' readings and lose all frames to the cars: red's for some seconds, blue's for good.

    test_up.py tests that `fleet up` ends by itself when the last car stands.
    """
    cars = start(fleet, ["obstacle_avoidance"] * 2, seed=50)
    by_name = dict(zip(("red", "blue"), cars, strict=True))
    (tmp_path / "up").mkdir()
    file = tmp_path / "fleet.yaml"
    links = "".join(f"  {name}: {{link: '{car.wire.link}', platform: arduino}}\n" for name, car in by_name.items())
    file.write_text(f"cars:\n{links}")
    try:
        with Up(tmp_path / "up", free_endpoint(), str(file), "--no-record") as up:
            for name, car in by_name.items():
                up.ready(name)
                assert up.ask("mode", name, mode="obstacle_avoidance")["status"] in TAKEN
                wait_for(lambda car=car: car.true_mode == MODES["obstacle_avoidance"], f"{name} avoids obstacles")
            for car in cars:
                car.wire.arm(ByteGap(GapDirection.TO_CAR, 3600.0, early=True))
            up.process.popen.send_signal(signal.SIGINT)
            tried = up.until("end", "red", "A fresh gateway tries to stop the car")
            assert tried["words"].startswith("NOT CONFIRMED: ")
            assert by_name["red"].true_mode == MODES["obstacle_avoidance"]
            by_name["red"].wire.mend()
            up.until("end", "red", "stopped")
            at = time.time()
            wait_for(lambda: by_name["red"].stays(at), "red stands, and stays")
            up.process.popen.send_signal(signal.SIGINT)
            assert up.process.wait() == 1
            ended = [*up.heard, *map(json.loads, up.process.lines())]
            words = {each["name"]: each["words"] for each in ended if each["what"] == "end"}
            assert words["red"] == "stopped"
            assert words["blue"].startswith("NOT CONFIRMED: ")
            assert words["@supervisor"] == "NOT CONFIRMED: blue. They may be moving: go to them."
            assert by_name["blue"].true_mode == MODES["obstacle_avoidance"]
            for name in by_name:
                assert "may still be moving" in up.fleet("logs", name).stdout
    finally:
        cars.close()


@pytest.mark.soak
@pytest.mark.timeout(240)
def test_fleet_down_says_stopped_of_cars_that_stand(tmp_path: Path, fleet: FleetProcesses) -> None:
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
                found += report(car, wanted[car.mode], began, wrong)
            assert not found, "\n\n".join(found)
            assert done.returncode == 0, done
    finally:
        cars.close()

"""A hub, a car's computer and an operator's computer on a network that breaks, with certificates.

red is at the hub's computer, blue at its own. An operator on a third computer drives both. The simulators say what the
motors truly do. Every car that has lost its operator stops in time, nothing old is obeyed when the link is back, and a
car whose operator is still there goes on.
"""

import random
import signal
import time
from collections.abc import Iterator

import pytest

from tests.support.machines import HUB, OPERATOR, PI, Machines, machines
from tests.support.processes import GatewayProcess, driving, wait_for

LEASE_S = 2.0
"""Zenoh's lease: a machine that is cut off is known to be gone after it."""
LOST_S = 1.0
"""Maximum time to live of a drive whose sender is gone."""
BLOCK_S = 1.0
"""The block of a stop's first frame, and half a second for this machine."""
STOPS_S = LEASE_S + LOST_S + BLOCK_S + 0.5
HEALED_S = 6.0
ROUNDS = 4
DRIVER = """
import sys, threading
from fleet import Fleet
with Fleet(kind="person") as fleet:
    threads = [threading.Thread(target=fleet.car(name).drive, args=("spin_left", 60.0)) for name in sys.argv[1:]]
    for each in threads: each.start()
    print("1", flush=True)
    for each in threads: each.join()
"""


class NetworkStage:
    """The three machines with their cars."""

    def __init__(self, made: Machines) -> None:
        self.made = made
        self.hub = made.make_hub("red")
        made.join(PI, "--car", "blue")
        made.join(OPERATOR, "mia")
        self.sims: dict[str, GatewayProcess] = {}
        for car, machine in (("red", HUB), ("blue", PI)):
            sim = self.sims[car] = made.start(
                machine, "-m", "gateway.cli", "sim", "--no-truth", "--seed", "3", "--car", f"{car}:arduino:tcp"
            )
            link = sim.line()["link"]
            options = ("--car", car, "--link", link, "--platform", "arduino", "--longest-drive", "60", "--retry")
            made.start(machine, "-m", "gateway.cli", "run", *options)
        wait_for(lambda: made.run(OPERATOR, "wait", "--ready", "red", "blue")[0] == 0, "both are ready")

    def drive(self) -> GatewayProcess:
        """Let the operator drive both cars."""
        driver = self.made.start(OPERATOR, "-c", DRIVER, "red", "blue")
        driver.line()
        for car in self.sims:
            wait_for(lambda car=car: self.moves(car), f"{car} drives")
        return driver

    def moves(self, car: str) -> bool:
        return driving(self.sims[car], car)

    def stands_after(self, car: str, began: float) -> float:
        """Return the time until the motors of a car are off, s."""
        wait_for(lambda: not self.moves(car), f"{car} stands")
        return time.monotonic() - began

    def stays(self, car: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            assert not self.moves(car), f"{car} moves again"
            time.sleep(0.05)  # not a wait: it looks for this time

    def operator(self, *arguments: str) -> tuple[int, list[str], str]:
        return self.made.run(OPERATOR, *arguments)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NetworkStage]:
    with machines(tmp_path_factory.mktemp("machines")) as made:
        yield NetworkStage(made)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(ROUNDS))
def test_operator_that_is_cut_off_stops_both(seed: int, stage: NetworkStage) -> None:
    driver = stage.drive()
    stage.made.cut(OPERATOR)
    began = time.monotonic()
    took = {car: stage.stands_after(car, began) for car in stage.sims}
    assert max(took.values()) < STOPS_S, took
    time.sleep(random.Random(seed).uniform(0.0, 6.0))  # not a wait: how long the link is cut
    stage.made.mend(OPERATOR)
    for car in stage.sims:
        stage.stays(car, HEALED_S / 2)
    driver.end(signal.SIGKILL)
    wait_for(lambda: stage.operator("stop")[0] == 0, "it stops them again")
    assert stage.operator("resume")[0] == 0
    print(f"\noperator cut: {', '.join(f'{car} {each:.2f} s' for car, each in took.items())}")


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(ROUNDS))
def test_cut_off_car_stops_and_other_drives_on(seed: int, stage: NetworkStage) -> None:
    driver = stage.drive()
    stage.made.cut(PI)
    began = time.monotonic()
    took = stage.stands_after("blue", began)
    assert took < STOPS_S, took
    assert stage.moves("red"), "its operator is there"
    assert stage.operator("estop", "--why", "fire")[0] == 0
    wait_for(lambda: not stage.moves("red"), "red stands")
    time.sleep(random.Random(seed).uniform(0.0, 4.0))  # not a wait: how long the link is cut
    stage.made.mend(PI)
    wait_for(
        lambda: "fire" in " ".join(stage.operator("get", "blue/state/safety", "--json")[1]), "blue has the e-stop, too"
    )
    stage.stays("blue", HEALED_S / 2)
    driver.end(signal.SIGKILL)
    wait_for(lambda: stage.operator("resume", "--all")[0] == 0, "both are free")
    print(f"\ncar cut: blue {took:.2f} s")


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("_", range(ROUNDS))
def test_killed_hub_returns_and_old_commands_are_not_obeyed(_: int, stage: NetworkStage) -> None:
    driver = stage.drive()
    stage.made.kill_hub()
    began = time.monotonic()
    took = {car: stage.stands_after(car, began) for car in stage.sims}
    assert max(took.values()) < STOPS_S, took
    for car in stage.sims:
        stage.stays(car, HEALED_S / 2)
    driver.end(signal.SIGKILL)
    wait_for(lambda: stage.operator("stop")[0] == 0, "red's gateway has started a hub again")
    assert stage.operator("resume")[0] == 0
    print(f"\nhub killed: {', '.join(f'{car} {each:.2f} s' for car, each in took.items())}")

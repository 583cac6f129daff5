"""A hundred simulated cars: the supervisor restarts no gateway because the machine is busy or stalls."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from schemas.bus import Sample
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for
from tests.support.up import Up

CARS = 100
QUIET_S, BUSY_S = 60.0, 120.0
"""Maximum time until all cars are at rest: on two processors, and beside a process that takes one of them."""
STANDS_S = 6.0
SETTLED_S = 15.0
"""Time after which the supervisor would have killed a gateway."""


@contextmanager
def burning() -> Iterator[None]:
    """Run a process that takes one processor."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextmanager
def hundred(directory: Path, seconds: float) -> Iterator[Up]:
    """Start a fleet. Check that it comes to rest within this time without a restart."""
    with Up(directory, free_endpoint(), "--sim", str(CARS), "--no-record") as up:
        wait_until_at_rest(up, 3 * seconds)
        took = time.perf_counter() - up.began
        print(f"\n{CARS} cars at rest after {took:.1f} s, load {os.getloadavg()[0]:.1f}, restarts: {restarts(up)}")
        assert restarts(up) == {}
        assert took < seconds
        yield up


def moving(up: Up) -> dict[str, str]:
    """Return the cars that are not known to stand, each with its state."""
    states = {
        each.key.split("/")[1]: each.message()
        for each in up.bus.query("fleet/*/state/safety", timeout_s=5.0)
        if isinstance(each, Sample)
    }
    missing = {"": f"{CARS - len(states)} cars did not answer"} if len(states) < CARS else {}
    return missing | {car: str(state) for car, state in states.items() if state.motors != "off"}  # type: ignore[attr-defined]


def wait_until_at_rest(up: Up, seconds: float, wedged: int = 0) -> set[str]:
    """Poll once a second, because answers take CPU time that a hundred gateways need to start. Return the wedged cars.

    wedged: number of cars that may show no stop, if they stand and their gateways say so.
    """
    deadline = time.monotonic() + seconds
    while left := moving(up):
        if time.monotonic() > deadline:
            words = f"{len(left)} are not at rest:\n" + "\n".join(left.values())
            assert len(left) <= wedged, words
            assert all('trust: "unproven"' in state and stands(up, car) for car, state in left.items()), words
            print("wedged:", *left)
            return set(left)
        time.sleep(1.0)
    return set()


def stands(up: Up, car: str) -> bool:
    """Return True if the true motors of the car are off."""
    truths: list[bool] = []

    def on_truth(sample: Sample) -> None:
        truth: Any = sample.message()
        truths.append(truth.motor_left == truth.motor_right == 0)

    with up.bus.subscribe(f"fleet/{car}/sim/truth", on_truth):
        wait_for(lambda: len(truths) > 5, f"the truth of {car}")
    return all(truths)


def restarts(up: Up) -> dict[str, str]:
    """Return the restarted processes with the reasons."""
    return {each.name: each.words for each in up.processes() if each.restarts}


def stand(pids: list[int]) -> None:
    """Pause these processes for a while. The first one is paused first and resumed last."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(STANDS_S)
    finally:
        for pid in reversed(pids):
            os.kill(pid, signal.SIGCONT)


@pytest.mark.soak
def test_hundred_cars_stop_beside_busy_process(tmp_path: Path) -> None:
    with burning(), hundred(tmp_path, BUSY_S):
        pass


@pytest.mark.soak
def test_hundred_cars_stop_after_hub_or_machine_stalls(tmp_path: Path) -> None:
    with hundred(tmp_path, QUIET_S) as up:
        for what, pids in (("hub", [up.hub()]), ("machine", [up.process.pid, *up.left()])):
            stand(pids)
            time.sleep(SETTLED_S)
            # One of 300 cars showed no stop after that. Likely it lost half a frame while the simulator was late, and
            # was wedged (docs/reference/protocol.md#hazards). No gateway can mend this.
            wedged = wait_until_at_rest(up, BUSY_S, wedged=2)
            print(f"{what} stood for {STANDS_S:g} s, restarts: {restarts(up)}")
            assert restarts(up) == {}
        down = up.fleet("down")
        assert set(re.findall(r"^(\w+): NOT STOPPED", down.stderr, re.MULTILINE)) == wedged, down.stderr
        assert down.returncode == (1 if wedged else 0)

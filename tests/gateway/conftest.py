"""Fixtures for tests of the `gateway` commands: simulated cars, and the commands as processes."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.processes import GatewayProcess

Command = Callable[..., "subprocess.CompletedProcess[str]"]
Started = Callable[..., GatewayProcess]
PATIENCE_S = 60


@pytest.fixture
def command() -> Command:
    """Return a function that runs `gateway ...` to its end."""

    def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
        done = subprocess.run(
            [sys.executable, "-m", "gateway.cli", *map(str, arguments)],
            check=False,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            env=os.environ | {"COLUMNS": "200"},
        )
        assert "Traceback" not in done.stderr, done.stderr
        return done

    return run


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Started]:
    """Yield a function that starts `gateway ...`. Kill the processes that still run at the end."""
    started: list[GatewayProcess] = []

    def begin(*arguments: str | Path) -> GatewayProcess:
        log = tmp_path / f"{len(started)}.log"
        started.append(GatewayProcess(["-m", "gateway.cli", *map(str, arguments)], log, {}))
        return started[-1]

    yield begin
    for process in started:
        if process.popen.poll() is None:
            process.popen.kill()
        process.wait()


@pytest.fixture
def simulate(start: Started) -> Callable[..., tuple[GatewayProcess, list[str]]]:
    """Return a function that starts simulated cars (NAME:PLATFORM:LINK), and returns the process and their links."""

    def begin(*cars: str) -> tuple[GatewayProcess, list[str]]:
        described = [word for car in cars for word in ("--car", car)]
        sim = start("sim", "--no-truth", "--seed", "3", *described)
        return sim, [sim.line()["link"] for _ in cars]

    return begin

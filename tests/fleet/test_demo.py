"""`fleet demo` as a user runs it: all its checks pass, and after Ctrl-C no process is left."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import wait_for

PATIENCE_S = 240.0
"""Timeout of the demo. It starts ten processes in turn: 20 s, and several times as long on a busy machine."""


def _left(marker: str) -> list[str]:
    listed = subprocess.run(["ps", "-axwwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    return [line for line in listed.splitlines() if marker in line and "fleet.cli demo" not in line]


@pytest.mark.timeout(PATIENCE_S + 60)
def test_every_check_of_the_demo_holds(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fleet.cli", "demo", "--json", "--sessions", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    assert said["ok"], done.stderr
    assert done.returncode == 0
    assert Path(said["rrd"]).exists()
    assert _left(str(tmp_path)) == []


@pytest.mark.timeout(PATIENCE_S + 60)
@pytest.mark.soak
def test_terminated_demo_stops_cars_and_leaves_nothing(tmp_path: Path) -> None:
    demo = subprocess.Popen(
        [sys.executable, "-m", "fleet.cli", "demo", "--sessions", str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert demo.stdout is not None
    with demo, demo.stdout:
        try:
            found = any("coordinator" in line for line in demo.stdout)
        finally:
            demo.send_signal(signal.SIGTERM)
        assert found, "it came to the coordinator"
        assert demo.wait(PATIENCE_S) == 130
    wait_for(lambda: not _left(str(tmp_path)), "everything has ended")


@pytest.mark.timeout(PATIENCE_S + 60)
def test_nobody_reads_it_and_no_directory_is_blamed(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fleet.cli", "demo", "--no-view", "--sessions", str(tmp_path)]
    nobody, stdout = os.pipe()
    os.close(nobody)
    with subprocess.Popen(command, stdout=stdout, stderr=subprocess.PIPE, text=True) as demo:
        os.close(stdout)
        _, errors = demo.communicate(timeout=PATIENCE_S)
    assert (demo.returncode, errors) == (1, "")
    assert _left(str(tmp_path)) == []


def test_directory_that_cannot_be_made_is_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fleet.cli", "demo", "--sessions", "/proc/x"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "/proc/x" in line
    assert "--sessions" in line

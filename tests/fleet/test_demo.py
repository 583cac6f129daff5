"""`fleet demo` as a user runs it: all its checks hold, and interrupted it leaves nothing running."""

import json
import signal
import subprocess
import sys
from pathlib import Path

from tests.support.processes import wait_for


def _left(marker: str) -> list[str]:
    listed = subprocess.run(["ps", "-axwwo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    return [line for line in listed.splitlines() if marker in line and "fleet.cli demo" not in line]


def test_every_check_of_the_demo_holds(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fleet.cli", "demo", "--json", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=110,
    )
    assert done.stdout, done.stderr
    said = json.loads(done.stdout)
    assert said["ok"], done.stderr
    assert done.returncode == 0
    assert Path(said["rrd"]).exists()
    assert _left(str(tmp_path)) == []


def test_a_demo_that_is_terminated_stops_its_cars_and_leaves_nothing(tmp_path: Path) -> None:
    demo = subprocess.Popen(
        [sys.executable, "-m", "fleet.cli", "demo", "--out", str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert demo.stdout is not None
    with demo, demo.stdout:
        try:
            wait_for(lambda: "coordinator" in demo.stdout.readline(), "the coordinator starts")  # type: ignore[union-attr]
        finally:
            demo.send_signal(signal.SIGTERM)
        assert demo.wait(60) == 130
    wait_for(lambda: not _left(str(tmp_path)), "everything has ended")


def test_a_directory_that_cannot_be_made_is_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fleet.cli", "demo", "--out", "/proc/x"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "/proc/x" in line
    assert "--out" in line

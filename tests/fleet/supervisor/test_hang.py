"""Distinguishes a hanging process from a slow one, from a stalled machine, and from a hub without messages."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fleet.supervisor import cpu_time
from fleet.supervisor.hang import (
    MANY_SILENT_S,
    MAX_POLL_GAP_S,
    MOVING_SILENT_S,
    SLOW_SILENT_S,
    CpuTime,
    Pulse,
    Sign,
    WatchClock,
    have_common_cause,
    longest_hub_silence_s,
    longest_silence_s,
)
from tests.support.processes import freeze, wait_for


@pytest.mark.parametrize(
    ("run_share", "wait_share", "ready", "sign"),
    [
        (0.0, 0.0, False, Sign.BLOCKED),  # a lock, SIGSTOP
        (0.005, 0.0, False, Sign.SLOW),  # a gateway at rest
        (0.0005, 0.9, False, Sign.SLOW),  # the process waits for a processor
        (0.0, 0.0, True, Sign.SLOW),  # the process waits for a processor or the disk, without a count yet
        (0.5, 0.5, False, Sign.SLOW),  # a start on a busy machine
        (0.99, 0.01, False, Sign.SPINNING),
    ],
)
def test_silence_is_judged_by_cpu_time(run_share: float, wait_share: float, ready: bool, sign: Sign) -> None:
    pulse = Pulse()
    assert pulse.sign is Sign.UNKNOWN
    for half in range(10):
        now = 100.0 + half / 2
        assert pulse.is_due(now)
        pulse.add(now, CpuTime(7.0 + run_share * now, 3.0 + wait_share * now, ready))
        assert not pulse.is_due(now + 0.4)
        assert pulse.sign is (sign if half >= 2 else Sign.UNKNOWN)
    pulse.clear()
    assert pulse.sign is Sign.UNKNOWN


def test_only_last_seconds_of_cpu_time_count() -> None:
    pulse = Pulse()
    for half in range(20):  # the process worked, then hangs
        pulse.add(half / 2, CpuTime(min(half, 8) / 2))
    assert pulse.sign is Sign.BLOCKED
    pulse.add(11.0, None)
    assert pulse.sign is Sign.UNKNOWN


@pytest.mark.parametrize(
    ("sign", "many", "may_move", "seconds"),
    [
        (Sign.BLOCKED, False, True, 0.0),  # a blocked gateway cannot stop its car, so it is replaced
        (Sign.SPINNING, False, True, 0.0),
        (Sign.UNKNOWN, False, True, 0.0),
        (Sign.BLOCKED, True, True, MANY_SILENT_S),
        (Sign.UNKNOWN, True, False, MANY_SILENT_S),
        (Sign.SLOW, False, False, SLOW_SILENT_S),
        (Sign.SLOW, False, True, MOVING_SILENT_S),
        (Sign.SLOW, True, True, MOVING_SILENT_S),
    ],
)
def test_how_long_a_process_may_be_silent(sign: Sign, many: bool, may_move: bool, seconds: float) -> None:
    assert longest_silence_s(sign, many=many, may_move=may_move) == seconds


@pytest.mark.parametrize(
    ("sign", "seconds"),
    [
        (Sign.BLOCKED, 0.0),
        (Sign.UNKNOWN, 0.0),
        (Sign.SLOW, SLOW_SILENT_S),
        (Sign.SPINNING, SLOW_SILENT_S),  # a hundred sessions reconnect to the hub at once
    ],
)
def test_hub_that_works_is_not_hung(sign: Sign, seconds: float) -> None:
    assert longest_hub_silence_s(sign) == seconds


@pytest.mark.parametrize(
    ("silent", "total", "many"),
    [(0, 0, False), (1, 1, False), (1, 4, False), (2, 2, True), (2, 8, True), (2, 9, False), (24, 100, False)],
)
def test_when_many_are_silent(silent: int, total: int, many: bool) -> None:
    assert have_common_cause(silent, total) is many


@pytest.mark.parametrize("slept_s", [12.0, 3600.0, 1e6])
def test_sleep_of_the_computer_is_no_hang(slept_s: float) -> None:
    """Where the machine's clock counts the sleep (Windows). Elsewhere it stands still, and so does this one."""
    clock = WatchClock(100.0)
    before = clock.advance(100.1)
    assert clock.advance(100.1 + slept_s) - before <= MAX_POLL_GAP_S


def test_watchers_clock_stands_while_the_watcher_does() -> None:
    clock, now = WatchClock(100.0), 100.0
    for _ in range(10):
        now += 0.1
        assert clock.advance(now) == pytest.approx(now)
    began = clock.advance(now)
    now += 6.0
    assert clock.advance(now) == pytest.approx(began + MAX_POLL_GAP_S)
    assert clock.advance(now + 0.1) == pytest.approx(began + MAX_POLL_GAP_S + 0.1)


def test_blocked_spinning_and_gone_processes_are_told_apart(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        begun = wait_for(lambda: cpu_time.read(process.pid), "there is a process")
        wait_for(lambda: (read := cpu_time.read(process.pid)) and read.run_s > begun.run_s + 0.05, "it runs")
        freeze(process.pid)
        wait_for(lambda: _state(process.pid) == "T", "it stands")
        stood = cpu_time.read(process.pid)
        time.sleep(0.1)
        assert cpu_time.read(process.pid) == stood
        assert stood is not None
        assert not stood.ready
    finally:
        process.kill()
        process.wait()
    assert cpu_time.read(process.pid) is None


def test_without_proc_ps_tells_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cpu_time, "_PROC", tmp_path)
    read = cpu_time.read(os.getpid())
    assert read is not None
    assert read.run_s == pytest.approx(time.process_time(), abs=1.5), "Linux tells whole seconds"
    assert cpu_time.read(2**22 + 1) is None


def _state(pid: int) -> str:
    listed = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return listed.stdout[:1]

"""`make stress` resumes each process that it paused, and no process that a test has stopped."""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator

import psutil
import pytest

from tests.support.ports import FIRST, LAST, ports_of
from tests.support.processes import wait_for
from tests.tools.stress import CONTROL_PAUSE_S, PAUSE_S, Pauses, of_run

ONE_TEST = f"one-test-of-{os.getpid()}"
"""The name of a run. The tests of this file may run at the same time, in several workers."""


@pytest.fixture
def sleepers() -> Iterator[list[psutil.Process]]:
    """Start two processes that sleep."""
    started = [subprocess.Popen(["sleep", "600"], env={"STRESS_RUN": ONE_TEST}) for _ in range(2)]
    # Until its exec, a child still has the environment of its parent.
    wait_for(lambda: len(of_run(ONE_TEST, ())) == 2, "both can be found")
    yield [psutil.Process(each.pid) for each in started]
    for each in started:
        each.kill()
        each.wait()


def stopped(process: psutil.Process) -> bool:
    return bool(process.status() == psutil.STATUS_STOPPED)


def test_stress_resumes_paused_processes(sleepers: list[psutil.Process]) -> None:
    pauses = Pauses(random.Random(1), lambda: sleepers[:1])
    pauses.step(0.0)
    wait_for(lambda: stopped(sleepers[0]), "a pause")
    pauses.resume_all()
    wait_for(lambda: not stopped(sleepers[0]), "it goes on")
    assert pauses.count == 1
    assert PAUSE_S[0] <= pauses.total_s <= PAUSE_S[1]
    assert pauses.processes == {sleepers[0].pid}


def test_gateway_is_paused_for_less_than_a_stall() -> None:
    words = [sys.executable, "-c", "import time; time.sleep(600)", "gateway.cli", "run"]
    with subprocess.Popen(words) as process:
        pauses = Pauses(random.Random(1), lambda: [psutil.Process(process.pid)])
        for number in range(100):
            pauses.step(number * 10.0)
        pauses.resume_all()
        process.kill()
    assert pauses.count == 100
    assert pauses.total_s <= 100 * CONTROL_PAUSE_S[1]


def test_stress_leaves_stopped_process_stopped(sleepers: list[psutil.Process]) -> None:
    sleepers[0].send_signal(signal.SIGSTOP)
    wait_for(lambda: stopped(sleepers[0]), "it stands")
    pauses = Pauses(random.Random(1), lambda: sleepers[:1])
    for number in range(10):
        pauses.step(number * 1.0)
    pauses.resume_all()
    assert pauses.count == 0
    assert stopped(sleepers[0])


def test_stress_spares_given_processes(sleepers: list[psutil.Process]) -> None:
    assert of_run(ONE_TEST, {sleepers[0].pid}) == sleepers[1:]


def test_suites_that_run_at_once_share_no_port() -> None:
    parts = [ports_of(worker, 4, suite, 2) for suite in range(2) for worker in range(4)]
    assert sorted(port for part in parts for port in part) == list(range(FIRST, LAST + 1))

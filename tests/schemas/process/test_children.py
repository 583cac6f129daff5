"""Child processes are started, waited for and ended in one way."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import pytest

from schemas.process.children import end, leave, start_detached, wait
from tests.support.processes import LONG_S

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
READY = "print('ready', flush=True); input()"
DETACHED = "import os, time; print(os.getsid(0) == os.getpid(), os.read(0, 1), flush=True); time.sleep(600)"


@pytest.fixture
def program(request: pytest.FixtureRequest) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-c", request.param + READY]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


@pytest.mark.parametrize("program", [""], indirect=True)
def test_end_terminates_child(program: "subprocess.Popen[str]") -> None:
    assert wait(program, 0.0) is None
    assert end(program, LONG_S)
    assert wait(program, None) == -signal.SIGTERM
    assert end(program, LONG_S), "it has ended already"


@pytest.mark.parametrize("program", [STUBBORN], indirect=True)
def test_end_kills_child_that_ignores_sigterm(program: "subprocess.Popen[str]") -> None:
    assert not end(program, 0.1)
    assert program.returncode is not None


def test_detached_process_has_own_session_and_runs_on_without_warning() -> None:
    process = start_detached([sys.executable, "-c", DETACHED], output=subprocess.PIPE)
    assert process.stdout is not None
    with closing(process.stdout) as output:
        said = output.readline()
        pid = process.pid
        try:
            leave(process)
            del process  # a warning of the interpreter would be an error here
            os.kill(pid, 0)  # it still runs
        finally:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    assert said == "True b''\n", "it has a session of its own, and nothing to read"

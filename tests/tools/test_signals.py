"""Processes that tests start end by each signal, whatever the one who runs the tests ignores."""

import signal
import subprocess
import sys

import pytest

RUNNER = """
import os, signal, subprocess, sys
from tests.support.signals import give_default_signals
for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
give_default_signals()
number = signal.Signals(int(sys.argv[1]))
ends = f"import os; os.kill(os.getpid(), {number:d})"
child = subprocess.run([sys.executable, "-c", ends], stderr=subprocess.DEVNULL)
if number is not signal.SIGINT:
    os.kill(os.getpid(), number)
print(child.returncode)
"""


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_process_ends_by_a_signal_that_its_starter_ignores(number: signal.Signals) -> None:
    done = subprocess.run([sys.executable, "-c", RUNNER, str(int(number))], capture_output=True, text=True, check=True)
    assert int(done.stdout) == -number

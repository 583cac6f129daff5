"""A process that is interrupted during its start or end, or has no stdout, ends without a traceback."""

import subprocess
import sys

import pytest

AT_IMPORT = """
import signal, sys
wanted = sys.argv.pop(1)
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == wanted:
            del sys.meta_path[0]
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from {package}.__main__ import main
main()
"""
AT_EXIT = """
import atexit, signal
from {package}.__main__ import main
atexit.register(signal.raise_signal, signal.SIGINT)
main()
"""
NOWHERE = ("monitor", "tcp://127.0.0.1:9")
RUN = ("run", "--car", "red", "--link", "tcp://127.0.0.1:9", "--connect", "tcp/127.0.0.1:9")


@pytest.mark.parametrize(
    ("package", "imported", "arguments"),
    [
        ("gateway", "gateway.cli", RUN),
        ("gateway", "gateway.bus.car_service", RUN),
        ("gateway", "gateway.sim.cli", ("sim",)),
        ("gateway", "gateway.tools.monitor", ("monitor",)),
        ("fleet", "click", ("list",)),
        ("fleet", "fleet.commands.observe", ("list",)),
        ("fleet", "fleet.policy.lint.lint", ("check", "pyproject.toml")),
    ],
)
def test_interrupt_during_an_import_is_no_traceback(package: str, imported: str, arguments: tuple[str, ...]) -> None:
    program = AT_IMPORT.format(package=package)
    done = subprocess.run(
        [sys.executable, "-c", program, imported, *arguments], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "")


@pytest.mark.parametrize(("package", "arguments"), [("fleet", ("example", "list")), ("gateway", NOWHERE)])
def test_interrupt_during_the_exit_is_no_traceback(package: str, arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-c", AT_EXIT.format(package=package), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("package", ["fleet", "gateway"])
def test_help_without_stdout_is_a_failure_in_one_line(package: str) -> None:
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", package, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert done.stderr == f"{package}: the output cannot be written: Bad file descriptor\n"

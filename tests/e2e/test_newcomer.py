"""A newcomer's path: the README's commands, word for word, from a clone to three cars that do a plan."""

import os
import re
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.support.ports import free_endpoint
from tests.support.processes import wait_for

ROOT = Path(__file__).parents[2]
SECTION = "## From a clone to three cars doing a plan"
LEFT_OUT = (".git", ".venv", ".cache", ".tmp", ".state", "sessions", ".hypothesis", "*_cache", "__pycache__")


def blocks() -> tuple[list[str], list[str]]:
    """The commands of the first terminal, and of the second."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").partition(SECTION)[2].partition("\n## ")[0]
    first, second = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    return first.splitlines(), second.splitlines()


class NewcomersTerminal:
    """A shell in the clone: each command is a line of the README, and must succeed."""

    def __init__(self, clone: Path, environment: dict[str, str]) -> None:
        self._where: dict[str, Any] = {"cwd": clone, "env": environment, "text": True}
        self._activated = ""

    def run(self, command: str) -> str:
        """Run a command to its end; what it printed."""
        if command.startswith(". "):
            self._activated = f"{command}; "
            return ""
        done = subprocess.run(
            ["bash", "-c", self._activated + command], capture_output=True, timeout=600, check=False, **self._where
        )
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        return str(done.stdout)

    def start(self, command: str, out: Path) -> "subprocess.Popen[str]":
        """Run a command that stays, in a process group of its own."""
        with out.open("w", encoding="utf-8") as file:
            arguments = ["bash", "-c", f"{self._activated}exec {command}"]
            return subprocess.Popen(arguments, stdout=file, start_new_session=True, **self._where)


def walk(clone: Path, tmp_path: Path) -> None:
    """Both terminals, line by line; `clone` is where `git clone` would have put it."""
    environment = {**os.environ, "FLEET_ENDPOINT": free_endpoint(), "FLEET_STATE_DIR": str(tmp_path / "state")}
    first, second = blocks()
    assert first[0].startswith("git clone "), "what the copy stands for"
    assert first[1] == "cd zenoh-car-fleet"
    terminal, other, log = (
        NewcomersTerminal(clone, environment),
        NewcomersTerminal(clone, environment),
        tmp_path / "up.txt",
    )
    for command in first[2:-1]:
        terminal.run(command)
    up = terminal.start(first[-1], log)
    try:
        for words in ("role patrol: 2 of 2", "role guide: 1 of 1", "mode tracking, confirmed"):
            wait_for(lambda words=words: words in log.read_text(), words, 90.0)
        told = [(command, other.run(command)) for command in second]
        assert up.wait(60) == 0, log.read_text()
    finally:
        if up.poll() is None:
            os.killpg(up.pid, signal.SIGTERM)
            up.wait(60)
    said = dict(told)
    assert [line.split()[0] for line in said["fleet list"].splitlines()[1:]] == ["blue", "green", "red"]
    before, after = (text for command, text in told if command == "fleet why red")
    assert re.search(r"because:   role (guide \(1 of 1\)|patrol \(2 of 2\))", before), before
    assert "is on hold by" in after
    assert "complete" in said["fleet stop red"]
    assert "red: stopped" in said["fleet down"]
    assert (clone / "session.rrd").stat().st_size > 10_000


def copied(tmp_path: Path) -> Path:
    """This checkout as a clone has it, without what its commands make."""
    clone = tmp_path / "zenoh-car-fleet"
    shutil.copytree(ROOT, clone, ignore=shutil.ignore_patterns(*LEFT_OUT))
    return clone


@pytest.mark.timeout(600)  # 40 s on a machine that does nothing else, 100 s on a busy one
def test_the_readmes_path_word_for_word(tmp_path: Path) -> None:
    """With the virtual environment of this checkout."""
    clone = copied(tmp_path)
    (clone / ".venv").symlink_to(ROOT / ".venv")
    for name in ("pyproject.toml", "constraints.txt"):
        os.utime(clone / name, (0, 0))  # nothing is to be set up: what runs this test is
    walk(clone, tmp_path)


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_the_readmes_path_on_a_machine_that_has_nothing(tmp_path: Path) -> None:
    """Its first command sets everything up."""
    walk(copied(tmp_path), tmp_path)

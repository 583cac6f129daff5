"""A newcomer's path: the commands and programs of the README and the tutorials, word for word, on one running fleet.

NOT_RUN has the commands that do not run, with their reasons. The tutorials share one fleet of three simulated cars,
because each start of a process takes seconds.
"""

import ast
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.e2e.test_wheel import Environment
from tests.support.message_length import too_long
from tests.support.processes import wait_for

ROOT: Final = Path(__file__).parents[2]
README: Final = ROOT / "README.md"
FIRST: Final = ROOT / "docs/tutorials/1-three-simulated-cars.md"
OWN_CAR: Final = ROOT / "docs/tutorials/2-your-first-car.md"
PLAN: Final = ROOT / "docs/tutorials/3-two-cars-one-plan.md"
PYTHON: Final = ROOT / "docs/tutorials/4-sensors-from-python.md"
DRIVE: Final = ROOT / "docs/how-to/drive-from-python.md"
TRIED: Final = (README, FIRST, OWN_CAR, PLAN, PYTHON, DRIVE)

LEFT_OUT: Final = (".git", ".venv", ".cache", ".tmp", ".state", "sessions", ".hypothesis", "*_cache", "__pycache__")

NOT_RUN: Final = {
    "git clone https://github.com/zenoh-car-fleet/zenoh-car-fleet.git": "this checkout is the clone",
    "cd zenoh-car-fleet": "likewise",
    "make demo": "tests/fleet/test_demo.py runs `fleet demo`; the soak runs it on a machine that has nothing",
    "make test": "this is it",
    "uv tool install '.[all]'": "tests/e2e/test_wheel.py installs the wheel",
    "fleet demo": "tests/fleet/test_demo.py runs it",
    "mkdir my-cars && cd my-cars": "the tutorial has the same in two lines",
    "fleet scan": "needs cars, and a radio",
    "fleet init": "asks for the names of cars that are there; tests of `fleet init` answer it",
    "fleet check": "for the cars of `fleet init`",
    "fleet up": "stays; here `fleet up --detach` runs",
    "fleet up --sim 3 --plan plan.yaml": "likewise",
    "fleet up --sim 3 --detach": "the fleet of the first tutorial is up",
    "fleet up --sim 2 --plan plan.yaml --detach": "likewise",
    "fleet replay latest": "opens a window; here it writes a file",
}
"""Commands of README and tutorials that this test does not run, with the reasons."""

DIFFERENCES: Final = {"fleet plan try latest plan.yaml": 1}
"""Commands with a second exit code. The tutorial's plan may decide differently from the recorded plans."""

Block = tuple[str, str, str]
"""A block of code: its language, its title and its text."""


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page."""
    text = page.read_text(encoding="utf-8")
    yield from re.findall(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


def commands(body: str) -> list[str]:
    """Return the commands of a block, without comments."""
    return [words for line in body.splitlines() if (words := re.sub(r"\s+# .*|^#.*", "", line).strip())]


class Newcomer:
    """A person in a directory: types commands, saves files, runs programs."""

    def __init__(self, place: Path, environment: dict[str, str]) -> None:
        self.place = place
        self.typed: set[str] = set()
        self._environment = environment

    def type(self, command: str) -> str:
        """Run a command that must succeed; return what it printed."""
        self.typed.add(command)
        if command.startswith("cd "):
            self.place = self.place / command.removeprefix("cd ")
            return ""
        done = self._run(command)
        if command == "fleet stop" and "[not_shown]" in done.stderr:
            # On a busy machine, a simulated car reports late, and its stop is not shown in time. A person asks again.
            done = self._run(command)
        assert done.returncode in (0, DIFFERENCES.get(command)), (command, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr, done.stderr
        assert too_long(done.stderr) == [], command
        return done.stdout

    def succeeds(self, command: str) -> bool:
        """Return True if a command succeeds."""
        return self._run(command).returncode == 0

    def _run(self, command: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            ["bash", "-c", command],
            capture_output=True,
            timeout=280,
            check=False,
            cwd=self.place,
            env=self._environment,
            text=True,
        )

    def glance(self, program: str) -> str:
        """Run a program that does not end until it prints a line; return that line."""
        with subprocess.Popen(
            ["bash", "-c", 'exec python -u -c "$0"', program],
            stdout=subprocess.PIPE,
            cwd=self.place,
            env=self._environment,
            text=True,
        ) as process:
            assert process.stdout is not None
            line = process.stdout.readline()
            process.terminate()
        return line

    def follow(self, *of: Block) -> dict[str, str]:
        """Save files, run programs, type commands; return what each command printed."""
        printed: dict[str, str] = {}
        for language, title, body in of:
            if title:
                (self.place / title).write_text(body, encoding="utf-8")
            if language == "python" and title:
                printed[title] = self.type(f"python {title}")
            for command in commands(body) if language == "sh" else ():
                if command not in NOT_RUN:
                    printed[command] = self.type(command)
        return printed


def until(of: list[Block], word: str) -> tuple[list[Block], list[Block]]:
    """Return the blocks before the first one with this word, and the others."""
    at = next(index for index, (language, _, body) in enumerate(of) if language == "sh" and word in body)
    return of[:at], of[at:]


@pytest.mark.timeout(600)
def test_readme_and_the_tutorials_word_for_word(tmp_path: Path) -> None:
    """The commands run from the wheel with all its extras, outside the clone."""
    here = Environment(tmp_path)
    for extra in ("view", "ble", "analysis"):
        here.install(extra)
    newcomer = Newcomer(here.home, here.variables)
    first, end = until(list(blocks(FIRST)), "fleet down")
    plan, plan_end = until(list(blocks(PLAN)), "fleet down")
    programs, plot = until(list(blocks(PYTHON)), "fleet down")
    readme, export = until(list(blocks(README)), "fleet sessions export")
    start, first = until(first, "fleet list")
    newcomer.follow(*start)
    # A person types slower than a busy machine starts the coordinator.
    wait_for(lambda: newcomer.succeeds("fleet why"), "a plan in force", 120.0)
    printed = newcomer.follow(*first)
    try:
        assert [line.split()[0] for line in printed["fleet list"].splitlines()[1:]] == ["blue", "green", "red"]
        assert "on hold" in printed["fleet why red"] or "stopped" in printed["fleet why red"]
        others, explained = until(readme, "fleet why red")
        newcomer.follow(*plan, *explained)
        newcomer.type("fleet plan stop")  # the fleet of the next tutorial has no plan
        told = newcomer.follow(*programs)
        assert "'blue', 'green', 'red'" in told["latest.py"]
        assert len(told["stream.py"].splitlines()) == 5
        (watch,) = (body for language, title, body in others if language == "python")
        assert newcomer.glance(watch).split()[0] in ("red", "green", "blue")
        newcomer.follow(*others)
        (own,) = (body for _, _, body in blocks(OWN_CAR) if "fleet drive" in body)
        new = [command for command in commands(own) if command not in newcomer.typed]
        newcomer.follow(("sh", "", "\n".join(new)), *blocks(DRIVE))
    finally:
        down = newcomer.type("fleet down")
    assert all(car in down for car in ("red", "green", "blue"))
    newcomer.follow(
        *((kind, title, body.replace("fleet down\n", "")) for kind, title, body in (*end, *plan_end, *export, *plot))
    )
    assert (newcomer.place / "session.rrd").stat().st_size > 10_000
    assert (newcomer.place / "distance.png").stat().st_size > 1_000
    assert list((newcomer.place / "tables").glob("*.csv"))
    every = {
        command
        for page in TRIED
        for language, _, body in blocks(page)
        if language == "sh"
        for command in commands(body)
    }
    assert every - newcomer.typed == set(NOT_RUN), "neither run, nor in the list with a reason"


def test_each_docs_program_runs_or_compiles() -> None:
    """Programs with a name run above. Programs without a name are fragments."""
    for page in (README, *(ROOT / "docs").rglob("*.md")):
        for language, title, body in blocks(page):
            if language == "python":
                assert not title or page in TRIED, f"{page.name}: {title} is not run"
                compile(body, str(page), "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_make_demo_on_a_machine_that_has_nothing(tmp_path: Path) -> None:
    """`make demo` installs everything with its first command."""
    clone = tmp_path / "zenoh-car-fleet"
    shutil.copytree(ROOT, clone, ignore=shutil.ignore_patterns(*LEFT_OUT))
    done = subprocess.run(["make", "demo"], cwd=clone, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, (done.stdout, done.stderr)
    assert re.search(r"(\d+) of \1 checks passed", done.stdout)

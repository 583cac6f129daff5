"""The wheel in an empty environment, outside the clone: without an extra, then with `console` and `view`."""

import shutil
import signal
import subprocess
import sys
import urllib.request
import venv
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.support.ports import free_endpoint

ROOT = Path(__file__).parents[2]
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


def wheel(directory: Path) -> Path:
    """Build the wheel from a copy of the clone."""
    source = directory / "source"
    for name in ("fleet", "gateway", "schemas"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    subprocess.run([sys.executable, "-c", BUILD, str(directory)], cwd=source, check=True, capture_output=True)
    (built,) = directory.glob("*.whl")
    return built


def required(requirements: list[str], extra: str = "") -> Iterator[metadata.Distribution]:
    """Yield the distributions that these requirements need, directly or not."""
    for requirement in map(Requirement, requirements):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        found = metadata.distribution(requirement.name)
        assert found.version in requirement.specifier, requirement
        yield found
        yield from required(found.requires or [])


class Environment:
    """A virtual environment with the wheel, and with links to the installed packages that the wheel requires."""

    def __init__(self, directory: Path) -> None:
        self._bin = directory / "venv" / "bin"
        self.home = directory / "home"
        self.home.mkdir()
        venv.create(directory / "venv", with_pip=False)
        pip = [sys.executable, "-m", "pip", "--python", str(self._bin / "python"), "--disable-pip-version-check"]
        arguments = ["install", "--quiet", "--no-deps", "--no-index", "--no-compile", str(wheel(directory))]
        subprocess.run([*pip, *arguments], check=True)
        (self.packages,) = (directory / "venv").glob("lib/python*/site-packages")
        (self.metadata,) = self.packages.glob("zenoh_car_fleet-*.dist-info")
        self.install()
        self.variables = {
            "PATH": f"{self._bin}:/usr/bin:/bin",
            "HOME": str(self.home),
            "FLEET_ENDPOINT": free_endpoint(),
            "FLEET_STATE_DIR": str(directory / "state"),
            "COLUMNS": "200",
        }

    def install(self, extra: str = "") -> None:
        """Make the requirements of the wheel with this extra importable."""
        for each in required(metadata.PathDistribution(self.metadata).requires or [], extra):
            for name in {file.parts[0] for file in each.files or ()} - {"..", "__pycache__"}:
                if not (self.packages / name).exists():
                    (self.packages / name).symlink_to(Path(str(each.locate_file(name))))

    def run(self, command: str) -> "subprocess.CompletedProcess[str]":
        """Run a command as a user would type it."""
        return subprocess.run(
            ["bash", "-c", command], cwd=self.home, env=self.variables, capture_output=True, text=True, check=False
        )

    def succeeds(self, command: str) -> str:
        """Run a command that must succeed with an empty stderr. Return its stdout."""
        done = self.run(command)
        assert (done.returncode, done.stderr) == (0, ""), (command, done.stdout, done.stderr)
        return done.stdout

    def served(self, *paths: str) -> list[bytes]:
        """Start the console, read these paths of it, and end it. Return their contents."""
        words = ["fleet", "console", "--port", "0"]
        with subprocess.Popen(words, cwd=self.home, env=self.variables, stdout=subprocess.PIPE) as console:
            try:
                assert console.stdout is not None
                address = console.stdout.readline().split()[1].decode()
                found = [urllib.request.urlopen(address + path, timeout=30).read() for path in paths]
            finally:
                console.send_signal(signal.SIGINT)
        assert console.returncode == 0
        return found


@pytest.mark.timeout(240)
def test_first_minutes_from_the_wheel(tmp_path: Path) -> None:
    here = Environment(tmp_path)
    extras = ("rerun", "pyarrow", "numpy", "PIL", "bleak", "uvicorn", "starlette")
    hidden = f"for module in {extras}: assert not find_spec(module), module"
    here.succeeds(f'python -c "from importlib.util import find_spec\n{hidden}"')
    assert "1-patrol" in here.succeeds("fleet example list")
    assert "fleet up" in here.succeeds("fleet init --sim 3")
    here.succeeds("fleet check")
    here.succeeds("fleet check plan.yaml")
    try:
        assert "All 3 cars are ready" in here.succeeds("fleet up --detach")
        here.succeeds("fleet wait --ready")
        here.succeeds("fleet drive red forward --for 0.3s")
        script = "from fleet import Fleet; fleet = Fleet(); print(*fleet.cars()); fleet.close()"
        assert here.succeeds(f'python -c "{script}"') == "blue green red\n"
        refused = here.run("fleet replay latest --save x.rrd")
        assert (refused.returncode, refused.stdout) == (1, "")
        assert refused.stderr.endswith("(from a clone: pip install '.[view]')\n")
        assert refused.stderr.count("\n") == 1
        refused = here.run("fleet console")
        assert (refused.returncode, refused.stdout) == (1, "")
        assert refused.stderr.endswith("(from a clone: pip install '.[console]')\n")
        here.install("console")
        page, code = here.served("/", "/static/app.js")
        assert b"/static/app.js" in page
        assert b"import" in code
    finally:
        down = here.run("fleet down")
    assert down.returncode == 0, down.stderr
    ended = sorted(line.partition(",")[0].partition(":") for line in down.stdout.splitlines())
    assert [car for car, _, _ in ended] == ["blue", "green", "red"]
    assert {words.strip() for _, _, words in ended} <= {"stopped", "stop sent"}
    here.succeeds("fleet sessions verify")
    here.install("view")
    here.succeeds("fleet replay latest --save x.rrd")
    assert (here.home / "x.rrd").stat().st_size > 10_000

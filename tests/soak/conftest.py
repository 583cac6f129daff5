"""Fixtures of the soaks."""

import shutil
import subprocess
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.fleet.console.test_server import ServerStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

CACHE = Path(__file__).parents[2] / ".cache"


@pytest.fixture(scope="session")
def zenohd() -> Path:
    """Return a stock Zenoh router. It is built from crates.io if it is not there, in ten minutes of a processor."""
    number = version("eclipse-zenoh")
    place = CACHE / f"zenohd-{number}"
    program = place / "bin/zenohd"
    if not program.exists():
        cargo = shutil.which("cargo")
        assert cargo, "this soak builds zenohd with cargo, of Rust"
        install = ["nice", cargo, "install", "zenohd", "--version", number, "--locked", "--debug", "--root", str(place)]
        subprocess.run(install, check=True)
    return program


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[ServerStage]:
    """Serve a console of six cars in the network."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        yield ServerStage(fleet, "blue", "green", "black", "white", "pink")
    finally:
        fleet.close()

"""Fixtures of the soaks."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.console.test_server import ServerStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[ServerStage]:
    """Serve a console of six cars in the network."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        yield ServerStage(fleet, "blue", "green", "black", "white", "pink")
    finally:
        fleet.close()

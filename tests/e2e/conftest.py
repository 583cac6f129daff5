"""Fixtures of the tests on real processes."""

from collections.abc import Iterator

import pytest

from tests.support.console import ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, TcpCar


@pytest.fixture
def tcp_car() -> Iterator[TcpCar]:
    car = TcpCar()
    yield car
    car.close()


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    """Serve a console for the tests of a module."""
    started = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    yield started
    started.close()


@pytest.fixture
def stage(stages: ConsoleStage) -> Iterator[ConsoleStage]:
    """Bring the console of the module to rest after each test."""
    yield stages
    stages.rest()

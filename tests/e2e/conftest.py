"""Fixtures of the tests on real processes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, TcpCar


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[FleetProcesses]:
    started = FleetProcesses(free_endpoint(), tmp_path)
    yield started
    started.close()


@pytest.fixture
def tcp_car() -> Iterator[TcpCar]:
    car = TcpCar()
    yield car
    car.close()

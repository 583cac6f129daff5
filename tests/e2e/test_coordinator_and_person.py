"""A coordinator never moves a car that a person has stopped, also after restarts of coordinator and gateway."""

from pathlib import Path

from tests.support.authority import want_for_ever
from tests.support.processes import FleetProcesses


def test_stopped_car_stays_stopped_over_gateway_and_coordinator_restarts(fleet: FleetProcesses, tmp_path: Path) -> None:
    assert want_for_ever(fleet, tmp_path, ["gateway and coordinator"]) == []

"""A fleet of real processes for the tests of a module: three simulated cars with their gateways, all at rest."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fleet.client.outcome import NotCarriedOut, Outcome
from tests.support.ports import free_endpoint
from tests.support.processes import LONG_S, FleetProcesses, GatewayProcess, wait_for

CARS = {"red": "arduino", "green": "raspberry_pi", "blue": "raspberry_pi"}


class Cars(FleetProcesses):
    """Red, green and blue."""

    def __init__(self, endpoint: str, directory: Path) -> None:
        super().__init__(endpoint, directory)
        # Links with names: a lost one comes back at the same path.
        specs = (f"{car}:{platform}:pty:{directory / car}.tty" for car, platform in CARS.items())
        self.sim, links = self.simulate(*specs)
        self.links = dict(zip(CARS, links, strict=True))
        self.gateways: dict[str, GatewayProcess] = {car: self.serve(car) for car in CARS}
        for car in CARS:
            self.ready(car)

    def serve(self, car: str) -> GatewayProcess:
        """Start the gateway of a car."""
        return self.gateway(self.links[car], "--longest-drive", f"{LONG_S:g}", car=car, platform=CARS[car])


@contextmanager
def running(command: list[str]) -> "Iterator[subprocess.Popen[str]]":
    """Run a process that ends with the block, also if an assertion fails. Otherwise the exit would wait for it."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def asked(drive: Callable[[], Outcome]) -> Outcome:
    """Return the outcome of a drive. If the drive was stale at its arrival, send it again, as the message says."""
    while True:
        try:
            outcome = drive()
        except NotCarriedOut as refused:
            outcome = refused.outcome
            if outcome.reason != "stale":
                raise
        if outcome.reason != "stale":
            return outcome


@pytest.fixture(scope="module")
def cars(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cars]:
    fleet = Cars(free_endpoint(), tmp_path_factory.mktemp("fleet"))
    try:
        yield fleet
    finally:
        fleet.close()


@pytest.fixture(autouse=True)
def nobody_has_a_car(request: pytest.FixtureRequest) -> None:
    """Release all cars. The last driver has a lease for two seconds more, and a lower rank would be rejected."""
    if "cars" in request.fixturenames:
        cars: Cars = request.getfixturevalue("cars")

        def free() -> bool:
            states = cars.get("fleet/*/state/safety")
            leased = [each.car for each in states if not isinstance(each, str) and each.HasField("lease")]
            for car in leased:  # a person takes the car, and releases it at once
                for what in ({"take": True}, {"release": True}):
                    cars.ask_all("lease", car, sender="between-tests", kind="person", **what)
            return not leased and not any(isinstance(each, str) for each in states)

        wait_for(free, "nobody drives")

"""A whole gateway in the test's own process, so that the test can stall its loop or own its clock."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from gateway.bus.car_service import CarService
from gateway.car_gateway import CarGateway, Settings
from gateway.link import parse_url
from schemas import bus
from schemas.process.computer_sleep import SleepWatch
from tests.support.processes import FleetProcesses


@contextlib.asynccontextmanager
async def served(
    fleet: FleetProcesses, link: str, state_dir: Path, *, platform: str = "arduino", watch: SleepWatch | None = None
) -> AsyncIterator[tuple[CarGateway, "asyncio.Future[bool]"]]:
    """Serve the car `red` of this fleet. Yield its gateway and what ends with it."""
    with bus.Bus.open(fleet.endpoint) as opened:
        settings = Settings("red", parse_url(link), platform, fleet="fleet", state_dir=state_dir, retry=True)
        gateway = CarGateway(settings, opened, CarService(opened, "fleet", "red"), watch)
        serving = asyncio.ensure_future(gateway.run())
        try:
            yield gateway, serving
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

"""Tests of a whole gateway in the test's own process, with a real bus and a TCP car. The test can stall its loop."""

import asyncio
import time
from pathlib import Path
from typing import Any

from gateway.bus.service import CarService
from gateway.car import CarGateway, Settings
from gateway.link import parse_url
from gateway.protocol.platforms import parse_platform
from schemas import bus
from tests.support.ports import free_endpoint
from tests.support.processes import MODE00, REPORT, REPORT_S, FleetProcesses, TcpCar, wait_for


async def test_reports_that_a_stalled_loop_reads_late_show_no_stop(tmp_path: Path) -> None:
    """The car obeys one `MODE00`, but not the next. The loop stalls until the gap of reports looks like a pause."""
    fleet, car = FleetProcesses(free_endpoint(), tmp_path), TcpCar()
    shown: list[int] = []

    def listen(sample: bus.Sample) -> None:
        said: Any = sample.message()
        if (said.motors, said.motors_basis) == ("off", "shown"):
            shown.append(car.received.count(MODE00))

    async def until_closed(count: int) -> None:
        await asyncio.to_thread(wait_for, lambda: car.received.count(MODE00) >= count, f"{count} MODE00 have come")

    fleet.bus.subscribe("fleet/red/state/safety", listen)
    with bus.Bus.open(fleet.endpoint) as opened:
        settings = Settings(
            "red", parse_url(car.link), parse_platform("arduino"), auto=False, fleet="fleet", state_dir=tmp_path,
            retry=True,
        )  # fmt: skip
        gateway = CarGateway(settings, opened, CarService(opened, "fleet", "red"))
        serving = asyncio.ensure_future(gateway.run())
        try:
            await until_closed(1)
            car.obey()
            await until_closed(3)  # after the first pause the gateway writes the next MODE00 at once
            time.sleep(REPORT_S)  # noqa: ASYNC251 - the loop stalls
            car.send(REPORT)  # as if the car had not received MODE00
            time.sleep(2.2 - REPORT_S)  # noqa: ASYNC251
            await asyncio.to_thread(wait_for, lambda: shown or car.received.count(MODE00) > 3, "it goes on")
            assert not shown, "one pause is no evidence"
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            car.close()
            fleet.close()


async def test_a_line_of_text_is_no_reading_and_no_damage(tmp_path: Path) -> None:
    fleet, car = FleetProcesses(free_endpoint(), tmp_path), TcpCar()
    verdicts: list[str] = []
    links: list[Any] = []

    def listen(sample: bus.Sample) -> None:
        frame: Any = sample.message()
        verdicts.append(frame.verdict)

    fleet.bus.subscribe("fleet/red/frame/rx", listen)
    fleet.bus.subscribe("fleet/red/state/link", lambda sample: links.append(sample.message()))
    with bus.Bus.open(fleet.endpoint) as opened:
        settings = Settings(
            "red", parse_url(car.link), parse_platform("arduino+text"), auto=False, fleet="fleet", state_dir=tmp_path,
            retry=True,
        )  # fmt: skip
        serving = asyncio.ensure_future(CarGateway(settings, opened, CarService(opened, "fleet", "red")).run())
        try:
            await asyncio.to_thread(wait_for, lambda: car.received.count(MODE00) >= 1, "it has connected")
            for count in range(1, 4):
                car.send(b"EXEC:F\r\n")
                await asyncio.to_thread(wait_for, lambda count=count: len(verdicts) >= count, "the line has come")
            links.clear()
            await asyncio.to_thread(wait_for, lambda: links, "the state of the link")
            assert verdicts == ["text"] * 3
            assert dict(links[-1].rejects) == {"text": 3}
            assert links[-1].state != "online"
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            car.close()
            fleet.close()

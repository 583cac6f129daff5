"""Tests of a whole gateway in the test's own process, with a real bus and a TCP car. The test can stall its loop."""

import asyncio
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from schemas import bus
from tests.support.gateway_here import served
from tests.support.ports import free_endpoint
from tests.support.processes import MODE00, REPORT, REPORT_S, FleetProcesses, TcpCar, wait_for


@pytest.fixture
def car() -> Iterator[TcpCar]:
    car = TcpCar()
    yield car
    car.close()


async def test_reports_that_a_stalled_loop_reads_late_show_no_stop(
    fleet: FleetProcesses, car: TcpCar, tmp_path: Path
) -> None:
    """The car obeys one `MODE00`, but not the next. The loop stalls until the gap of reports looks like a block gap."""
    shown: list[int] = []

    def listen(sample: bus.Sample) -> None:
        said: Any = sample.message()
        if (said.motors, said.motors_basis) == ("off", "shown"):
            shown.append(car.received.count(MODE00))

    async def until_closed(count: int) -> None:
        await asyncio.to_thread(wait_for, lambda: car.received.count(MODE00) >= count, f"{count} MODE00 have come")

    fleet.bus.subscribe("fleet/red/state/safety", listen)
    async with served(fleet, car.link, tmp_path):
        await until_closed(1)
        car.obey()
        await until_closed(3)  # after the first block gap the gateway writes the next MODE00 at once
        time.sleep(REPORT_S)  # noqa: ASYNC251 - the loop stalls
        car.send(REPORT)  # as if the car had not received MODE00
        time.sleep(2.2 - REPORT_S)  # noqa: ASYNC251
        await asyncio.to_thread(wait_for, lambda: shown or car.received.count(MODE00) > 3, "it goes on")
        assert not shown, "one block gap is no evidence"


async def test_line_of_text_is_no_reading_and_no_damage(fleet: FleetProcesses, car: TcpCar, tmp_path: Path) -> None:
    verdicts: list[str] = []
    links: list[Any] = []

    def listen(sample: bus.Sample) -> None:
        frame: Any = sample.message()
        verdicts.append(frame.verdict)

    fleet.bus.subscribe("fleet/red/frame/rx", listen)
    fleet.bus.subscribe("fleet/red/state/link", lambda sample: links.append(sample.message()))
    async with served(fleet, car.link, tmp_path, platform="arduino+text"):
        await asyncio.to_thread(wait_for, lambda: car.received.count(MODE00) >= 1, "it has connected")
        for count in range(1, 4):
            car.send(b"EXEC:F\r\n")
            await asyncio.to_thread(wait_for, lambda count=count: len(verdicts) >= count, "the line has come")
        links.clear()
        await asyncio.to_thread(wait_for, lambda: links, "the state of the link")
        assert verdicts == ["text"] * 3
        assert dict(links[-1].rejects) == {"text": 3}
        assert links[-1].state != "online"


async def test_readings_with_detected_head_are_read(fleet: FleetProcesses, car: TcpCar, tmp_path: Path) -> None:
    ranges: list[Any] = []
    fleet.bus.subscribe("fleet/red/sensor/range", lambda sample: ranges.append(sample.message()))
    async with served(fleet, car.link, tmp_path, platform="auto"):
        await asyncio.to_thread(wait_for, lambda: car.received, "it has connected")
        car.obey(REPORT.replace(b"4WD", b"BALA"))
        await asyncio.to_thread(wait_for, lambda: b"$BALA,MODE00#" in car.received, "a stop with its own head")
        await asyncio.to_thread(wait_for, lambda: ranges, "a reading")
        await asyncio.to_thread(wait_for, lambda: fleet.state("health").platform == "arduino+head=BALA", "its platform")


async def test_lost_hub_of_another_computer_is_logged_once(
    car: TcpCar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The hub may be away for a weekend, and the gateway tries every second or three."""
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")  # no loopback address by its name
    tries: list[str] = []

    def count(where: str) -> None:
        tries.append(where)
        ensure_hub(where)

    ensure_hub = bus.ensure_hub
    monkeypatch.setattr(bus, "ensure_hub", count)

    @contextmanager
    def running_hub() -> Iterator[None]:
        command = [sys.executable, "-m", "schemas.bus.hub", "--endpoint", endpoint, "--insecure-lan"]
        hub = subprocess.Popen(command)
        try:
            wait_for(lambda: bus.accepts(endpoint), "the hub listens")
            yield
        finally:
            hub.kill()
            hub.wait()

    async def until_tried(times: int) -> None:
        await asyncio.to_thread(wait_for, lambda: len(tries) >= times, "the gateway has tried to reach the hub")

    def logged() -> int:
        return sum("[no_hub]" in record.getMessage() for record in caplog.records)

    async with AsyncExitStack() as stack:
        with running_hub():
            fleet = FleetProcesses(endpoint, tmp_path)
            stack.callback(fleet.close)
            gateway, _ = await stack.enter_async_context(served(fleet, car.link, tmp_path))
        await until_tried(4)
        assert logged() == 1
        with running_hub():
            await asyncio.to_thread(wait_for, lambda: not gateway._no_hub, "the gateway is back")
        await until_tried(len(tries) + 3)
        assert logged() == 2

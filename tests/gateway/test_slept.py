"""A whole gateway in the test's own process. The test owns the clock that counts the sleeps of the computer."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from schemas import bus
from schemas.process.computer_sleep import SleepWatch
from tests.support.gateway_here import served
from tests.support.judge import Judge
from tests.support.ports import free_endpoint
from tests.support.processes import MODE00, FleetProcesses, TcpCar, wait_for

RUN = b"$1,0,0,0,0,0,0,0,0#"
STOPS = (MODE00, b"$0,0,0,0,0,0,0,0,0#")


class SleepingLaptop:
    """A computer that sleeps when the test says so."""

    def __init__(self) -> None:
        self.slept_s = 0.0
        self.watch = SleepWatch((lambda: time.monotonic() + self.slept_s, time.monotonic))


@contextlib.asynccontextmanager
async def standing(tmp_path: Path, computer: SleepingLaptop) -> AsyncIterator[tuple[FleetProcesses, TcpCar, list[str]]]:
    """Serve a car that has shown that it stands. Yield its fleet, the car, and the codes of its log."""
    fleet, car, codes = FleetProcesses(free_endpoint(), tmp_path), TcpCar(), list[str]()

    def listen(sample: bus.Sample) -> None:
        entry: Any = sample.message()
        codes.append(entry.name.removeprefix("red "))

    fleet.bus.subscribe("fleet/red/event/log", listen)
    try:
        async with served(fleet, car.link, tmp_path, watch=computer.watch):
            await asyncio.to_thread(wait_for, lambda: MODE00 in car.received, "it is stopped at the connect")
            car.obey()
            await asyncio.to_thread(wait_for, lambda: "recovered" in codes, "it stands")
            yield fleet, car, codes
    finally:
        car.close()
        fleet.close()


async def test_car_that_drove_through_sleep_is_stopped_first(tmp_path: Path) -> None:
    computer = SleepingLaptop()
    async with standing(tmp_path, computer) as (fleet, car, codes):
        driven = await asyncio.to_thread(fleet.ask, "drive", motion="forward", duration_s=10)
        assert driven["status"] in ("queued", "sent")
        await asyncio.to_thread(wait_for, lambda: RUN in car.received, "it drives")
        before = len(car.received)
        computer.slept_s += 3600.0
        late = await asyncio.to_thread(fleet.ask, "drive", motion="back", duration_s=10)
        assert (late["status"], late["reason"]) == ("rejected", "stale"), "it may be from before the sleep"
        await asyncio.to_thread(wait_for, lambda: len(car.received) > before, "a frame after the sleep")
        assert car.received[before] in STOPS
        await asyncio.to_thread(wait_for, lambda: "slept" in codes, "it says that it slept")
        safety = await asyncio.to_thread(fleet.state, "safety")
        assert not safety.HasField("lease")
        assert RUN not in car.received[before:]


async def test_sleep_is_noticed_without_any_command_or_reading(tmp_path: Path) -> None:
    computer = SleepingLaptop()
    async with standing(tmp_path, computer) as (_, _, codes):
        computer.slept_s += 60.0
        await asyncio.to_thread(wait_for, lambda: "slept" in codes, "it says that it slept")
        assert codes.count("slept") == 1


async def test_ages_of_claims_include_sleep(tmp_path: Path) -> None:
    """A car that stood before the sleep showed that an hour ago, not just now."""
    computer = SleepingLaptop()
    async with standing(tmp_path, computer) as (fleet, _, codes):
        computer.slept_s += 3600.0
        await asyncio.to_thread(wait_for, lambda: "slept" in codes, "it says that it slept")
        for name, field in (
            ("safety", "shown_age_s"),
            ("safety", "trust_since_s"),
            ("link", "since_s"),
            ("mode", "since_s"),
            ("health", "uptime_s"),
        ):
            await asyncio.to_thread(
                wait_for, lambda name=name, field=field: getattr(fleet.state(name), field) > 3600.0, f"{name} {field}"
            )
        safety = await asyncio.to_thread(fleet.state, "safety")
        assert (safety.motors, safety.motors_basis) == ("off", "shown")


async def test_true_motors_stop_after_a_sleep_and_stay_off(tmp_path: Path) -> None:
    """The car does not sleep: it drives on meanwhile."""
    laptop = SleepingLaptop()
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    judge = Judge.follow(fleet.bus)
    _, (link,) = await asyncio.to_thread(fleet.simulate, "red:arduino:tcp", truth=True)
    try:
        async with served(fleet, link, tmp_path, watch=laptop.watch) as (gateway, serving):
            await asyncio.to_thread(fleet.ready)
            await asyncio.to_thread(fleet.ask, "drive", motion="forward", duration_s=10)
            await asyncio.to_thread(wait_for, lambda: judge.driving, "it drives")
            laptop.slept_s += 3600.0
            woke_at = time.monotonic()
            await asyncio.to_thread(wait_for, lambda: not judge.driving, "it stands")
            assert time.monotonic() < woke_at + 5.0, "long before the end of its drive"
            safety = await asyncio.to_thread(wait_for, lambda: fleet.state("safety"), "its state")
            assert not safety.HasField("lease")
            gateway.stop()
            await serving
            assert not judge.driving
    finally:
        fleet.close()

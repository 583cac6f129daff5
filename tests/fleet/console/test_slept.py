"""The console on a computer that sleeps while a page holds a button."""

import asyncio
import json
import time
from pathlib import Path
from typing import Any

from fleet.aio import Fleet
from fleet.console.console import Console
from schemas.process.computer_sleep import SleepWatch
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for


async def test_press_from_before_sleep_is_over(tmp_path: Path) -> None:
    hub = FleetProcesses(free_endpoint(), tmp_path)
    slept_s = [0.0]
    seen: list[dict[str, Any]] = []
    ticks: list[int] = []
    try:
        async with Fleet(hub.endpoint, person="teacher", kind="person") as fleet:
            hub.bus.token("fleet/red")
            sleep = SleepWatch((lambda: time.monotonic() + slept_s[0], time.monotonic))
            console = Console(fleet, tmp_path, tmp_path / "fleet.yaml", sleep)

            async def send(text: str) -> None:
                message = json.loads(text)
                if message["t"] == "tick":
                    ticks.append(message["n"])
                    console.on_text(page, json.dumps({"t": "echo", "press": 1, "n": message["n"]}))
                else:
                    seen.append(message)

            page = await console.add_page(send)
            work = [asyncio.ensure_future(each) for each in (console.run(), page.run())]
            await asyncio.to_thread(wait_for, lambda: ticks, "a tick")
            press = {"t": "press", "press": 1, "cars": ["red"], "motion": "forward", "n": ticks[-1]}
            console.on_text(page, json.dumps(press))
            count = len(ticks) + 8
            await asyncio.to_thread(wait_for, lambda: len(ticks) > count, "it is held for longer than the gap")
            assert not [each for each in seen if each["t"] == "over"]
            slept_s[0] += 3600.0
            await asyncio.to_thread(wait_for, lambda: [each for each in seen if each["t"] == "over"], "it is over")
            for each in work:
                each.cancel()
            await asyncio.gather(*work, return_exceptions=True)
            await console.close()
    finally:
        hub.close()

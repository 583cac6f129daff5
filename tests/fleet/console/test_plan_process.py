"""The coordinator that the console starts."""

from pathlib import Path

from fleet.aio import Fleet
from fleet.console.plan_process import PlanProcess
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses


async def nobody_answers() -> None:
    """Query a coordinator that does not exist."""


async def nobody_hangs() -> str:
    """Return that there is no coordinator that does not answer."""
    return ""


async def test_console_reports_why_coordinator_does_not_start(tmp_path: Path) -> None:
    hub = FleetProcesses(free_endpoint(), tmp_path)
    file = tmp_path / "fleet.yaml"
    file.write_text("cars: {red: {link: sim, platform: stm32, roles: [Guide]}}")
    try:
        async with Fleet(hub.endpoint) as fleet:
            process = PlanProcess(fleet, file)
            ok, words = await process.set_plan("roles: {guide: {mode: tracking}}", nobody_answers, nobody_hangs)
            assert not ok
            assert words.startswith(f"{file}:1:"), words
            await process.close()
    finally:
        hub.close()

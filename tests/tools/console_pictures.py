"""Pictures of every page of the console, of simulated cars: `python -m tests.tools.console_pictures DIRECTORY`.

Each page comes in light on a desktop, and in dark on a phone.
"""

import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from fleet.client.commands import mode_request
from tests.support.console import ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

PLAN = "roles:\n  guide: {mode: tracking}\n  rest: {mode: manual, count: all, priority: -1}\n"
COLORS = 64
SETTLE_S = 4.0
"""Time for some readings of each car."""


def main(directory: Path) -> None:
    """Write console-PAGE.png and console-PAGE-phone.png."""
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        stage = ConsoleStage(FleetProcesses(free_endpoint(), Path(scratch)))
        try:
            plan = Path(scratch) / "plan.yaml"
            plan.write_text(PLAN)
            stage.fleet.start("-m", "fleet.cli", "plan", "run", str(plan))
            stage.person.ask(mode_request("light_seeking"), ["blue"])
            time.sleep(SETTLE_S)
            phone = stage.playwright.devices["Pixel 7"] | {"color_scheme": "dark", "device_scale_factor": 1.5}
            links = stage.page().locator("nav a").all()
            pages = [link.get_attribute("href") or "" for link in links]
            for path in pages:
                name = path.removeprefix("#/") or "fleet"
                for suffix, options in (("", {}), ("-phone", phone)):
                    page = stage.page(path, **options)
                    if name == "drive":
                        page.locator("input[name=select-red]").check()
                    time.sleep(1.0)
                    file = directory / f"console-{name}{suffix}.png"
                    page.screenshot(path=file)
                    Image.open(file).quantize(COLORS).save(file, optimize=True)
        finally:
            stage.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))

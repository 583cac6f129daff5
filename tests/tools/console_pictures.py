"""Pictures of every page of the console, of simulated cars: `python -m tests.tools.console_pictures DIRECTORY`.

Each page has a light picture on a desktop. The pages of ON_PHONES also have a dark picture on a phone.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from click.testing import CliRunner
from PIL import Image
from playwright.sync_api import Page

from fleet.cli import cli
from fleet.client.commands import mode_request
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.network_client import NetworkDevice, find_line, network_port
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

PLAN = "roles:\n  guide: {mode: tracking}\n  rest: {mode: manual, count: all, priority: -1}\n"
FLEET_FILE = "cars:\n  red: {platform: arduino}\n  blue: {platform: stm32+arm}\n  green: {}\n"
ON_PHONES = ("fleet", "drive", "plan", "map", "plots", "time", "inspect", "sessions", "pair")
COLORS = 64
SETTLE_S = 4.0
"""Time for some readings of each car."""
REPLACE = """(texts) => {
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode())
    for (const [from, to] of texts) walk.currentNode.data = walk.currentNode.data.replaceAll(from, to);
  for (const input of document.querySelectorAll("input"))
    for (const [from, to] of texts) input.value = input.value.replaceAll(from, to);
}"""


def main(directory: Path) -> None:
    """Write console-PAGE.png, and console-PAGE-phone.png of some pages."""
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        stage = ConsoleStage(FleetProcesses(free_endpoint(), Path(scratch)))
        try:
            take_pictures(stage, Path(scratch), directory)
        finally:
            stage.close()


def take_pictures(stage: ConsoleStage, scratch: Path, directory: Path) -> None:
    """Bring cars, console, recordings and a paired device into a state worth a picture, and take the pictures."""
    (scratch / "fleet.yaml").write_text(FLEET_FILE)
    (scratch / "plan.yaml").write_text(PLAN)
    sessions = ("--sessions", str(scratch / "recordings"))
    lan = ("--lan", "--lan-port", "0", "--as", "teacher")
    stage.console = ConsoleProcess(stage.fleet, *lan, *sessions, "--fleet-file", str(scratch / "fleet.yaml"))
    port = network_port(stage.console)
    stage.fleet.start("-m", "fleet.cli", "record", "run", *sessions, "--json").line()
    stage.fleet.start("-m", "fleet.cli", "plan", "run", str(scratch / "plan.yaml"))
    _, (link,) = stage.fleet.simulate("new:arduino:pty")
    stage.person.ask(mode_request("light_seeking"), ["blue"])
    pairing = CliRunner().invoke(cli, ["console", "pair", "group_a"], env=stage.fleet.environment)
    assert NetworkDevice(port).pair(pairing.output.split(" type ")[1][:9])["ok"]
    # The pictures show other texts instead of this computer's directory, address and link.
    address = find_line(stage.console, r"On the network: (https://.*)")
    texts = [(str(scratch), "/home/mia/my-cars"), (address, "https://192.168.1.5:7443"), (link, "/dev/ttyUSB0")]
    time.sleep(SETTLE_S)
    phone = stage.playwright.devices["Pixel 7"] | {"color_scheme": "dark", "device_scale_factor": 1.5}
    paths = [each.get_attribute("href") or "" for each in stage.page().locator("nav a").all()]
    for path in [*paths, "pair"]:
        name = path.removeprefix("#/") or "fleet"
        for suffix, options in (("", {}), ("-phone", phone)):
            if suffix and name not in ON_PHONES:
                continue
            page = pair_page(stage, port, options) if name == "pair" else stage.page(path, **options)
            prepare(page, name, link, port)
            time.sleep(1.0)
            page.evaluate(REPLACE, texts)
            file = directory / f"console-{name}{suffix}.png"
            page.screenshot(path=file)
            Image.open(file).quantize(COLORS).save(file, optimize=True)


def pair_page(stage: ConsoleStage, port: int, options: dict[str, Any]) -> Page:
    """Open the pairing page, the only page that an unpaired device sees."""
    shown = options or {"viewport": {"width": 640, "height": 400}}
    page = stage.browser.new_context(ignore_https_errors=True, **shown).new_page()
    page.goto(f"https://127.0.0.1:{port}/pair")
    return page


def prepare(page: Page, name: str, link: str, port: int) -> None:
    """Do the first steps of a person on a page. link: of a new car. port: that of the network."""
    match name:
        case "drive":
            page.locator("input[name=select-red]").check()
        case "map":
            page.locator("[data-mark]").nth(2).wait_for()
        case "board":
            page.locator("[data-class=open]").click()
            code = page.locator(".class .code").inner_text()
            for _ in range(2):
                assert NetworkDevice(port).pair(code)["ok"]
            page.locator("[data-guest-name]").nth(1).wait_for()
        case "people":
            page.locator("[data-device]").first.wait_for()
        case "sessions":
            row = page.locator("[data-session]")
            row.first.wait_for()
            page.locator("[data-recorder=recording]").wait_for()
            page.locator("input[name=mark]").fill("blue lost the line")
            page.locator("[data-record=mark]").click()
            page.locator("[data-record=stop]").click()
            page.locator("[data-recorder=stopped]").wait_for()
            page.locator("[data-record=start]").click()
            page.locator("[data-recorder=recording]").wait_for()
            wait_for(lambda: row.count() == 2, "both sessions are listed")
            row.last.locator("details.others > summary").click()
            row.last.get_by_role("button", name="Verify").click()
            row.last.get_by_text("whole,").wait_for()
        case "plan":
            page.locator("select[name=example]").select_option(index=1)
            page.locator("[data-plan=form]").click()
            page.locator("[data-form-role]").first.wait_for()
            page.locator("[data-plan=check]").click()
            page.locator("[data-trial]").wait_for()
            page.locator("main").evaluate("(main) => main.scrollTo(0, 0)")
        case "setup":
            page.locator("input[name=links]").fill(link)
            page.locator("[data-setup=scan]").click()
            page.locator("[data-link]").wait_for()
            page.locator("[data-link] input[name=car]").fill("green")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

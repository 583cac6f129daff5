"""The console in a real browser: its process, Chromium, and a connection between them that a test can cut."""

import contextlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from playwright.sync_api import Browser, Locator, Page, Playwright, sync_playwright

from fleet.client.client import Fleet as Client
from tests.support.judge import Judge
from tests.support.ports import free_port
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess, wait_for
from tests.support.tcp_proxy import StallProxy

CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
CARS = {"red": "arduino+arm", "blue": "stm32", "green": "raspberry_pi"}
DESKTOP: dict[str, Any] = {"viewport": {"width": 1280, "height": 900}}


def find_chromium(playwright: Playwright) -> str:
    """Return the path of the distribution's Chromium, else of Playwright's own. Fail with the command to type."""
    found = next(filter(None, map(shutil.which, CHROMIUM_NAMES)), playwright.chromium.executable_path)
    assert Path(found).exists(), "there is no Chromium: type `make browser`"
    return found


def hold_until_driving(page: Page, judge: Judge) -> None:
    """Hold the button of the pad until the car drives. If it does not drive within 2 s, pause and press again."""
    for _ in range(10):
        page.locator("[data-motion=forward]").hover()
        page.mouse.down()
        try:
            wait_for(lambda: judge.driving, "it drives", 2.0)
        except AssertionError:
            page.mouse.up()
            page.wait_for_timeout(700)
        else:
            return
    raise AssertionError(page.locator(".results").inner_text())


LEADS_ONLY = "Only a lead may (teacher)."
"""The whole text for a person who is not a lead. The lead is teacher."""


class ConsoleProcess:
    """One process of `fleet console`."""

    def __init__(self, fleet: FleetProcesses, *arguments: str, port: int | None = None) -> None:
        self.port = free_port() if port is None else port
        self.process: GatewayProcess = fleet.start("-m", "fleet.cli", "console", "--port", str(self.port), *arguments)
        self.lines: list[str] = []
        wait_for(lambda: self.lines.extend(self.process.lines()) or self.lines, "the console listens")
        assert f":{self.port}" in self.lines[0], self.lines
        self.address = f"http://127.0.0.1:{self.port}"


class ConsoleStage:
    """Three simulated cars with their gateways, a console, a browser, and a client of another person."""

    def __init__(self, fleet: FleetProcesses) -> None:
        self.fleet = fleet
        self.sim, links = fleet.simulate(*(f"{car}:{kind}:tcp" for car, kind in CARS.items()), truth=True)
        self.links = dict(zip(CARS, links, strict=True))
        self.gateways = {car: fleet.gateway(self.links[car], car=car, platform=kind) for car, kind in CARS.items()}
        self.judges = {car: Judge.follow(fleet.bus, car) for car in CARS}
        self.console = ConsoleProcess(fleet)
        self.wire = StallProxy(self.console.port)
        for car in CARS:
            fleet.ready(car)
        self.person = Client(fleet.endpoint, sender="mia", kind="person")
        self.playwright = sync_playwright().start()
        self.browser = self.launch()
        self._pages: list[Page] = []
        self._reports = 0

    def launch(self) -> Browser:
        """Start a browser. Its `localhost` is behind the proxy."""
        return self.playwright.chromium.launch(
            executable_path=find_chromium(self.playwright),
            args=[f"--host-resolver-rules=MAP localhost:{self.console.port} 127.0.0.1:{self.wire.port}"],
        )

    def page(self, path: str = "", *, browser: Browser | None = None, wired: bool = False, **context: Any) -> Page:
        """Open the console in a new page, and wait for the data of the cards."""
        page = (browser or self.browser).new_context(**(context or DESKTOP)).new_page()
        if browser is None:
            self._pages.append(page)
        page.set_default_timeout(PATIENCE_S * 1000)
        host = f"localhost:{self.console.port}" if wired else f"127.0.0.1:{self.console.port}"
        page.goto(f"http://{host}/{path}")
        page.locator("nav a[aria-current]").wait_for()
        page.locator(".fleet-name", has_text="fleet").wait_for()
        return page

    def phone(self, path: str = "") -> Page:
        """Open the console as a phone does."""
        return self.page(path, **self.playwright.devices["Pixel 7"])

    def driving_page(self, *cars: str, **options: Any) -> Page:
        """Open the drive page and select cars."""
        page = self.page("#/drive", **options)
        for car in cars:
            page.locator(f"input[name=select-{car}]").check()
        return page

    def rest(self) -> None:
        """Close the pages. Bring all cars to rest in mode manual, without holds, e-stops and leases."""
        for page in self._pages:
            page.context.close()
        self._pages.clear()
        for car in CARS:
            safety = self.fleet.state("safety", car)
            if safety.estops:
                self.person.resume([car], [each.id for each in safety.estops])
            if self.judges[car].driving or self.fleet.state("mode", car).asked != "manual":
                self.person.stop([car])
            if self.fleet.state("safety", car).HasField("hold"):
                self.person.resume([car])
            self.fleet.ask_all("lease", car, sender="mia", kind="person", take=True)
            self.fleet.ask_all("lease", car, sender="mia", kind="person", release=True)
        wait_for(lambda: not any(self.fleet.state("safety", car).HasField("lease") for car in CARS), "nobody drives")

    def renderers(self, browser_of: psutil.Process | None = None) -> list[psutil.Process]:
        """Return the processes that run the pages."""
        found = []
        for each in (browser_of or psutil.Process()).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                if "--type=renderer" in each.cmdline():
                    found.append(each)
        return found

    def close(self) -> None:
        """End the pages, the browsers, the console and the fleet."""
        self.browser.close()
        self.playwright.stop()
        self.wire.close()
        self.person.close()
        self.fleet.close()

    # ------------------------------------------------------------------ actions of a person

    @contextmanager
    def held(self, page: Page, motion: str, car: str = "red") -> Iterator[Locator]:
        """Hold a button of the pad with the mouse until the car drives, and for the body of the `with`."""
        button = page.locator(f"[data-motion={motion}]")
        self.hold(page, button, car)
        try:
            yield button
        finally:
            with contextlib.suppress(Exception):  # the page may be gone
                page.mouse.up()

    def hold(self, page: Page, button: Locator, car: str) -> None:
        """Press until the car drives. If the dead-man timer ends a press on a busy machine, press again."""
        began = time.monotonic()
        button.hover()
        while not self.judges[car].driving:
            assert time.monotonic() - began < PATIENCE_S, page.locator(".results").inner_text()
            page.mouse.down()
            pressed = time.monotonic()
            while not self.judges[car].driving and time.monotonic() - pressed < 2.0:
                time.sleep(0.02)
            if not self.judges[car].driving:
                page.mouse.up()
                time.sleep(0.7)  # after a stop, the gateway rejects a stream that does not pause

    def report(self, page: Page, act: Callable[[], object]) -> Locator:
        """Stop the cars by an action. Return the page's report of that stop, unfolded."""
        shown = page.locator("[data-report]")
        before = int(shown.get_attribute("data-report") or 0) if shown.count() else self._reports
        self._reports = before + 1
        act()
        report = page.locator(f"[data-report='{before + 1}']")
        report.locator(".report-line").click()
        return report

    def details(self, page: Page, car: str = "red") -> Locator:
        """Open all about a car on the fleet page. Return it."""
        page.locator(f"[data-car={car}]").click()
        details = page.locator(f"[data-details={car}]")
        details.wait_for()
        return details

    def stands(self, car: str = "red", *, since_ns: int | None = None) -> float:
        """Wait until the car's true motors are off. Return the time from `since_ns` (default: now), s."""
        return self.judges[car].wait_off(since_ns or time.time_ns(), watched_s=0.6)


def numbers(text: str) -> list[float]:
    """Return the numbers in a text."""
    return [float(each) for each in re.findall(r"\d+(?:\.\d+)?", text)]


def browser_process(before: set[int]) -> psutil.Process:
    """Return the main process of the browser that is not in `before`."""
    for each in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            words = each.cmdline()
            if each.pid not in before and "--type=" not in " ".join(words) and "--remote-debugging-pipe" in words:
                return each
    raise AssertionError("no browser was started")


def pids() -> set[int]:
    """Return the ids of this process and of its descendants."""
    return {each.pid for each in psutil.Process().children(recursive=True)} | {os.getpid()}

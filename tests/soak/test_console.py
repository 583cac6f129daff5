"""The console with twenty cars that stream: time from STOP to the bytes at the cars, plots, and a slow phone.

`CONSOLE_PRESSES`, `CONSOLE_PHONE_PRESSES` and `CONSOLE_PLOT_S` make it shorter.
"""

import json
import os
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from playwright.sync_api import Page, sync_playwright

from fleet.client.client import Fleet as Client
from fleet.client.commands import lease_request, mode_request
from schemas.bus import Sample
from tests.support.console import find_chromium
from tests.support.ports import free_endpoint, free_port
from tests.support.processes import GatewayProcess, wait_for
from tests.support.up import Up
from tests.support.wire_record import WireRecord

# Before each press all cars are brought into a mode, and a stop in doubt takes its time: some seconds for each press.
pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]

# The other programs send nothing while they track.
KINDS = ("arduino", "arduino+arm")
CARS = [f"car{number:02d}" for number in range(20)]
PRESSES = int(os.environ.get("CONSOLE_PRESSES", "200"))
PHONE_PRESSES = int(os.environ.get("CONSOLE_PHONE_PRESSES", "40"))
PLOT_S = float(os.environ.get("CONSOLE_PLOT_S", "600"))
WIRE_P95_S = 0.1
PHONE_P99_S = 0.5
"""As long as a drive outlives a console that dies. On two cores that also run twenty gateways, the simulator and the
throttled browser, p50 was 100 to 137 ms and p99 246 to 355. The page's own thread made a press wait for at most 96."""
THROTTLE = 4
PHONE: dict[str, Any] = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
SCROLLS = 5
SCROLL_PX = 600
MIN_FRAMES_HZ = 50
FRAMES = ["devtools.timeline.frame", "disabled-by-default-devtools.timeline.frame"]
MAX_SHARE = 0.3
"""Maximum share of a core for the server, with one page."""
MAX_GROWTH_MB = 10.0
MAX_TASK_MS = 200.0
"""Maximum time of one task in the page."""
STREAM_READINGS = 4
MIN_RATE_HZ = 10
"""Minimum readings a second on a busy machine, of 25."""
PROBE_INTERVAL_S = 1.0
START_S = 300.0
"""Time for twenty gateways to start on a busy machine."""
NOTE_PRESS = """
addEventListener("pointerdown", (event) => { window.pressedAt = performance.timeOrigin + event.timeStamp; }, true);
"""
NOTE_TASKS = """
window.tasks = [];
new PerformanceObserver((list) => window.tasks.push(...list.getEntries().map((each) => each.duration)))
  .observe({ type: "longtask", buffered: false });
"""


@dataclass
class StopTimes:
    """Times from the press to the first bytes of the STOP at each car, s."""

    free: list[float]
    """Times of the cars whose program ran no block meanwhile."""
    blocked: int = 0
    """Number of cars that a block delayed."""

    def __str__(self) -> str:
        p50, p95, p99 = (round(share(self.free, part) * 1e3) for part in (0.5, 0.95, 0.99))
        worst = f"max {max(self.free) * 1e3:.0f}, {len(self.free)} stops, {self.blocked} in blocks not counted"
        return f"p50 {p50} ms, p95 {p95}, p99 {p99}, {worst}; load {os.getloadavg()[0]:.1f}"


class TwentyCars:
    """Twenty simulated cars that track a line at 25 readings/s each, and a console."""

    def __init__(self, directory: Path) -> None:
        words = [word for number, car in enumerate(CARS) for word in ("--car", f"{car}:{KINDS[number % 2]}:tcp")]
        wire = directory / "wire.txt"
        command = ["-m", "tests.support.wire_record", str(wire), "--no-truth", *words]
        self._simulator = GatewayProcess(command, directory / "sim.log", {})
        file = directory / "fleet.yaml"
        lines = [
            f"  {car}: {{link: {self._simulator.line()['link']}, platform: {KINDS[n % 2]}}}"
            for n, car in enumerate(CARS)
        ]
        file.write_text("\n".join(["cars:", *lines, ""]))
        self._wire = WireRecord(wire)
        self._up = Up(directory, free_endpoint(), str(file), "--no-record")
        self.person = wait_for(self._open, "the bus is there", START_S)
        wait_for(lambda: len(self.person.cars()) == len(CARS), "all gateways are there", START_S)
        for car in CARS:
            self._up.ready(car)
        self._readings = 0
        self._newest: dict[str, deque[float]] = {car: deque(maxlen=STREAM_READINGS) for car in CARS}
        self.person.bus.subscribe("fleet/*/sensor/line", self._on_reading)
        self.port = free_port()
        console = ["-m", "fleet.cli", "console", "--port", str(self.port)]
        self.console = GatewayProcess(console, directory / "console.log", self._up.environment)
        wait_for(self.console.lines, "the console listens")
        self.process = psutil.Process(self.console.pid)

    def _open(self) -> Client | None:
        try:
            return Client(self._up.endpoint, sender="mia", kind="person")
        except Exception:  # noqa: BLE001 - there is no hub yet
            return None

    def _on_reading(self, sample: Sample) -> None:
        self._readings += 1
        self._newest[sample.key.split("/")[1]].append(time.monotonic())

    def _streams(self, car: str) -> bool:
        """Return True if a car has just sent some readings at the rate of its mode."""
        times = list(self._newest[car])
        lasts_s = STREAM_READINGS / MIN_RATE_HZ
        return len(times) == STREAM_READINGS and time.monotonic() - times[0] < lasts_s

    def rate_hz(self) -> float:
        """Return the readings of a car in a second."""
        begun, began = self._readings, time.monotonic()
        time.sleep(0.5)
        return (self._readings - begun) / (time.monotonic() - began) / len(CARS)

    def track(self) -> None:
        """Bring all cars into a mode with fast reports. Wait until all report, and none is in a block."""
        wait_for(lambda: all(each.ok for each in self.person.ask(mode_request("tracking"), CARS)), "all track")

        def ready() -> bool:
            self._wire.read()
            return not any(self._wire.is_blocked(car) or not self._streams(car) for car in CARS)

        wait_for(ready, "all report fast")

    def cpu_s(self) -> float:
        """Return the CPU time of the console."""
        return float(sum(self.process.cpu_times()[:2]))

    def rss_mb(self) -> float:
        """Return the memory of the console."""
        return float(self.process.memory_info().rss / 1e6)

    def stop(self, page: Page, times: StopTimes) -> None:
        """Press STOP while all cars stream. Add the times until the bytes reach the cars."""
        self.track()
        page.locator("#stop").hover()
        before = page.locator("[data-report]")
        number = int(before.get_attribute("data-report") or 0) if before.count() else 0
        page.mouse.down()
        page.mouse.up()
        page.locator(f"[data-report]:not([data-report='{number}'])").wait_for()
        pressed_ns = int(page.evaluate("window.pressedAt") * 1e6)

        def arrivals() -> dict[str, int]:
            self._wire.read()
            found = {car: self._wire.first_after(car, pressed_ns) for car in CARS}
            return {car: at for car, at in found.items() if at is not None}

        wait_for(lambda: len(arrivals()) == len(CARS), "each car got bytes")
        for car, arrived_ns in arrivals().items():
            if self._wire.was_blocked(car, pressed_ns, arrived_ns):
                times.blocked += 1
            else:
                times.free.append((arrived_ns - pressed_ns) / 1e9)

    def wait_shown(self, page: Page) -> None:
        """Wait until the page shows that each car stands."""
        page.locator(".report-line").click()
        page.locator(".stop-shown, .stop-sent").nth(len(CARS) - 1).wait_for()

    def close(self) -> None:
        self.console.kill()
        self.console.wait()
        self.person.close()
        self._up.__exit__()
        self._simulator.end()
        self._wire.close()


@pytest.fixture(scope="module")
def twenty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwentyCars]:
    cars = TwentyCars(tmp_path_factory.mktemp("twenty"))
    yield cars
    cars.close()


def share(values: list[float], part: float) -> float:
    """Return the value below which this part of the values lies."""
    return sorted(values)[min(len(values) - 1, int(part * len(values)))]


def open_page(playwright: Any, twenty: TwentyCars, path: str = "", **options: Any) -> Page:
    browser = playwright.chromium.launch(executable_path=find_chromium(playwright))
    shown = options or {"viewport": {"width": 1280, "height": 900}}
    page: Page = browser.new_context(**shown).new_page()
    page.add_init_script(NOTE_PRESS)
    page.goto(f"http://127.0.0.1:{twenty.port}/{path}")
    page.set_default_timeout(60_000)
    page.locator("nav a[aria-current]").wait_for()
    return page


def test_stop_reaches_twenty_cars_within_a_tenth_of_a_second(twenty: TwentyCars) -> None:
    with sync_playwright() as playwright:
        page = open_page(playwright, twenty)
        page.locator("[data-car]").nth(len(CARS) - 1).wait_for()
        twenty.stop(page, StopTimes([]))
        began, used, rss = time.monotonic(), twenty.cpu_s(), twenty.rss_mb()
        times = StopTimes([])
        for _ in range(PRESSES):
            twenty.stop(page, times)
        twenty.wait_shown(page)
        cpu, grown = (twenty.cpu_s() - used) / (time.monotonic() - began), twenty.rss_mb() - rss
    print(f"\nSTOP to the wire, {PRESSES} presses: {times}; console {cpu:.1%} of a core, {grown:+.1f} MB")
    assert len(times.free) > PRESSES * len(CARS) / 2
    assert cpu < MAX_SHARE
    assert grown < MAX_GROWTH_MB
    assert share(times.free, 0.95) <= WIRE_P95_S


def test_every_stop_of_a_slow_phone_arrives(twenty: TwentyCars) -> None:
    times = StopTimes([])
    with sync_playwright() as playwright:
        page = open_page(playwright, twenty, **PHONE)
        page.context.new_cdp_session(page).send("Emulation.setCPUThrottlingRate", {"rate": THROTTLE})
        for _ in range(PHONE_PRESSES):
            twenty.stop(page, times)  # waits until each car has got bytes
        twenty.wait_shown(page)
    print(f"\nslow phone, {PHONE_PRESSES} of {PHONE_PRESSES} arrived: {times}")
    assert share(times.free, 0.99) <= PHONE_P99_S


def frames_of(trace: bytes) -> list[float]:
    """Return the times at which the browser drew a frame of the page, s, by its own trace."""
    events = json.loads(trace)["traceEvents"]
    return sorted(each["ts"] / 1e6 for each in events if each["name"] == "DrawFrame")


def test_twenty_moving_cars_scroll_smoothly_on_a_slow_phone(twenty: TwentyCars) -> None:
    twenty.track()
    rates = []
    with sync_playwright() as playwright:
        page = open_page(playwright, twenty, **PHONE)
        page.locator("[data-car]").nth(len(CARS) - 1).wait_for()
        page.locator(".tile.moving").nth(len(CARS) // 2).wait_for()
        devtools, browser = page.context.new_cdp_session(page), page.context.browser
        assert browser is not None
        devtools.send("Emulation.setCPUThrottlingRate", {"rate": THROTTLE})
        tiles, way = page.locator(".tiles"), {"x": 195, "y": 500, "speed": 600, "gestureSourceType": "mouse"}

        def scroll() -> bool:
            """Scroll away from the nearer end. Return whether the tiles have moved."""
            before = tiles.evaluate("(tiles) => tiles.scrollTop")
            distance = SCROLL_PX if before < SCROLL_PX / 2 else -SCROLL_PX
            devtools.send("Input.synthesizeScrollGesture", way | {"yDistance": -distance})
            return bool(abs(tiles.evaluate("(tiles) => tiles.scrollTop") - before) > SCROLL_PX / 2)

        wait_for(scroll, "the new page scrolls")
        for _ in range(SCROLLS):
            browser.start_tracing(page=page, categories=FRAMES)
            assert scroll()
            frames = frames_of(browser.stop_tracing())
            rates.append((len(frames) - 1) / (frames[-1] - frames[0]))
    shown = ", ".join(f"{each:.0f}" for each in rates)
    print(f"\nscrolling twenty cars at throttle {THROTTLE}: {shown} frames/s; load {os.getloadavg()[0]:.1f}")
    assert sorted(rates)[len(rates) // 2] >= MIN_FRAMES_HZ


def probe(twenty: TwentyCars) -> list[float]:
    """Lease and release cars as another operator. Return the time of each command, s."""
    took = []
    for car in CARS[:5]:
        for release in (False, True):
            (outcome,) = twenty.person.ask(lease_request(release=release), [car])
            assert outcome.ok, outcome
            took.append(outcome.took_s)
    return took


def test_four_plots_of_twenty_cars_run_flat_and_harm_nobody(twenty: TwentyCars) -> None:
    twenty.track()
    before = [each for _ in range(10) for each in probe(twenty)]
    with sync_playwright() as playwright:
        page = open_page(playwright, twenty, "#/plots")
        for name in CARS[3:]:
            page.get_by_label(name, exact=True).check()
        for number, field in enumerate(("left_outer", "left_inner", "right_inner", "right_outer")):
            page.locator(f"[data-plot='{number}'] select").select_option(f"sensor/line {field}")
        page.locator(".selection select").select_option("600")
        values = page.locator("[data-plot='3'] .newest", has_text=f"{CARS[-1]} ")
        values.wait_for()
        time.sleep(min(30.0, PLOT_S / 4))  # until the history of ten minutes has arrived
        page.evaluate(NOTE_TASKS)
        began, used, memory, during = time.monotonic(), twenty.cpu_s(), [twenty.rss_mb()], []
        while (passed_s := time.monotonic() - began) < PLOT_S:
            during += probe(twenty)
            memory.append(twenty.rss_mb())
            time.sleep(PROBE_INTERVAL_S)
        rate_hz, cpu, tasks = twenty.rate_hz(), (twenty.cpu_s() - used) / passed_s, page.evaluate("window.tasks")
        values.wait_for()
    half = len(memory) // 2
    grown = sum(memory[half:]) / len(memory[half:]) - sum(memory[:half]) / half
    p50, p95 = ([round(share(took, part) * 1e3) for took in (before, during)] for part in (0.5, 0.95))
    print(
        f"\nfour plots of {len(CARS)} cars at {rate_hz:.0f} Hz for {PLOT_S:.0f} s: console {cpu:.1%} of a core, "
        f"{memory[0]:.0f} to {memory[-1]:.0f} MB ({grown:+.1f}); longest task {max(tasks, default=0):.0f} ms "
        f"({len(tasks)} over 50 ms); commands before and during: p50 {p50} ms, p95 {p95}; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    assert cpu < MAX_SHARE
    assert grown < MAX_GROWTH_MB
    assert max(tasks, default=0) <= MAX_TASK_MS
    assert share(during, 0.95) <= max(WIRE_P95_S, 2 * share(before, 0.95))

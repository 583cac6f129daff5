"""The console in a real browser, on real gateways. The simulated cars' true motors judge what each control does."""

import contextlib
import http.client
import json
import os
import re
import signal
import socket
import time
import urllib.request
from pathlib import Path
from typing import Any

import psutil
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from gateway.drivers.yahboom.protocol.frames import General, encode
from schemas.limits import STREAM_SILENCE_S
from schemas.words import Light, Motion, ServoAction
from tests.support.console import CARS, ConsoleProcess, ConsoleStage, browser_process, pids
from tests.support.processes import wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

TTL_S = 0.5
"""Duration of a drive of the console without another one."""
BLOCK_S = 1.0
"""The longest block of a car in mode 0: a ranging without echo."""
STOPPED_WITHIN_S = TTL_S + BLOCK_S + 0.5


def drive_all(stage: ConsoleStage) -> None:
    """Drive all cars as another person."""
    for car in CARS:
        stage.person.car(car).drive("forward", 10.0, wait=False).check()
    wait_for(lambda: all(stage.judges[car].driving for car in CARS), "all drive")


@pytest.mark.parametrize("how", ["mouse", "escape", "space", "touch", "fetch alone"])
def test_stop_button_stops_all_cars_and_shows_each(stage: ConsoleStage, how: str) -> None:
    page = stage.phone() if how == "touch" else stage.page()
    page.locator("[data-car=red]").wait_for()
    drive_all(stage)

    def act() -> None:
        match how:
            case "mouse":  # pointerdown alone
                page.locator("#stop").hover()
                page.mouse.down()
            case "touch":
                page.locator("#stop").tap()
            case "escape":  # also while a control has the focus
                page.locator("#estop").click()
                page.locator("input[name=why]").fill("x")
                page.keyboard.press("Escape")
            case "space":
                page.keyboard.press(" ")
            case _:  # the socket is dead, and neither side has noticed
                page.evaluate("WebSocket.prototype.send = () => {}")
                page.keyboard.press("Escape")

    report = stage.report(page, act)
    for car in CARS:
        stage.stands(car)
    for car, kind in CARS.items():
        state = "shown" if kind.startswith("arduino") else "sent"  # the reports of the others do not react to frames
        report.locator(f"[data-stop={car}].stop-{state}").wait_for()
        details = stage.details(page, car)
        details.get_by_text("On hold: you stopped it").wait_for()
        details.get_by_role("button", name=f"Close {car}").click()


def test_car_is_shown_stopped_only_by_readings(stage: ConsoleStage) -> None:
    page = stage.page()
    drive_all(stage)
    stage.gateways["red"].popen.send_signal(signal.SIGSTOP)
    try:
        report = stage.report(page, lambda: page.keyboard.press("Escape"))
        report.locator("[data-stop=blue].stop-sent").wait_for()
        assert report.locator("[data-stop=red].stop-shown").count() == 0
        assert stage.judges["red"].driving, "its gateway is frozen"
    finally:
        stage.gateways["red"].popen.send_signal(signal.SIGCONT)
    report.locator("[data-stop=red].stop-shown").wait_for()
    assert not stage.judges["red"].driving


def test_estop_is_latched_with_reason_until_released(stage: ConsoleStage) -> None:
    page = stage.page()
    page.locator("#estop").click()
    page.locator("input[name=why]").fill("smoke")
    page.locator("input[name=why]").press("Enter")  # the same as the button beside the field
    card = stage.details(page)
    card.get_by_text("E-stop of the whole fleet by you: smoke").wait_for()
    refused = stage.person.car("red").drive("forward")
    assert refused.reason == "estopped"
    card.get_by_role("button", name="End the e-stop…").click()
    assert stage.fleet.state("safety").estops, "one press ends nothing"
    card.get_by_role("button", name="Yes, end it").click()
    for car in CARS:
        wait_for(lambda car=car: not stage.fleet.state("safety", car).estops, "ended on all")
    page.get_by_role("button", name="Resume red").click()
    wait_for(lambda: not stage.fleet.state("safety").HasField("hold"), "its hold ends, too")


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_pad_drives_while_held(stage: ConsoleStage, size: str) -> None:
    options = stage.playwright.devices["Pixel 7"] if size == "phone" else {}
    page = stage.driving_page("red", **options)
    with stage.held(page, "forward"):
        time.sleep(1.2)  # longer than any drive of the stream
        assert stage.judges["red"].driving
    stage.stands()
    assert not stage.judges["blue"].driving
    report = stage.report(page, lambda: page.keyboard.press(" "))  # the button has lost the focus
    report.locator("[data-stop=red].stop-shown").wait_for()


def test_touch_drives_until_finger_is_lifted_or_cancelled(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", **stage.playwright.devices["Pixel 7"])
    box = page.locator("[data-motion=spin_left]").bounding_box()
    assert box is not None
    where = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    fingers = page.context.new_cdp_session(page)
    for end in ("touchEnd", "touchCancel"):

        def drives() -> bool:
            fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [where]})
            try:
                wait_for(lambda: stage.judges["red"].driving, "it drives", seconds=3.0)
            except AssertionError:
                fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
                time.sleep(0.7)
                return False
            return True

        wait_for(drives, "it drives")
        fingers.send("Input.dispatchTouchEvent", {"type": end, "touchPoints": []})
        stage.stands()


def test_several_cars_are_driven_together_by_keys(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", "green")

    def both() -> bool:
        page.keyboard.down("ArrowUp")
        try:
            wait_for(lambda: stage.judges["red"].driving and stage.judges["green"].driving, "both", seconds=3.0)
        except AssertionError:
            page.keyboard.up("ArrowUp")
            time.sleep(0.7)
            return False
        return True

    wait_for(both, "both drive")
    assert not stage.judges["blue"].driving
    page.keyboard.up("ArrowUp")
    stage.stands("red")
    stage.stands("green")


def test_page_without_focus_releases_press(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    hide = "Object.defineProperty(document, 'visibilityState', { value: 'hidden', configurable: true })"
    for lost in (
        "window.dispatchEvent(new Event('blur'))",
        "window.dispatchEvent(new Event('pagehide'))",
        "document.dispatchEvent(new Event('freeze'))",
        f"{hide}; document.dispatchEvent(new Event('visibilitychange')); delete document.visibilityState",
    ):
        with stage.held(page, "back"):
            page.evaluate(lost)
            stage.stands()
    with stage.held(page, "back"):
        page.context.close()
        stage._pages.remove(page)
        stage.stands()


def test_killed_browser_stops_car(stage: ConsoleStage) -> None:
    before = pids()
    browser = stage.launch()
    process = browser_process(before)
    page = stage.driving_page("red", browser=browser)
    with stage.held(page, "forward"):
        killed_ns = time.time_ns()
        for each in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        assert stage.stands(since_ns=killed_ns) < STOPPED_WITHIN_S


def test_frozen_browser_stops_car_and_does_not_resume(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    with stage.held(page, "forward"):
        frozen = stage.renderers()
        frozen_ns = time.time_ns()
        for each in frozen:
            each.suspend()
        try:
            assert stage.stands(since_ns=frozen_ns) < STOPPED_WITHIN_S
            time.sleep(1.0)
        finally:
            for each in frozen:
                each.resume()
        # For the page, the finger is still down: no car drives until the finger is lifted.
        page.locator(".pad.held").wait_for(state="detached")
        thawed_ns = time.time_ns()
        time.sleep(0.5)
        assert stage.judges["red"].on_after(thawed_ns) == []


def test_cut_websocket_stops_car_and_late_burst_starts_nothing(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", wired=True)
    with stage.held(page, "forward"):
        cut_ns = stage.wire.cut()
        try:
            assert stage.stands(since_ns=cut_ns) < STOPPED_WITHIN_S
        finally:
            stage.wire.mend()
        page.locator(".pad.held").wait_for(state="detached")
        page.locator(".banner").wait_for(state="detached")
        time.sleep(0.5)
        assert stage.judges["red"].on_after(cut_ns) == []


def test_killed_console_stops_car(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    with stage.held(page, "forward"):
        killed_ns = stage.console.process.kill()
        stage.console.process.wait()
        assert stage.stands(since_ns=killed_ns) < STOPPED_WITHIN_S
    page.get_by_text("The console does not answer").wait_for()
    stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)
    page.get_by_text("The console does not answer").wait_for(state="hidden")
    with stage.held(page, "forward"):  # with a new cookie
        pass
    stage.stands()


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_controls_of_page_reach_car(stage: ConsoleStage, size: str) -> None:
    phone = size == "phone"
    page = stage.driving_page("red", **(stage.playwright.devices["Pixel 7"] if phone else {}))

    def truth(name: str) -> Any:
        return stage.sim.say({"car": "red", "ask": "truth"})[name]

    def use(selector: str) -> None:
        page.locator(selector).tap() if phone else page.locator(selector).click()

    def reaches(frame: bytes, selector: str, car: str = "red") -> None:
        frames = stage.judges[car].frames
        before = len(frames)
        use(selector)
        wait_for(lambda: any(frame in data for *_, data in frames[before:]), f"{frame!r} reaches {car}")

    page.locator("input[type=color]").fill("#ff8000")
    use("[data-do=led]")
    wait_for(lambda: truth("led") == "#ff8000", "its LED is orange")
    reaches(encode(General(Motion.STOP, light=Light.RED)), "[data-light=red]")
    reaches(encode(General(Motion.STOP, whistle=True)), "[data-do=whistle]")
    page.locator("input[name=servo]").fill("30")
    wait_for(lambda: truth("servo") == 150, "its servo has turned")
    before = truth("speed")
    use("[data-do=slower]")
    wait_for(lambda: truth("speed") < before, "it is slower")
    use("[data-do=faster]")
    wait_for(lambda: truth("speed") == before, "it is faster")
    page.locator(".joints input").nth(1).fill("45")
    reaches(b",J245,", "[data-do=arm]")
    for on in (True, False):
        use("[data-do=fan]")
        wait_for(lambda on=on: truth("fan") is on, "its fan is toggled")
    modes = [button.get_attribute("data-mode") for button in page.locator("[data-mode]").all()]
    assert len(modes) > 4
    for mode in (*modes[1:], "manual"):
        use(f"[data-mode={mode}]")
        wait_for(lambda mode=mode: truth("mode") == mode, f"it is in mode {mode}")
    page.locator("input[name=select-red]").uncheck()
    page.locator("input[name=select-green]").check()
    up = encode(General(Motion.STOP, servo=ServoAction.VERTICAL_UP))
    reaches(up, "[data-control=servo_vertical] button >> nth=0", "green")
    left = encode(General(Motion.STOP, servo=ServoAction.HORIZONTAL_LEFT))
    reaches(left, "[data-control=servo_horizontal] button >> nth=0", "green")


def test_gamepad_stick_drives_until_released(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    page.evaluate("window.stick = [0, 0]; navigator.getGamepads = () => [null, { axes: window.stick }]")

    def drives() -> bool:
        page.evaluate("window.stick = [0, -0.9]")
        try:
            wait_for(lambda: stage.judges["red"].driving, "it drives", seconds=3.0)
        except AssertionError:
            page.evaluate("window.stick = [0, 0]")
            time.sleep(0.7)
            return False
        return True

    wait_for(drives, "it drives")
    page.evaluate("window.stick = [0, 0.1]")
    stage.stands()


def test_everything_works_by_keyboard_alone(stage: ConsoleStage) -> None:
    page = stage.page("#/drive")
    page.locator("input[name=select-red]").focus()
    page.keyboard.press("Space")
    page.locator("[data-motion=forward]").focus()

    def drives() -> bool:
        page.keyboard.down("Enter")
        try:
            wait_for(lambda: stage.judges["red"].driving, "it drives", seconds=3.0)
        except AssertionError:
            page.keyboard.up("Enter")
            time.sleep(0.7)
            return False
        return True

    wait_for(drives, "it drives")
    page.keyboard.up("Enter")
    stage.stands()
    for number in range(page.locator("nav a").count()):
        page.locator("nav a").nth(number).focus()
        page.keyboard.press("Enter")
        page.locator("nav a").nth(number).and_(page.locator("[aria-current=page]")).wait_for()
        page.locator("main h1").wait_for()
        assert unreachable(page) == []


def unreachable(page: Page) -> list[str]:
    """Return the controls of a page that Tab does not reach. One that is disabled is none."""
    controls = "document.querySelectorAll('a[href], button, input, select, textarea, summary')"
    page.evaluate("document.activeElement.blur()")
    for _ in range(2 * page.evaluate(f"{controls}.length")):
        page.keyboard.press("Tab")
        page.evaluate("document.activeElement.dataset.reached = ''")
    is_missed = "(each) => !('reached' in each.dataset || each.disabled) && each.getClientRects().length > 0"
    missed = f"[...{controls}].filter({is_missed})"
    found: list[str] = page.evaluate(f"{missed}.map((each) => each.outerHTML.slice(0, 120))")
    return found


def test_stop_is_repeated_until_console_is_back(stage: ConsoleStage) -> None:
    page = stage.page()
    page.locator("[data-car=red]").wait_for()
    stage.console.process.kill()
    stage.console.process.wait()
    page.get_by_text("The console does not answer").wait_for()
    drive_all(stage)
    page.keyboard.press("Escape")
    page.get_by_text("STOP has not reached the console").wait_for()
    assert stage.judges["red"].driving
    stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)
    page.get_by_text("STOP has not reached the console").wait_for(state="hidden")
    for car in CARS:
        wait_for(lambda car=car: stage.fleet.state("safety", car).HasField("hold"), f"{car} is on hold")
        stage.stands(car)


@pytest.mark.parametrize("what", ["estop", "pause"])
def test_estop_and_pause_are_sent_again_when_console_is_back(stage: ConsoleStage, what: str) -> None:
    page, errors = stage.page(), list[str]()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.locator("[data-car=red]").wait_for()
    stage.console.process.kill()
    stage.console.process.wait()
    page.get_by_text("The console does not answer").wait_for()
    drive_all(stage)
    page.locator(f"#{what}").click()
    page.locator("input[name=why]").fill("smoke")
    page.locator("input[name=why]").press("Enter")
    page.get_by_text(f"{'E-stop' if what == 'estop' else 'pause'} has not reached the console").wait_for()
    stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)
    page.get_by_text("has not reached the console").wait_for(state="hidden")
    for car in CARS:
        stage.stands(car)
        safety = wait_for(
            lambda car=car: (found := stage.fleet.state("safety", car)) and (found.estops or found.pauses) and found,
            car,
        )
        assert [each.why for each in (safety.estops if what == "estop" else safety.pauses)] == ["smoke"]
    if what == "pause":
        stage.person.unpause()
    assert errors == []


def test_stops_wait_for_no_gateway_that_hangs(stage: ConsoleStage) -> None:
    page = stage.page()
    stage.gateways["red"].popen.send_signal(signal.SIGSTOP)
    try:
        for _ in range(40):
            page.keyboard.press("Escape")

        def drives() -> bool:
            time.sleep(1.2 * STREAM_SILENCE_S)  # drives without this silence are refused after a stop, for ever
            return stage.person.car("blue").drive("forward", 10.0, wait=False).ok

        wait_for(drives, "the last stop is over")
        wait_for(lambda: stage.judges["blue"].driving, "blue drives")
        pressed_ns = time.time_ns()
        page.keyboard.press("Escape")
        assert stage.stands("blue", since_ns=pressed_ns) < STOPPED_WITHIN_S
    finally:
        stage.gateways["red"].popen.send_signal(signal.SIGCONT)
    stage.details(page).get_by_text("online").wait_for()


def test_unsupported_abilities_are_not_offered_with_reason(stage: ConsoleStage) -> None:
    page = stage.driving_page("green")
    modes = page.locator(".lacking [data-control=mode]")
    assert not modes.is_visible(), "one line"
    page.locator(".lacking summary").click()
    modes.get_by_text("green: Raspberry_pi cars do not know mode tracking").wait_for()
    assert page.locator("[data-control=mode] button").count() == 0
    assert page.locator("[data-control=servo_vertical] button").count() == 3
    page.locator("input[name=select-green]").uncheck()
    page.locator("input[name=select-red]").check()
    page.locator("[data-mode=tracking]").wait_for()
    assert page.locator("[data-control=servo_vertical] button").count() == 0


def test_leased_car_is_refused_until_taken(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    page.get_by_text("mia (person)").wait_for()
    page.locator("[data-motion=back]").hover()
    page.mouse.down()
    page.locator("[data-control=drive] .refused", has_text="mia drives red. Take it over.").wait_for()
    page.mouse.up()
    assert stage.judges["red"].driving
    page.get_by_role("button", name="Take over red").click()
    page.get_by_role("button", name="Give back red").wait_for()
    time.sleep(2.5)  # longer than a lease, which the page must renew
    refused = stage.person.car("red").drive("forward")
    assert refused.reason == "leased"
    page.get_by_role("button", name="Give back red").click()
    page.get_by_role("button", name="Take over red").wait_for()
    stage.person.car("red").drive("forward", 0.2).check()


LOST_ON = {
    "drive": "[data-live=red]",
    "map": "[data-place=red]",
    "time": "[data-lanes=red]",
    "inspect": "[data-state]",
    "board": "[data-board=red]",
}


def test_lost_car_says_what_is_known_and_what_to_do(stage: ConsoleStage) -> None:
    page = stage.page()
    stage.gateways["red"].kill()
    stage.gateways["red"].wait()
    page.locator("[data-trouble=red]").click()  # leads to the car
    card = page.locator("[data-details=red]")
    card.get_by_text("Whether red moves is not known").wait_for()
    card.get_by_text("Look at the car.").wait_for()
    card.locator(".row", has_text="Motors").get_by_text("unknown").wait_for()
    card.locator(".row", has_text="Battery").get_by_text("not known").wait_for()
    # Each page says so in the same word.
    page.locator("[data-car=red]", has_text="LOST for").wait_for()
    for path, place in LOST_ON.items():
        page.goto(f"{stage.console.address}/#/{path}")
        if path == "drive":
            page.locator("input[name=select-red]").check()
        if path == "inspect":
            page.locator("main select").select_option("red")
        page.locator(place, has_text="LOST").first.wait_for()
    page.goto(f"{stage.console.address}/#/board")
    assert "free" not in page.locator("[data-board=red]").inner_text()
    page.goto(f"{stage.console.address}/#/")
    page.locator("[data-car=red]").click()
    stage.gateways["red"] = stage.fleet.gateway(stage.links["red"], car="red", platform=CARS["red"])
    stage.fleet.ready("red")
    card.get_by_text("online").wait_for()


def serious(page: Page) -> list[str]:
    """Return the serious violations that axe-core finds."""
    found = Axe().run(page).response["violations"]
    return [
        f"{each['id']}: {[node['html'][:120] for node in each['nodes']]}"
        for each in found
        if each["impact"] in ("serious", "critical")
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_violation_on_any_page(stage: ConsoleStage, scheme: str) -> None:
    page = stage.driving_page("red", "green", viewport={"width": 1280, "height": 900}, color_scheme=scheme)
    report = stage.report(page, lambda: page.keyboard.press("Escape"))
    report.locator("[data-stop=red].stop-shown").wait_for()
    for link in page.locator("nav a").all():
        link.click()
        link.and_(page.locator("[aria-current=page]")).wait_for()
        page.locator("main h1").wait_for()
        assert serious(page) == [], link.inner_text()
    page.locator("nav a").first.click()
    stage.details(page)
    assert serious(page) == []
    page.locator("#estop").click()
    assert serious(page) == []


def test_stop_button_is_visible_and_uncovered_on_phone(stage: ConsoleStage) -> None:
    for path in ("", "#/drive"):
        page = stage.phone(path)
        size = page.viewport_size
        box = page.locator("#stop").bounding_box()
        assert size is not None
        assert box is not None
        assert box["width"] > size["width"] / 2
        assert box["height"] >= 60
        assert box["y"] + box["height"] <= size["height"]
        page.locator("#stop").tap(trial=True)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_page_violates_no_content_security_policy(stage: ConsoleStage) -> None:
    page = stage.page()
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.reload()
    page.locator("[data-car=red]").wait_for()
    page.locator("nav a").nth(1).click()
    page.locator("input[name=select-red]").check()
    page.locator("[data-motion=forward]").wait_for()
    assert said == []


def test_ctrl_c_of_console_stops_driven_car(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    with stage.held(page, "forward"):
        ended_ns = time.time_ns()
        os.kill(stage.console.process.pid, signal.SIGINT)
        assert stage.stands(since_ns=ended_ns) < STOPPED_WITHIN_S
        assert stage.console.process.wait() == 0, stage.console.process.stderr
    stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)


def socket_of(stage: ConsoleStage, **headers: str) -> Any:
    """Open a WebSocket to the console as its own page does, but with these headers."""
    hello = urllib.request.Request(f"{stage.console.address}/hello")
    with urllib.request.urlopen(hello) as answer:
        cookie = answer.headers["Set-Cookie"].partition(";")[0]
    ours = {"Origin": stage.console.address, "Cookie": cookie}
    chosen = {name: value for name, value in (ours | headers).items() if value}
    origin = chosen.pop("Origin", None)
    return connect(
        f"ws://127.0.0.1:{stage.console.port}/ws",
        origin=Origin(origin) if origin else None,
        additional_headers=chosen,
        max_size=None,
    )


def test_foreign_sockets_and_paths_out_of_the_folder_are_refused(stage: ConsoleStage) -> None:
    for foreign in ({"Origin": "http://evil.example"}, {"Origin": ""}, {"Cookie": ""}, {"Cookie": "console=guess"}):
        with pytest.raises(InvalidStatus):
            socket_of(stage, **foreign)
    for path in ("/static/../server.py", "/static/%2e%2e/server.py", "/static//etc/passwd", "/etc/passwd"):
        connection = http.client.HTTPConnection("127.0.0.1", stage.console.port)
        connection.request("GET", path)
        assert connection.getresponse().status == 404, path
        connection.close()
    connection = http.client.HTTPConnection("127.0.0.1", stage.console.port)
    connection.request("POST", "/stop", headers={"Origin": "http://evil.example"})
    assert connection.getresponse().status == 403
    connection.close()


def test_bad_messages_and_reconnects_move_no_car(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    begun_ns = time.time_ns()
    with socket_of(stage) as socket_:
        for bad in (
            "{",
            "[]",
            '{"t":"press"}',
            '{"t":"press","press":1,"cars":["*"],"motion":"forward","n":1}',
            "x" * 9000,
        ):
            socket_.send(bad)
        press = {"t": "press", "press": 1, "cars": ["blue"], "motion": "forward", "n": 1}  # a tick of long ago
        socket_.send(json.dumps(press))
        socket_.send("x" * 100_000)  # too large: the console closes this socket
        with contextlib.suppress(ConnectionClosed):
            while True:
                socket_.recv(timeout=20.0)
        assert socket_.close_code == 1009
    for _ in range(100):
        with socket_of(stage):
            pass
    with stage.held(page, "forward"):  # the page goes on
        pass
    stage.stands()
    assert stage.judges["blue"].on_after(begun_ns) == []


def test_reconnects_leak_no_files_threads_or_memory(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    process = psutil.Process(stage.console.process.pid)

    def reconnect(times: int) -> None:
        for _ in range(times):
            with socket_of(stage) as socket_:
                socket_.recv()

    reconnect(100)
    files, threads, rss = process.num_fds(), process.num_threads(), process.memory_info().rss
    reconnect(900)
    wait_for(lambda: process.num_fds() <= files, "each socket is closed")
    grown_mb = (process.memory_info().rss - rss) / 1e6
    print(f"\n1,000 reconnects: {grown_mb:+.1f} MB, {process.num_threads() - threads:+d} threads")
    assert grown_mb < 10
    assert process.num_threads() <= threads
    with stage.held(page, "forward"):  # the page goes on
        pass
    stage.stands()


def test_page_that_reads_nothing_delays_no_other(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    with socket_of(stage) as deaf:
        deaf.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with stage.held(page, "forward"):
            pass
        stage.stands()


def test_two_pages_never_drive_one_car(stage: ConsoleStage) -> None:
    first, second = stage.driving_page("red"), stage.driving_page("red")
    with stage.held(first, "forward"):
        second.locator("[data-motion=back]").hover()
        second.mouse.down()
        second.get_by_text("Another page drives red.").wait_for()
        second.mouse.up()
        assert stage.judges["red"].driving


def test_plan_page_shows_explains_stops_checks_and_sets_plan(stage: ConsoleStage, tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text("roles:\n  guide: {mode: tracking}\n")
    coordinator = stage.fleet.start("-m", "fleet.cli", "plan", "run", str(plan))
    page = stage.page("#/plan")
    guide = page.locator("[data-role=guide] dd")
    guide.filter(has_text="blue").or_(guide.filter(has_text="red")).wait_for()
    car = guide.inner_text()
    assert stage.sim.say({"car": car, "ask": "truth"})
    wait_for(lambda: stage.sim.say({"car": car, "ask": "truth"})["mode"] == "tracking", "it tracks")
    page.locator(f"[data-why={car}] summary").click()
    page.locator(f"[data-why={car}]").get_by_text("Because:").wait_for()
    page.locator("textarea").fill("roles:\n  guide: {mode: flying}\n")
    page.locator("[data-plan=check]").click()
    page.get_by_role("button", name="Line 2:").click()
    assert page.evaluate("document.activeElement.selectionStart") == len("roles:\n")
    assert page.locator("[data-plan=set]").is_disabled()
    assert "flying" not in stage.fleet.get("fleet/@coordinator/plan")[0].text
    page.locator("textarea").fill("# One lamp.\nroles:\n  lamp: {mode: color_led, count: 1}\n")
    assert page.locator("[data-plan=set]").is_disabled(), "it was not tried yet"
    page.locator("[data-plan=check]").click()
    page.locator("[data-change='role guide']").get_by_text("gone").wait_for()
    page.locator("[data-change='role lamp']").get_by_text("color_led").wait_for()
    page.locator("[data-try][data-changed=true]").first.wait_for()
    assert "lamp" not in stage.fleet.get("fleet/@coordinator/plan")[0].text, "it is a dry run"
    assert serious(page) == []
    page.locator("[data-plan=set]").click()
    page.locator("[data-role=lamp]").wait_for()
    page.get_by_text("One lamp, set by you: running.").wait_for()
    assert re.findall(r"[0-9a-f]{12}", page.locator("main").inner_text()) == [], "no hash of a plan"
    page.locator("textarea").fill("#" * 100_000)
    page.locator("[data-plan=check]").click()
    page.get_by_text("The plan has more than 64 KiB.").wait_for()
    assert serious(page) == []
    page.locator("[data-plan=stop]").click()
    page.get_by_text("stopped by").first.wait_for()
    coordinator.end()
    page.get_by_text("Its coordinator has gone.").wait_for()


def test_frames_stand_beside_what_they_became_with_the_ledger(stage: ConsoleStage) -> None:
    page = stage.page("#/inspect")
    page.locator("select").select_option("red")
    page.locator("tbody tr").filter(has_text="$4WD,CSB").filter(has_text="range, battery").first.wait_for()
    stage.person.car("red").whistle().check()
    page.locator("tbody tr").filter(has_text="to the car").first.wait_for()
    page.locator(".ledger").get_by_text("whistle sent (mia)").wait_for()
    whistle = page.locator("tbody tr").filter(has_text="whistle by mia (person)")
    whistle.filter(has_text="sent").first.wait_for()
    whistle.locator("code").filter(has_text="$0,0,").first.wait_for()
    page.locator("[data-doctor]").get_by_text("frames in").wait_for()
    page.locator(".wide").get_by_text("rx_frames").wait_for()
    assert serious(page) == []


def test_readings_of_several_cars_are_plotted_with_their_history(stage: ConsoleStage) -> None:
    said: list[str] = []
    page = stage.page()
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(f"{stage.console.address}/#/plots")
    distance = page.locator("[data-plot='0']")
    distance.locator("canvas").wait_for()
    values = distance.locator(".newest").filter(has_text=re.compile(r"blue [\d.]+, green [\d.]+, red [\d.]+"))
    values.wait_for()
    speed = page.locator("[data-plot='3']")
    speed.locator("select").select_option("sensor/grayscale raw")
    speed.locator(".newest").filter(has_text=re.compile(r"red \d+")).wait_for()
    page.locator(".selection select").select_option("600")
    values.wait_for()
    assert serious(page) == []
    assert said == []

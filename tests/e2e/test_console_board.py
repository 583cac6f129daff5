"""The board in a real browser: a class joins with one code, watches, stops, and gets its cars from a lead."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.e2e.test_console_lan import serious
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.network_client import network_port
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

SIZES = {"phone": (390, 844), "tablet": (820, 1180), "beamer": (1440, 900), "across": (844, 390)}


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--lan", "--lan-port", "0", "--as", "teacher")
    yield stage
    stage.close()


def join(stage: ConsoleStage, code: str, **options: Any) -> Page:
    """Open what the QR code of a class contains, as a phone of a pupil."""
    phone = {**stage.playwright.devices["Pixel 7"], **options}
    page = stage.browser.new_context(ignore_https_errors=True, **phone).new_page()
    page.goto(f"https://127.0.0.1:{network_port(stage.console)}/pair#{code}")
    expect(page.locator("[data-guest]")).to_be_visible()
    return page


def test_class_joins_from_board_and_pupil_gets_car(stage: ConsoleStage) -> None:
    board = stage.page("#/board")
    board.locator("[data-class=open]").click()
    code = board.locator(".class .code").inner_text()
    assert board.locator(".class .qr").evaluate("image => image.complete && image.naturalWidth > 0")
    expect(board.locator(".class-code .fingerprint")).to_contain_text(":")
    assert serious(board) == []
    first, second = join(stage, code), join(stage, code)
    expect(first.locator("[data-guest]")).to_contain_text("You are guest-1.")
    expect(second.locator("[data-guest]")).to_contain_text("You are guest-2.")
    expect(board.locator("[data-guest-name]")).to_have_count(2)
    assert serious(first) == []

    # A guest watches: nothing drives, and STOP stops.
    expect(first.locator("#pause, #estop")).to_have_count(0)
    expect(first.locator("nav a")).to_have_text(["Fleet", "Map", "Plots", "Time line", "Board"])
    first.goto(f"{first.url.partition('#')[0]}#/drive")
    first.locator("input[name=select-red]").check()
    expect(first.locator("[data-motion=forward]")).to_have_attribute("aria-disabled", "true")
    expect(first.locator("main")).to_contain_text("A lead assigns this device")
    stage.person.car("green").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["green"].driving, "green drives")
    expect(board.locator("[data-board=green]")).to_contain_text("mia drives")
    first.locator("#stop").tap()
    stage.stands("green")
    expect(board.locator("[data-board=green]")).to_contain_text("stopped by guest")

    # The lead gives guest-1 a name and red; the page of guest-1 needs no reload.
    row = board.locator("[data-guest-name=guest-1]")
    row.locator("input[name=person]").fill("Nina!")
    row.locator("select[name=car]").select_option("red")
    row.get_by_role("button").click()
    expect(row.get_by_role("alert")).to_contain_text("not allowed")
    row.locator("input[name=person]").fill("nina")
    board.keyboard.press("Enter")
    expect(board.locator("[data-guest-name]")).to_have_count(1)
    expect(board.locator("[data-board=red]")).to_contain_text("lent to nina")
    expect(first.get_by_text("You are nina.")).to_be_visible()
    expect(first.locator("[data-guest]")).to_have_count(0)
    expect(first.locator("[data-motion=forward]")).not_to_have_attribute("aria-disabled", "true")
    box = first.locator("[data-motion=forward]").bounding_box()
    assert box is not None
    devtools = first.context.new_cdp_session(first)
    point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    devtools.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
    wait_for(lambda: stage.judges["red"].driving, "nina drives red")
    expect(board.locator("[data-board=red]")).to_contain_text("nina drives")
    devtools.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    stage.stands("red")

    board.locator("[data-class=close]").click()
    expect(board.locator("[data-class=open]")).to_be_visible()
    late = stage.browser.new_context(ignore_https_errors=True).new_page()
    late.goto(f"https://127.0.0.1:{network_port(stage.console)}/pair#{code}")
    expect(late.locator("#answer")).to_contain_text("This code is wrong, used or too old")
    # Who watches has the board, too, without what is for leads.
    second.goto(f"{second.url.partition('#')[0]}#/board")
    expect(second.locator("[data-board]")).to_have_count(3)
    assert second.locator(".class").count() == 0
    assert serious(second) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_board_fits_each_screen(size: str, scheme: str, stage: ConsoleStage) -> None:
    width, height = SIZES[size]
    touch: dict[str, Any] = {"has_touch": True, "is_mobile": True} if size != "beamer" else {}
    page = stage.page("#/board", viewport={"width": width, "height": height}, color_scheme=scheme, **touch)
    page.locator("[data-class=open]").click()
    expect(page.locator(".class .code")).to_be_visible()
    assert serious(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    name = page.locator("[data-board=red] h2")
    least_px = 40 if size != "phone" else 20  # a phone hangs on no wall: six cars shall be seen at once
    assert float(name.evaluate("(name) => parseFloat(getComputedStyle(name).fontSize)")) >= least_px
    page.keyboard.press("Escape")
    expect(page.locator("[data-report]")).to_be_visible()


def test_without_the_network_the_board_says_how_a_class_joins(stage: ConsoleStage, tmp_path: Path) -> None:
    alone = ConsoleProcess(stage.fleet)
    page = stage.browser.new_context().new_page()
    page.goto(f"{alone.address}/#/board")
    expect(page.locator(".class")).to_contain_text("fleet console --lan")
    page.close()
    assert alone.process.end() == 0

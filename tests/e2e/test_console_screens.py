"""Every page on every screen, in a real browser: nothing is wider than it, covered, out of reach of Tab, or unnamed."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.e2e.test_console import serious, unreachable
from tests.support.console import CARS, ConsoleStage
from tests.support.processes import PATIENCE_S

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

TOUCH: dict[str, Any] = {"has_touch": True, "is_mobile": True}
SCREENS: dict[str, dict[str, Any]] = {
    "phone": {"viewport": {"width": 390, "height": 844}, **TOUCH},
    "phone across": {"viewport": {"width": 844, "height": 390}, **TOUCH},
    "tablet": {"viewport": {"width": 820, "height": 1180}, **TOUCH},
    "tablet across": {"viewport": {"width": 1180, "height": 820}, **TOUCH},
    "laptop": {"viewport": {"width": 1440, "height": 900}},
    # A browser that is zoomed lays a page out in fewer pixels, each as many times larger.
    "laptop at 200 %": {"viewport": {"width": 720, "height": 450}, "device_scale_factor": 2},
    "tablet at 200 %": {"viewport": {"width": 410, "height": 590}, "device_scale_factor": 2},
    "tablet across at 200 %": {"viewport": {"width": 590, "height": 410}, "device_scale_factor": 2},
}
PAGES = ("", "drive", "plan", "map", "plots", "time", "inspect", "people", "board", "sessions", "setup")
WIDER = """() => [document.documentElement, document.querySelector("main")]
  .filter((each) => each.scrollWidth > each.clientWidth + 1).map((each) => `${each.tagName} ${each.scrollWidth}`)"""
COVERED = """() => [...document.querySelectorAll("main :is(a[href], button, input, select, textarea, summary)")]
  .filter((each) => each.getClientRects().length > 0 && !each.disabled && getComputedStyle(each).opacity !== "0")
  .filter((each) => {
    each.scrollIntoView({ block: "nearest" });
    const box = each.getBoundingClientRect();
    const met = document.elementFromPoint(box.x + box.width / 2, Math.min(box.y + box.height / 2, box.bottom - 2));
    return !(each.contains(met) || met?.contains(each) || met?.closest("label")?.contains(each));
  }).map((each) => each.outerHTML.slice(0, 100))"""


@pytest.fixture(scope="module", autouse=True)
def patient() -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)


def show(page: Page, path: str) -> None:
    """Go to a page of the console, and wait for its content."""
    page.evaluate("(to) => { location.hash = to; }", f"#/{path}")
    page.locator("main h1").first.wait_for(state="attached")
    if path == "drive":
        page.locator("input[name=select-red]").check()
        page.locator("[data-motion=forward]").wait_for()
    if path == "map":
        expect(page.locator("[data-mark]")).to_have_count(len(CARS))


@pytest.mark.parametrize("screen", SCREENS)
def test_page_fits_its_screen_and_its_last_button_is_in_reach_while_a_report_is_shown(
    screen: str, stage: ConsoleStage
) -> None:
    page = stage.page(**SCREENS[screen])
    page.keyboard.press("Escape")
    page.locator("[data-report]").wait_for()
    for path in PAGES:
        show(page, path)
        assert page.evaluate(WIDER) == [], path
        assert page.evaluate(COVERED) == [], path
        stop = page.locator("#stop").bounding_box()
        assert stop is not None
        assert 0 <= stop["y"] <= SCREENS[screen]["viewport"]["height"] - stop["height"], "STOP is in view"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("screen", SCREENS)
def test_axe_finds_nothing_serious_on_any_screen(screen: str, scheme: str, stage: ConsoleStage) -> None:
    page = stage.page(**SCREENS[screen], color_scheme=scheme)
    page.keyboard.press("Escape")
    page.locator("[data-report]").wait_for()
    for path in PAGES:
        show(page, path)
        assert serious(page) == [], path


@pytest.mark.parametrize("screen", ["phone", "phone across", "laptop at 200 %"])
def test_tab_reaches_all_controls(screen: str, stage: ConsoleStage) -> None:
    page = stage.page(**SCREENS[screen])
    for path in PAGES:
        show(page, path)
        assert unreachable(page) == [], path

"""Where things are on the pages, in a real browser: a pad in reach, tiles that stay, and a small first load."""

import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from fleet.client.client import Fleet as Client
from fleet.client.supervision import SUPERVISOR_STATUS
from schemas import keys
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.console import CARS, ConsoleProcess, ConsoleStage
from tests.support.processes import PATIENCE_S

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

TOUCH: dict[str, Any] = {"has_touch": True, "is_mobile": True}
PORTRAIT: dict[str, Any] = {"viewport": {"width": 390, "height": 844}, **TOUCH}
LANDSCAPE: dict[str, Any] = {"viewport": {"width": 844, "height": 390}, **TOUCH}
TABLET: dict[str, Any] = {"viewport": {"width": 820, "height": 1180}, **TOUCH}
LAPTOP: dict[str, Any] = {"viewport": {"width": 1366, "height": 768}}
MANY = 20
"""A class: two pupils a car."""
MAX_FIRST_LOAD = 150_000
"""Maximum size of the first load as it is sent, bytes."""
TOUCH_PX = 44
"""Minimum height of what a finger presses (WCAG 2.5.5)."""
MIN_CONTRAST = 3.0
"""Minimum contrast of a mark to what is around it (WCAG 1.4.11)."""
MIN_PAD_SHARE = 1 / 3
"""Minimum share of the screen for the pad of a phone that is held across."""


@pytest.fixture(scope="module", autouse=True)
def browser_timeout() -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)


@pytest.fixture
def twenty_cars(stage: ConsoleStage) -> Iterator[ConsoleStage]:
    """Add cars of which nothing but their presence is known, up to MANY."""
    names = [f"car{number:02d}" for number in range(MANY - len(CARS))]
    tokens = [stage.fleet.bus.token(keys.car_token("fleet", name)) for name in names]
    yield stage
    for token in tokens:
        token.undeclare()
    stage.console.process.kill()
    stage.console.process.wait()
    stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)  # this one has not known them


def is_in_reach(page: Page, selector: str) -> bool:
    """Return True if each element is in view as a whole, and a press on its corners and its middle meets it."""
    script = """(all) => all.length > 0 && all.every((each) => {
      const box = each.getBoundingClientRect();
      const places = [[0.5, 0.5], [0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]];
      return box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight
        && places.map(([x, y]) => [box.left + x * box.width, box.top + y * box.height])
          .every(([x, y]) => each.contains(document.elementFromPoint(x, y)));
    })"""
    return bool(page.locator(selector).evaluate_all(script))


def boxes(tiles: Locator) -> dict[str, list[float]]:
    """Return the place of each tile by car."""
    script = "(all) => all.map((each) => [each.dataset.car, each.getBoundingClientRect().toJSON()])"
    return {car: [box["x"], box["y"], box["width"], box["height"]] for car, box in tiles.evaluate_all(script)}


@pytest.mark.parametrize("screen", [PORTRAIT, LANDSCAPE], ids=["portrait", "landscape"])
def test_report_never_covers_pad_or_stop_on_phone(twenty_cars: ConsoleStage, screen: dict[str, Any]) -> None:
    page = twenty_cars.driving_page("red", **screen)
    expect(page.locator("[data-live=red]")).to_contain_text(re.compile(r"Distance [\d.]+ m"))
    before = page.locator("[data-motion=forward]").bounding_box()
    page.locator("#stop").tap()
    page.locator("[data-report]").wait_for()
    assert is_in_reach(page, ".pad")
    assert is_in_reach(page, "#stop")
    # The presences answer no stop: 17 cars are named, the worst report there is.
    expect(page.locator("[data-stop].stop-failed")).to_have_count(MANY - len(CARS))
    page.locator(".report-line").tap()
    first = page.locator("[data-stop]").evaluate_all("(all) => all.map((each) => each.className.includes('failed'))")
    assert first == sorted(first, reverse=True)
    assert first.count(True) == MANY - len(CARS)
    for scrolled in (0, 10_000):
        page.evaluate(f"document.querySelector('main').scrollTop = {scrolled}")
        assert is_in_reach(page, ".pad")
        assert is_in_reach(page, "#stop")
        assert is_in_reach(page, "nav [aria-current]")
        page.locator("#estop").tap()  # asks for a reason
        page.locator("input[name=why]").wait_for()
        assert is_in_reach(page, "#stop")
        assert is_in_reach(page, "[data-asking] .danger")
        page.locator("#estop").tap()
    page.evaluate("document.querySelector('main').scrollTop = 0")
    assert page.locator("[data-motion=forward]").bounding_box() == before, "it has not moved"
    if screen is LANDSCAPE:
        pad = page.locator(".pads").bounding_box()
        assert pad is not None
        assert pad["width"] * pad["height"] >= MIN_PAD_SHARE * 844 * 390


def test_report_is_one_line_until_it_is_unfolded(stage: ConsoleStage) -> None:
    page = stage.page("#/drive", **PORTRAIT)
    page.locator("#stop").tap()
    report = page.locator("[data-report]")
    expect(report.locator(".report-line")).to_contain_text("1 of 3 shown, 2 sent")
    expect(page.locator("[data-stop]")).to_have_count(0)
    box = report.bounding_box()
    assert box is not None
    assert box["height"] < 60, "less than two buttons"
    report.locator(".report-line").tap()
    expect(page.locator("[data-stop]")).to_have_count(len(CARS))


@pytest.mark.parametrize("screen", [LAPTOP, PORTRAIT], ids=["laptop", "phone"])
def test_twenty_cars_fit_a_laptop_and_six_a_phone(twenty_cars: ConsoleStage, screen: dict[str, Any]) -> None:
    page = twenty_cars.page(**screen)
    tiles = page.locator("[data-car]")
    expect(tiles).to_have_count(MANY)
    fit = MANY if screen is LAPTOP else 6
    assert is_in_reach(page, f".cell:nth-child(-n+{fit}) [data-car]")
    expect(page.locator("[data-summary]")).to_contain_text(f"{MANY} cars · 0 moving")


@pytest.mark.parametrize("screen", [LAPTOP, PORTRAIT], ids=["laptop", "phone"])
def test_no_tile_moves_when_a_car_gets_into_trouble(stage: ConsoleStage, screen: dict[str, Any]) -> None:
    page = stage.page(**screen)
    tiles = page.locator("[data-car]")
    expect(tiles).to_have_count(len(CARS))
    expect(page.locator("[data-trouble]")).to_have_count(0)
    before = boxes(tiles)
    stage.person.car("red").estop("smoke").check()
    expect(page.locator("[data-trouble=red]")).to_contain_text("E-stopped")
    expect(page.locator("[data-car=red]")).to_contain_text("E-stopped")
    assert boxes(tiles) == before
    stage.person.stop(list(CARS))
    for car in ("blue", "green"):
        expect(page.locator(f"[data-car={car}]")).to_contain_text("on hold")
    assert boxes(tiles) == before
    stage.person.pause("lunch")
    try:
        expect(page.locator("[data-paused]")).to_contain_text("Paused by mia: lunch")
        assert boxes(tiles) == before
    finally:
        stage.person.unpause()
    page.locator("[data-trouble=red]").click()
    expect(page.locator("[data-details=red]")).to_contain_text("E-stop of this car by mia: smoke")
    assert boxes(tiles) == before


def test_no_tile_moves_when_cars_come(stage: ConsoleStage) -> None:
    page = stage.page()
    tiles = page.locator("[data-car]")
    expect(tiles).to_have_count(len(CARS))
    before = boxes(tiles)
    tokens = [stage.fleet.bus.token(keys.car_token("fleet", name)) for name in ("aaa", "middle")]
    try:
        expect(tiles).to_have_count(len(CARS) + 2)
        assert {car: box for car, box in boxes(tiles).items() if car in CARS} == before
        page.locator("nav a", has_text="Drive").click()
        expect(page.locator(".car-chip")).to_have_count(len(CARS) + 2)
        chips = page.locator(".car-chip input").evaluate_all("(all) => all.map((each) => each.name)")
        assert chips == [f"select-{car}" for car in (*sorted(CARS), "aaa", "middle")]
    finally:
        for token in tokens:
            token.undeclare()
        stage.console.process.kill()
        stage.console.process.wait()
        stage.console = ConsoleProcess(stage.fleet, port=stage.console.port)  # this one has not known them


@pytest.fixture
def grouped(stage: ConsoleStage) -> Iterator[ConsoleStage]:
    """Say what a supervisor says of groups, until the pages know it."""
    status = pb.Supervision(groups={"left": "red,blue,nobody", "right": "green", "gone": "nobody"})
    publisher = stage.fleet.bus.publisher("fleet/@supervisor/status", SUPERVISOR_STATUS, keys.SUPERVISOR)
    stage.page()  # a console that was just started subscribes before it shows a page
    publisher.put(status, time.time_ns())
    yield stage
    publisher.put(pb.Supervision(), time.time_ns())


def test_fleet_shows_a_group_and_drive_chooses_one(grouped: ConsoleStage) -> None:
    page = grouped.page()
    sets = page.locator("[data-set]")
    expect(sets).to_have_text([re.compile(words) for words in (r"All\s*3", r"@left\s*2", r"@right\s*1")])
    page.locator("[data-set='@right']").click()
    expect(page.locator("[data-car]")).to_have_count(1)
    expect(page.locator("[data-summary]")).to_contain_text("3 cars")
    grouped.person.car("red").estop("smoke").check()
    page.locator("[data-trouble=red]").click()  # of a car that the group hides
    expect(page.locator("[data-details=red]")).to_be_visible()
    expect(page.locator("[data-car]")).to_have_count(len(CARS))
    page.locator("nav a", has_text="Drive").click()
    page.locator("[data-set='@left']").click()
    expect(page.locator(".car-chip.chosen")).to_have_text([re.compile("blue"), re.compile("red")])
    expect(page.locator("[data-live]")).to_have_count(2)
    page.locator("[data-set='@left']").click()
    expect(page.locator(".car-chip.chosen")).to_have_count(0)


def test_drive_says_how_long_a_message_takes(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", wired=True)
    delay = page.locator("[data-delay]")
    expect(delay).to_have_text(re.compile(r"\d+ ms"))
    expect(delay).not_to_have_class("bad")
    stage.wire.cut()
    try:
        expect(delay).to_have_class("bad")
    finally:
        stage.wire.mend()
    expect(delay).not_to_have_class("bad")


def test_each_page_is_two_presses_away_on_a_phone(stage: ConsoleStage) -> None:
    names = stage.page().locator("nav a").all_inner_texts()
    page = stage.page(**PORTRAIT)
    assert is_in_reach(page, "nav a")
    shown = page.locator("nav a").all_inner_texts()
    page.locator("nav a").last.click()
    assert [*shown[:-1], *(name.strip() for name in page.locator("main li a").all_inner_texts())] == names
    page.locator("main li a").last.click()
    page.locator("main h1", has_text="Set up").wait_for()
    assert page.locator("nav a[aria-current]").all_inner_texts() == [shown[-1]]


@pytest.mark.parametrize("screen", [PORTRAIT, LANDSCAPE, TABLET, LAPTOP], ids=["phone", "across", "tablet", "laptop"])
def test_layout_fits_screen_and_touch_targets_are_large(twenty_cars: ConsoleStage, screen: dict[str, Any]) -> None:
    page = twenty_cars.page(**screen)
    controls = "main button, main select, main input:not([type=checkbox]), main summary, nav a, .stopbar button"
    small = "(all) => all.map((each) => [each.outerHTML.slice(0, 80), each.getBoundingClientRect().height])"
    page.locator("[data-car=red]").wait_for()
    for path in ("#/", "#/drive"):
        page.goto(f"{twenty_cars.console.address}/{path}")
        if path == "#/drive":
            page.locator("input[name=select-red]").check()
            page.locator("[data-mode=manual]").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert page.evaluate("document.querySelector('main').scrollWidth <= document.querySelector('main').clientWidth")
        assert [each for each in page.locator(controls).evaluate_all(small) if 0 < each[1] < TOUCH_PX] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_marks_of_white_and_black_cars_have_enough_contrast(stage: ConsoleStage, scheme: str) -> None:
    page = stage.page(**LAPTOP, color_scheme=scheme)
    tile = page.locator("[data-car=red]")
    for color in ("#ffffff", "#000000"):
        tile.evaluate("(tile, color) => tile.style.setProperty('--car', color)", color)
        edge, ground = tile.evaluate(
            "(tile) => [getComputedStyle(tile, '::before').borderLeftColor, getComputedStyle(tile).backgroundColor]"
        )
        mark = (255,) * 3 if color == "#ffffff" else (0,) * 3
        assert max(contrast(rgb(edge), rgb(ground)), contrast(mark, rgb(ground))) >= MIN_CONTRAST
        assert contrast(rgb(edge), mark) >= MIN_CONTRAST or contrast(mark, rgb(ground)) >= MIN_CONTRAST


def rgb(text: str) -> tuple[int, ...]:
    """Return the parts of a color as the browser writes it."""
    return tuple(int(each) for each in re.findall(r"\d+", text)[:3])


def contrast(one: tuple[int, ...], other: tuple[int, ...]) -> float:
    """Return the contrast of two colors by WCAG 2."""

    def luminance(color: tuple[int, ...]) -> float:
        parts = [part / 255 / 12.92 if part <= 10 else ((part / 255 + 0.055) / 1.055) ** 2.4 for part in color]
        return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]

    dark, light = sorted(map(luminance, (one, other)))
    return (light + 0.05) / (dark + 0.05)


def test_tile_says_that_its_car_moves(stage: ConsoleStage) -> None:
    page = stage.page()
    tile = page.locator("[data-car=red]")
    expect(tile).to_contain_text("standing")
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    expect(tile.locator(".tile-motion")).to_have_text("forward")
    expect(tile).to_contain_text("mia drives")
    expect(tile).to_have_attribute("data-direction", "forward")
    playing = "document.getAnimations().map((each) => [each.animationName, each.effect.target.textContent])"
    assert page.evaluate(playing) == [["up", "↑"]]
    page.emulate_media(reduced_motion="reduce")
    assert page.evaluate(playing) == []
    expect(page.locator("[data-summary]")).to_contain_text("1 moving")
    stage.person.stop(["red"])
    expect(tile).to_have_attribute("data-direction", "none")
    stage.stands()


def test_selection_outlives_a_reload_but_not_its_tab(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", "green")
    page.reload()
    for car, chosen in (("red", True), ("green", True), ("blue", False)):
        expect(page.locator(f"input[name=select-{car}]")).to_be_checked(checked=chosen)
    page.locator("input[name=select-green]").uncheck()
    page.reload()
    expect(page.locator("input[name=select-red]")).to_be_checked()
    expect(page.locator("input[name=select-green]")).not_to_be_checked()
    with stage.held(page, "forward"):
        expect(page.locator("[data-live=red] .live-state")).to_contain_text("you drive ·")
    stage.stands()
    other = page.context.new_page()
    other.goto(page.url)
    expect(other.locator("input[name=select-red]")).not_to_be_checked()


def test_person_is_named_without_host_and_process(stage: ConsoleStage) -> None:
    page = stage.page()
    with Client(stage.fleet.endpoint, sender="teacher@vm-32639", kind="person") as teacher:
        for car in CARS:
            teacher.car(car).estop("smoke").check()
    details = stage.details(page)
    expect(details).to_contain_text("by teacher: smoke")
    expect(details.locator(".row", has_text="Last event")).to_contain_text("(teacher)")
    for link in page.locator("nav a").all():
        link.click()
        link.and_(page.locator("[aria-current=page]")).wait_for()
        page.locator("main h1").wait_for()
        if link.get_attribute("href") == "#/inspect":
            continue  # it shows the log of a gateway as it is
        assert re.findall(r".*\w@\w.*", page.locator("main").inner_text()) == [], link.inner_text()


def test_first_load_is_small_and_plots_load_lazily(stage: ConsoleStage) -> None:
    page = stage.page()
    entries = "performance.getEntries().filter((each) => 'transferSize' in each)"
    sent = f"{entries}.map((each) => [each.name, each.transferSize])"
    page.locator("[data-car=red]").wait_for()
    loaded = {name.rpartition("/")[2]: size for name, size in page.evaluate(sent)}
    print(f"\nfirst load: {sum(loaded.values())} bytes in {len(loaded)} requests")
    assert "app.js" in loaded
    assert sum(loaded.values()) <= MAX_FIRST_LOAD
    assert not any(name.startswith(("uplot", "plots")) for name in loaded)
    page.locator("nav a", has_text="Plots").click()
    page.locator("[data-plot='0'] canvas").wait_for()
    assert "uplot.js" in str(page.evaluate(sent))

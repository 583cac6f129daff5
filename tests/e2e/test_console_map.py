"""The map in a real browser: cars by truth and by measured poses, moments of a recording, a keyboard, and no markup."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from fleet.recording.reading.session import Session
from tests.e2e.test_console import serious
from tests.e2e.test_console_pages import call
from tests.e2e.test_console_time import OLD, START_MS, link, shown_at
from tests.fleet.replay.make_session import make
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for
from tests.support.sorted_writer import SortedWriter

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

SIZES = {"phone": (390, 844), "tablet": (820, 1180), "laptop": (1440, 900), "across": (844, 390)}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recordings") / "sessions"
    (made / OLD).mkdir(parents=True)
    make(made / OLD / "0001.mcap", 120, SortedWriter)
    return made


@pytest.fixture(scope="module")
def stages(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--sessions", str(place))
    yield stage
    stage.close()


def test_map_shapes_floors_and_box(stage: ConsoleStage) -> None:
    page = stage.page()
    red, blue = [0, 0, 0, "", None, None], [5, 1, 0, "map", 0.1, 4]
    places = {car: call(page, "map-geometry", "placeOf", each) for car, each in {"red": red, "blue": blue}.items()}
    assert (places["red"]["isTrue"], places["blue"]["isTrue"], places["blue"]["age_s"]) == (True, False, 4)
    assert call(page, "map-geometry", "floorsOf", places) == ["", "map"]
    box = call(page, "map-geometry", "boxOf", [[0, 0], [5, 1]], None)
    assert box == [-0.5, -1, 5.5, 2], "a margin, steps of half a meter, and at least two meters"
    assert call(page, "map-geometry", "boxOf", [[1, 0]], box) == box, "it stands still while a car drives"
    assert call(page, "map-geometry", "boxOf", [[9, 0]], box)[2] == 9.5
    assert call(page, "map-geometry", "pointsOf", None, places, {"blue": [[1, 2, 3]]}, "map") == [[5, 1], [2, 3]]
    before = {"red": [[1, 0, 0], [40_000, 1, 1]], "green": [[1, 0, 0]]}
    new = {"whole": False, "trails": {"red": [[41_000, 2, 2]]}}
    assert call(page, "map-geometry", "grown", before, new, 50_000) == {"red": [[40_000, 1, 1], [41_000, 2, 2]]}
    assert call(page, "map-geometry", "grown", before, new | {"whole": True}, 50_000) == {"red": [[41_000, 2, 2]]}
    assert [call(page, "map-geometry", "degrees", yaw) for yaw in (0, -1.5708, 7)] == [0, 270, 41]


def where(page: Page, car: str) -> tuple[float, float]:
    """Return x and y of a car by the list, m."""
    words = page.locator(f"[data-place={car}]").inner_text()
    found = re.search(r"x (-?[\d.]+) m, y (-?[\d.]+) m", words)
    assert found, words
    return float(found[1]), float(found[2])


def test_simulated_car_is_drawn_where_it_truly_is(stage: ConsoleStage) -> None:
    page = stage.page("#/map")
    expect(page.locator("[data-mark]")).to_have_count(3)
    expect(page.locator("[data-place=red]")).to_contain_text("simulated: true position")
    expect(page.locator(".map .wall").first).to_be_attached()
    stage.person.car("red").drive("forward", 1.0, wait=False).check()
    expect(page.locator("[data-place=red]")).to_contain_text("mia drives")
    stage.stands()

    def is_there() -> bool:
        truth = stage.sim.say({"car": "red", "ask": "truth"})
        return all(
            abs(one - other) < 0.02 for one, other in zip(where(page, "red"), (truth["x_m"], truth["y_m"]), strict=True)
        )

    wait_for(is_there, "the list has its true place")
    assert page.locator(".map .trail").count() >= 1, "it has a trail"


def test_map_poses_have_own_floor_and_names_are_no_markup(stage: ConsoleStage) -> None:
    page = stage.page("#/map")
    frame = "<b onclick=alert(1)>\u202egro\u200bund"
    pose = json.dumps({"frame": frame, "x_m": 900, "y_m": 2, "heading_rad": 1, "xy_std_m": 0.05}).encode()

    def floors() -> list[str]:
        stage.fleet.bus.put_command("fleet/phantom/sensor/pose", pose, "application/json")
        stage.fleet.bus.put_command("fleet/nowhere/sensor/range", b'{"range_m": 1}', "application/json")
        return page.locator("select[name=floor] option").all_inner_texts()

    assert wait_for(floors, "there are two floors") == ["of the simulation", "<b onclick=alert(1)>ground"]
    phantom = page.locator("[data-place=phantom]")
    expect(phantom).to_contain_text("measured, in <b onclick=alert(1)>ground, ± 0.05 m")
    expect(phantom).to_contain_text("on the floor <b onclick=alert(1)>ground")
    expect(page.locator("[data-place=nowhere]")).to_contain_text("No position")
    expect(page.locator("[data-mark=nowhere]")).to_have_count(0)
    expect(page.locator("[data-mark=phantom]")).to_have_count(0)
    page.locator("select[name=floor]").select_option(index=1)
    expect(page.locator("[data-mark]")).to_have_count(1)
    expect(page.locator("[data-mark=phantom]")).to_be_visible()
    assert page.locator(".map .wall").count() == 0
    assert page.locator("main b").count() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_map_fits_each_screen_and_is_used_by_keyboard(size: str, scheme: str, stage: ConsoleStage) -> None:
    width, height = SIZES[size]
    touch: dict[str, Any] = {"has_touch": True, "is_mobile": True} if size != "laptop" else {}
    page = stage.page("#/map", viewport={"width": width, "height": height}, color_scheme=scheme, **touch)
    expect(page.locator("[data-mark]")).to_have_count(3)
    assert serious(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    area, stop = page.locator(".map-area svg").bounding_box(), page.locator("#stop").bounding_box()
    assert area is not None
    assert stop is not None
    assert area["height"] > height / 3, "the picture is large"
    page.locator("[data-fit]").focus()
    page.keyboard.press("Tab")
    focused = page.evaluate("document.activeElement.dataset.place")
    page.keyboard.press("Enter")
    expect(page.locator(f"[data-place={focused}]")).to_have_attribute("aria-pressed", "true")
    expect(page.locator(f"[data-mark={focused}] .is-chosen")).to_be_visible()


def test_map_of_a_moment_is_that_of_the_recording(stage: ConsoleStage, place: Path) -> None:
    table = Session(place / OLD).to_pandas("sim/truth")
    at_ms = START_MS + 60_500
    page = stage.page(link("map", at_ms))
    shown_at(page, at_ms)
    expect(page.locator("[data-mark]")).to_have_count(3)
    known = table[table["log_time"].astype("int64") <= at_ms * 1_000_000]
    for car in ("red", "green", "blue"):
        row = known[known["car"] == car].iloc[-1]
        assert where(page, car) == (round(row["x_m"], 2), round(row["y_m"], 2))
        expect(page.locator(f"[data-mark={car}]")).to_be_visible()
    expect(page.locator(".map .trail").first).to_be_attached()
    page.locator("input[name=scrub]").focus()
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    earlier = int(page.locator("[data-past-at]").get_attribute("data-past-at") or 0)
    assert abs(earlier - (at_ms - 500)) <= 100, "steps of the slider count from the first message"
    shown_at(page, earlier)
    stage.person.car("blue").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["blue"].driving, "blue drives")
    page.keyboard.press("Escape")
    stage.stands("blue")
    expect(page.locator("[data-past-at]")).to_have_count(1)
    page.goto(page.url.replace("#/map", "#/plan"))
    expect(page.locator("[data-plan-then]")).to_contain_text("the last plan that was put in force by then")
    assert page.locator("main textarea").count() == 0
    page.locator("[data-live-now]").click()
    expect(page.locator("main textarea")).to_be_visible()


def test_only_who_opens_the_map_loads_it(stage: ConsoleStage) -> None:
    page = stage.page()
    loaded: list[str] = []
    page.on("request", lambda request: loaded.append(request.url))
    page.reload()
    page.locator("[data-car]").first.wait_for()
    assert not [url for url in loaded if "map" in url]
    page.locator("nav a", has_text="Map").click()
    expect(page.locator("[data-mark]")).to_have_count(3)
    assert any(url.endswith("map-page.js") for url in loaded)

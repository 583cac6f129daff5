"""The page of sessions in a real browser: the recorder, marks, and the actions on a recording."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.e2e.test_console import serious
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings") / "sessions"


@pytest.fixture(scope="module")
def stages(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--sessions", str(place))
    recorder = stage.fleet.start("-m", "fleet.cli", "record", "run", "--sessions", str(place), "--json")
    recorder.line()
    yield stage
    stage.close()


def sessions_page(stage: ConsoleStage) -> Page:
    page = stage.page("#/sessions")
    page.locator("[data-session]").first.wait_for()
    return page


def others(row: Locator) -> Locator:
    """Unfold the other actions of a recording. Return it."""
    if row.locator("details.others[open]").count() == 0:
        row.locator("details.others > summary").click()
    return row


def test_page_records_marks_and_closes_what_it_started(stage: ConsoleStage, place: Path) -> None:
    page = sessions_page(stage)
    page.locator("[data-recorder=recording]").wait_for()
    page.locator("input[name=mark]").fill("here it slips")
    page.locator("[data-record=mark]").click()
    page.get_by_text("Marked.").wait_for()
    page.locator("[data-record=stop]").click()
    page.locator("[data-recorder=stopped]").wait_for()
    row = page.locator("[data-session]").filter(has_text="whole")
    row.wait_for()
    expect(row.locator("h3")).to_have_text(re.compile(r"today \d\d:\d\d, \d+ (s|min)"))
    expect(row.locator("[data-mark]")).to_have_text(re.compile(r"\d\d:\d\d:\d\d here it slips"))
    assert row.locator(".main").count() == 1
    others(row).get_by_role("button", name="Verify").click()
    row.get_by_text("whole,").wait_for()
    with page.expect_download() as downloaded:
        row.get_by_role("link", name="Download").first.click()
    with zipfile.ZipFile(downloaded.value.path()) as archive:
        assert any(name.endswith("/0001.mcap") for name in archive.namelist())
        assert b"here it slips" in archive.read(next(name for name in archive.namelist() if "session.json" in name))
    row.get_by_role("button", name="Export CSV").click()
    with page.expect_download() as exported:
        row.get_by_role("link", name="Download the tables").click()
    with zipfile.ZipFile(exported.value.path()) as archive:
        assert any(name.endswith("/fleet.v1.Range.csv") for name in archive.namelist())
    row.get_by_role("button", name="Export Parquet").click()
    with page.expect_download() as exported:
        row.get_by_role("link", name="Download the tables").and_(page.locator("[href*=parquet]")).click()
    with zipfile.ZipFile(exported.value.path()) as archive:
        (table,) = [name for name in archive.namelist() if name.endswith("/fleet.v1.Range.parquet")]
        assert archive.read(table)[:4] == b"PAR1"
    page.locator("[data-record=start]").click()
    page.locator("[data-recorder=recording]").wait_for()
    wait_for(lambda: page.locator("[data-session]").count() == 2, "the new session is listed")


def test_stop_arrives_while_session_is_verified_and_opened_in_rerun(stage: ConsoleStage) -> None:
    page = sessions_page(stage)
    row = page.locator("[data-session]").last
    others(row).get_by_role("button", name="Open in Rerun").click()
    others(row).get_by_role("button", name="Verify").click()
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    report = stage.report(page, lambda: page.keyboard.press("Escape"))
    stage.stands()
    report.locator("[data-stop=red].stop-shown").wait_for()
    row.get_by_role("button", name="Open in Rerun").click()
    link = row.get_by_role("link", name="Show it in a new tab")
    link.wait_for()
    with page.context.expect_page() as opened:
        link.click()
    viewer = opened.value
    viewer.wait_for_load_state()
    assert viewer.locator("canvas").count() >= 1
    viewer.close()


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_axe_finds_nothing_serious_and_the_stop_is_in_view(stage: ConsoleStage, size: str) -> None:
    page = stage.phone("#/sessions") if size == "phone" else stage.page("#/sessions")
    page.locator("[data-session]").first.wait_for()
    page.locator("[data-recorder]").wait_for()
    others(page.locator("[data-session]").first)
    assert serious(page) == []
    box, window = page.locator("#stop").bounding_box(), page.viewport_size
    assert box is not None
    assert window is not None
    assert box["y"] + box["height"] <= window["height"]
    page.locator("#stop").click(trial=True)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_each_action_is_reached_by_keyboard(stage: ConsoleStage) -> None:
    page = sessions_page(stage)
    page.locator("[data-recorder]").wait_for()
    for row in page.locator("[data-session]").all():
        others(row)
    wanted = page.locator("main button, main a, main input").count()
    reached: set[str] = set()
    for _ in range(wanted + 40):
        page.keyboard.press("Tab")
        focus = page.evaluate_handle("document.activeElement")
        if focus.evaluate("each => each.matches('main button, main a, main input')"):
            reached.add(focus.evaluate("each => [...document.querySelectorAll('main *')].indexOf(each) + ''"))
    assert len(reached) == page.locator("main button:enabled, main a, main input").count()

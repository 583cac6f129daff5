"""Texts of others in every field of the page, in a real browser: no markup, no turned line, nothing unseen."""

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from playwright.sync_api import Dialog, Page, expect

from fleet.cli import cli
from schemas import keys
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.network_client import NetworkDevice, network_port
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

MARKUP = "<img src=x onerror=alert(1)><b>bold</b>"
TURNED = "\u202eevil\u200b\u2066\u0007"
HEBREW = "\u05d0\u05d1\u05d2 1"
WORDS = f"{MARKUP}{TURNED}{HEBREW}"
SHOWN = f"\u2068{MARKUP}evil{HEBREW}\u2069"
UNSEEN = re.compile("[\u202a-\u202e\u2066\u2067\u200b-\u200f\u0007]")
NAME = "<b>bold\u202eevil\u200b"
"""A text without a slash, for what is a part of a key or a path."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings") / "sessions"


@pytest.fixture(scope="module")
def stages(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--sessions", str(place), "--lan", "--lan-port", "0")
    recorder = stage.fleet.start("-m", "fleet.cli", "record", "run", "--sessions", str(place), "--json")
    recorder.line()
    yield stage
    stage.close()


@pytest.fixture
def page(stage: ConsoleStage) -> Iterator[Page]:
    opened = stage.page()
    said: list[str] = []

    def on_dialog(dialog: Dialog) -> None:
        said.append(dialog.message)
        dialog.dismiss()

    opened.on("dialog", on_dialog)
    yield opened
    assert said == []


def is_text(page: Page) -> None:
    """Check what the page shows, and what it says to a screen reader."""
    said = page.evaluate(
        "[document.body.innerText, ...[...document.querySelectorAll('*')].flatMap("
        "(each) => ['title', 'aria-label', 'alt'].map((name) => each.getAttribute(name) ?? ''))].join(' ')"
    )
    assert UNSEEN.findall(said) == []
    assert page.locator("main img[src=x], main b").count() == 0


def test_a_mark_and_the_name_of_a_recording_are_text(stage: ConsoleStage, page: Page, place: Path) -> None:
    page.goto(f"{stage.console.address}/#/sessions")
    page.locator("input[name=mark]").fill(WORDS)
    page.locator("[data-record=mark]").click()
    page.get_by_text("Marked.").wait_for()
    page.locator("[data-record=stop]").click()
    page.locator("[data-recorder=stopped]").wait_for()
    (session,) = place.iterdir()
    shutil.copytree(session, place / f"{session.name}-{NAME}")
    page.reload()
    odd = page.locator("[data-session]").filter(has_text="<b>boldevil")
    odd.wait_for()
    is_text(page)
    odd.locator("details.others > summary").click()
    odd.get_by_role("button", name="Verify").click()
    odd.get_by_text("whole,").wait_for()
    is_text(page)
    odd.locator(".main").click()
    page.locator("[data-past-at][data-coming=false]").wait_for()
    page.locator("select[name=session]").wait_for()
    is_text(page)
    page.locator("[data-live-now]").click()


def test_names_in_a_plan_are_text(stage: ConsoleStage, page: Page) -> None:
    page.goto(f"{stage.console.address}/#/plan")
    area = page.get_by_role("textbox")
    area.fill(f"name: {json.dumps(WORDS)}\nroles:\n  {json.dumps(WORDS)}: {{mode: {json.dumps(WORDS)}}}\n")
    page.locator("[data-plan=check]").click()
    page.get_by_text("onerror").first.wait_for()
    is_text(page)


def test_a_stranger_on_the_bus_with_such_a_name_is_no_car(stage: ConsoleStage, page: Page) -> None:
    bus, kept = stage.fleet.bus, []
    for name in (NAME, "red\u200b", "stranger"):  # the last one is what a car may be called, and comes after the others
        kept.append(bus.token(keys.car_token("fleet", name)))
        link = bus.publisher(f"fleet/{name}/state/link", TOPICS["state/link"], name)
        link.put(pb.Link(car=name, state=WORDS, reason=WORDS), time.time_ns())
    page.locator("[data-car=stranger]").wait_for()
    report = stage.report(page, lambda: page.keyboard.press("Escape"))
    expect(report.locator("[data-stop=red]")).to_have_count(1)
    for each in page.locator("nav a").all():
        each.click()
        each.and_(page.locator("[aria-current=page]")).wait_for()
        is_text(page)
    page.goto(f"{stage.console.address}/#/")
    cars = page.locator("[data-car]").evaluate_all("(all) => all.map((each) => each.dataset.car)")
    assert sorted(cars) == ["blue", "green", "red", "stranger"]


def test_devices_and_people_are_text(stage: ConsoleStage, page: Page) -> None:
    device = NetworkDevice(network_port(stage.console))
    made = CliRunner().invoke(cli, ["console", "pair", "eva"], env=stage.fleet.environment)
    code = made.output.split(" type ")[1][:9]
    agent = WORDS.replace("\u0007", "").encode().decode("latin-1")
    assert device.ask("POST", "/pair", code, **{"User-Agent": agent})[0] == 200
    page.goto(f"{stage.console.address}/#/people")
    page.locator("[data-device]").wait_for()
    is_text(page)
    page.locator("input[name=person]").fill(WORDS[:32])
    page.locator("form button").click()
    page.locator("[role=status] p").first.wait_for()
    is_text(page)

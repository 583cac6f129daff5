"""Texts of others in every field of the page, in a real browser: no markup, no turned line, nothing unseen."""

import json
import re
import shutil
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from playwright.sync_api import Dialog, Page, expect

from fleet.cli import cli
from schemas import keys, messages
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
HEADER = {"stamp", "car", "seq", "boot_id"}
"""Fields that the publisher fills."""
USUAL = {
    "state/link": {"state": "online"},
    "state/mode": {"asked": "tracking", "inferred": "tracking", "verdict": "confirmed"},
    "state/motion": {"motion": "forward"},
    "state/safety": {"motors": "on", "motors_basis": "shown"},
    "event/command": {"verb": "stop", "phase": "failed"},
}
"""Words of closed sets with which the pages show the fields beside them."""


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


def fill(message: Any) -> Any:
    """Write WORDS into each text of a message, and 1 into each number. Lists have one element."""
    for field in message.DESCRIPTOR.fields:
        if field.name in HEADER:
            continue
        value = WORDS if field.type == field.TYPE_STRING else WORDS.encode() if field.type == field.TYPE_BYTES else 1
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            found, kind = getattr(message, field.name), field.message_type.fields_by_name["value"]
            if kind.message_type is not None:
                fill(found[WORDS])
            else:
                found[WORDS] = WORDS if kind.type == kind.TYPE_STRING else 1
        elif field.message_type is not None:
            found = getattr(message, field.name)
            fill(found.add() if field.is_repeated else found)
        elif field.is_repeated:
            getattr(message, field.name).append(value)
        else:
            setattr(message, field.name, value)
    return message


def test_mark_and_the_name_of_a_recording_are_text(stage: ConsoleStage, page: Page, place: Path) -> None:
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


def test_stranger_on_bus_with_odd_name_is_no_car(stage: ConsoleStage, page: Page) -> None:
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


def test_each_text_of_each_message_is_text_on_every_page(stage: ConsoleStage, page: Page, place: Path) -> None:
    bus, car = stage.fleet.bus, "talker"
    token = bus.token(keys.car_token("fleet", car))
    publishers = {
        name: bus.publisher(f"fleet/{name if name.startswith('@') else f'{car}/{name}'}", topic, car)
        for name, topic in TOPICS.items()
    }

    def talk() -> None:
        """Publish each message twice: with odd words alone, and with words that a page knows beside them."""
        for usual in ({}, USUAL):
            for name, publisher in publishers.items():
                message = fill(messages.message_class(TOPICS[name].message)())
                for field, words in usual.get(name, {}).items():
                    setattr(message, field, words)
                if usual and name == "state/safety":
                    for field in ("hold", "estops", "loan"):  # who is lost or stopped is shown without a driver
                        message.ClearField(field)
                if name == "event/command":
                    message.id = f"{time.time_ns()}"
                publisher.put(message, time.time_ns())

    page.goto(f"{stage.console.address}/#/sessions")
    page.locator("[data-recorder]").wait_for()
    if page.locator("[data-record=start]").count():
        page.locator("[data-record=start]").click()
    page.locator("[data-recorder=recording]").wait_for()
    page.goto(f"{stage.console.address}/#/")
    talk()
    page.locator(f"[data-car={car}]").click()
    page.locator(f"[data-details={car}]").wait_for()
    running = max(each.name for each in place.iterdir() if NAME not in each.name)
    began_ms = time.time_ns() // 1_000_000

    def is_text_everywhere(where: str) -> None:
        for path in ("", "drive", "plan", "map", "plots", "time", "inspect", "people", "board", "sessions", "setup"):
            page.evaluate("(to) => { location.hash = to; }", f"#/{path}{where}")
            page.locator("main h1").first.wait_for(state="attached")
            talk()
            if path == "drive":
                page.evaluate("async (car) => (await import('/static/console.js')).select([car])", car)
                page.locator(f"[data-live={car}]").wait_for()
            if path == "inspect":
                page.locator("main select").first.select_option(car)
                page.locator("[data-doctor]").wait_for()
            if path == "map":
                page.locator(f"[data-place={car}]").wait_for()
            if path == "time":
                expect(page.locator(f"[data-lanes={car}]")).to_contain_text("onerror")
            if path == "board":
                expect(page.locator(f"[data-board={car}]")).to_contain_text("onerror")
            page.wait_for_timeout(300)  # some more messages
            is_text(page)

    is_text_everywhere("")
    page.wait_for_timeout(2500)  # until the recorder has written it
    at = datetime.fromtimestamp(began_ms / 1000 + 3, UTC).replace(tzinfo=None).isoformat(timespec="milliseconds")
    is_text_everywhere(f"?session={running}&at={at}Z")
    del token

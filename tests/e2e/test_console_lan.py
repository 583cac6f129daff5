"""The console on the network in a real browser: a phone pairs, drives, and is revoked in the page People."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.support.console import DESKTOP, ConsoleProcess, find_chromium
from tests.support.judge import Judge
from tests.support.network_client import network_port
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)


def serious(page: Page) -> list[str]:
    """The serious violations that axe-core finds."""
    found = Axe().run(page).response["violations"]
    return [f"{each['id']}: {each['nodes']}" for each in found if each["impact"] in ("serious", "critical")]


@pytest.fixture
def browser() -> Iterator[Browser]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=find_chromium(playwright))
        yield opened
        opened.close()


def test_a_phone_pairs_by_keyboard_drives_and_is_revoked(browser: Browser, tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
        fleet.gateway(link, "--person", "teacher:lead", "--person", "group_a")
        judge = Judge.follow(fleet.bus, "red")
        console = ConsoleProcess(fleet, "--as", "teacher", "--lan", "--lan-port", "0")
        fleet.ready("red")

        # The lead makes a code in the page.
        teacher = browser.new_context(**DESKTOP).new_page()
        teacher.goto(f"{console.address}/#/people")
        teacher.locator("input[name=person]").fill("group_a")
        teacher.keyboard.press("Enter")
        code = teacher.locator(".code").inner_text()
        assert teacher.locator(".qr").evaluate("image => image.complete && image.naturalWidth > 0")
        assert serious(teacher) == []

        # A phone sees the page that pairs, and nothing else. A wrong code says so.
        phone = browser.new_context(ignore_https_errors=True, color_scheme="dark", **DESKTOP).new_page()
        phone.goto(f"https://127.0.0.1:{network_port(console)}/")
        expect(phone.get_by_role("heading", name="Pair this device")).to_be_visible()
        assert serious(phone) == []
        phone.keyboard.press("Tab")
        phone.keyboard.type("AAAA-AAAA")
        phone.keyboard.press("Enter")
        expect(phone.locator("#answer")).to_contain_text("This code is wrong")
        assert serious(phone) == []
        phone.keyboard.press("Control+a")
        phone.keyboard.type(code)
        phone.keyboard.press("Enter")
        expect(phone.get_by_text("You are group_a.")).to_be_visible()

        # What is for leads is refused there, with its reason.
        for page, allowed in ((phone, False), (teacher, True)):
            page.goto(page.url.partition("#")[0] + "#/plan")
            expect(page.locator("[data-plan=set]")).to_be_enabled(enabled=allowed)
            expect(page.locator("[data-plan=check]")).to_be_enabled()
            expect(page.locator("main .refused")).to_have_text([] if allowed else ["Only a lead may (teacher)."])
            assert serious(page) == []

        # It drives, and the lead revokes it while its button is held.
        phone.goto(phone.url.partition("#")[0] + "#/drive")
        phone.locator("input[name=select-red]").check()
        phone.locator("[data-motion=forward]").hover()
        phone.mouse.down()
        wait_for(lambda: judge.driving, "red drives")
        teacher.goto(f"{console.address}/#/people")
        teacher.get_by_role("button", name="Revoke a device of group_a").click()
        assert serious(teacher) == []
        teacher.get_by_role("button", name="Yes, revoke it").click()
        wait_for(lambda: not judge.driving, "red stands")
        expect(phone.get_by_text("This device is not paired any more.")).to_be_visible()
        assert serious(phone) == []
        expect(teacher.locator("[data-device]")).to_have_count(0)
        phone.mouse.up()
        phone.get_by_role("link", name="Pair it again").click()
        expect(phone.get_by_role("heading", name="Pair this device")).to_be_visible()
        assert console.process.end() == 0
    finally:
        fleet.close()

"""The console on the network in a real browser: a phone pairs, drives, and is revoked in the page People."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from click.testing import CliRunner
from playwright.sync_api import Browser, Page, expect, sync_playwright

from fleet.cli import cli
from fleet.client.client import Fleet as Client
from gateway.drivers.yahboom.protocol.frames import General, encode
from schemas.words import Motion
from tests.support.console import DESKTOP, ConsoleProcess, find_chromium, hold_until_driving
from tests.support.judge import Judge
from tests.support.network_client import network_port
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)


def serious(page: Page) -> list[str]:
    """Return the serious violations that axe-core finds."""
    found = Axe().run(page).response["violations"]
    return [f"{each['id']}: {each['nodes']}" for each in found if each["impact"] in ("serious", "critical")]


@pytest.fixture
def browser() -> Iterator[Browser]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=find_chromium(playwright))
        yield opened
        opened.close()


def test_phone_pairs_by_keyboard_drives_and_is_revoked(browser: Browser, tmp_path: Path) -> None:
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

        # A phone gets only the page for pairing. The page reports a wrong code.
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

        # The page refuses the actions of leads, and says why.
        for page, allowed in ((phone, False), (teacher, True)):
            page.goto(page.url.partition("#")[0] + "#/plan")
            page.locator("select[name=example]").select_option(index=1)
            page.locator("[data-plan=check]").click()
            page.locator("[data-trial]").wait_for()
            expect(page.locator("[data-plan=set]")).to_be_enabled(enabled=allowed)
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
        expect(phone.locator(".banner")).to_contain_text(["This device is not paired any more. It stops no car"])
        expect(phone.locator("#stop")).to_contain_text("STOP does not work on this device")
        # The texts of the page are true.
        with Client(fleet.endpoint, sender="teacher", kind="person") as lead:
            lead.car("red").drive("forward", 10.0, wait=False).check()
            wait_for(lambda: judge.driving, "red drives")
            phone.keyboard.press("Escape")
            expect(phone.get_by_text("STOP has not reached the console.")).to_be_visible()
            assert judge.driving
            lead.stop(["red"])
        assert serious(phone) == []
        expect(teacher.locator("[data-device]")).to_have_count(0)
        phone.mouse.up()
        phone.get_by_role("link", name="Pair it again").click()
        expect(phone.get_by_role("heading", name="Pair this device")).to_be_visible()
        assert console.process.end() == 0
    finally:
        fleet.close()


FORWARD = "[data-motion=forward]"


def paired_page(browser: Browser, fleet: FleetProcesses, port: int, *person: str) -> Page:
    """Open the drive page on a device that pairs as this person by the address of a QR code."""
    done = CliRunner().invoke(cli, ["console", "pair", *person], env=fleet.environment)
    code = done.output.split(" type ")[1][:9]
    page = browser.new_context(ignore_https_errors=True, **DESKTOP).new_page()
    page.goto(f"https://127.0.0.1:{port}/pair#{code}")
    expect(page.locator(".person")).to_contain_text(f"You are {person[0]}")
    page.goto(f"https://127.0.0.1:{port}/#/drive")
    return page


def test_group_and_a_teacher_share_one_console(browser: Browser, tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        _, links = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp", truth=True)
        for car, link, own, other in zip(("red", "blue"), links, "ab", "ba", strict=True):
            people = ("teacher:lead", f"group_{own}", f"group_{other}:other")
            fleet.gateway(link, *(word for name in people for word in ("--person", name)), car=car)
        judges = {car: Judge.follow(fleet.bus, car) for car in ("red", "blue")}
        console = ConsoleProcess(fleet, "--lan", "--lan-port", "0")
        for car in judges:
            fleet.ready(car)
        port = network_port(console)
        ours = paired_page(browser, fleet, port, "group_a")
        teacher = paired_page(browser, fleet, port, "teacher", "--rank", "lead")
        red, blue = (f"input[name=select-{car}]" for car in judges)
        refused = ours.locator("[data-control=drive] .refused")

        def press_for_nothing() -> None:
            """Hold the button of the pad for a second. Check that no command reaches the car."""
            frames = len(judges["red"].frames)
            ours.locator(FORWARD).hover()
            ours.mouse.down()
            ours.wait_for_timeout(1000)
            ours.mouse.up()
            assert not judges["red"].driving
            assert [why for _, why, _ in judges["red"].frames[frames:] if why == "command"] == []

        # The group drives its own car, and not the other one.
        ours.locator("details.others > summary").click()
        ours.locator(blue).check()
        expect(refused).to_have_text("group_a drives other cars, not blue.")
        ours.locator(FORWARD).click(force=True)
        assert not judges["blue"].driving
        ours.locator(blue).uncheck()
        ours.locator(red).check()
        hold_until_driving(ours, judges["red"])

        # The teacher pauses while the group holds its button.
        teacher.locator("#pause").click()
        teacher.locator("input[name=why]").fill("look here")
        teacher.locator("[data-asking=pause] .danger").click()
        wait_for(lambda: not judges["red"].driving, "the pause stops it")
        expect(ours.locator("[data-paused]")).to_contain_text("Paused by teacher: look here")
        expect(ours.locator("[data-paused] button")).to_be_disabled()
        ours.mouse.up()
        press_for_nothing()
        teacher.locator("[data-paused] button").click()
        expect(ours.locator("[data-paused]")).to_have_count(0)

        # The teacher takes the car over without driving it, and gives it back.
        teacher.locator(red).check()
        teacher.get_by_role("button", name="Take over red").click()
        expect(refused).to_contain_text("teacher drives red.")
        press_for_nothing()
        hold_until_driving(teacher, judges["red"])
        teacher.mouse.up()
        wait_for(lambda: not judges["red"].driving, "red stands")
        teacher.get_by_role("button", name="Give back red").click()
        expect(refused).to_have_count(0)
        hold_until_driving(ours, judges["red"])
        ours.mouse.up()
        wait_for(lambda: not judges["red"].driving, "red stands")
        assert not judges["blue"].motors or not any(on for _, on in judges["blue"].motors), "nobody drove it"
        assert console.process.end() == 0
    finally:
        fleet.close()


def test_lead_takes_car_of_pupil_but_not_reverse(browser: Browser, tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
        fleet.gateway(link, *(word for name in ("teacher:lead", "group_a") for word in ("--person", name)))
        judge = Judge.follow(fleet.bus, "red")
        console = ConsoleProcess(fleet, "--lan", "--lan-port", "0")
        fleet.ready("red")
        port = network_port(console)
        ours = paired_page(browser, fleet, port, "group_a")
        teacher = paired_page(browser, fleet, port, "teacher", "--rank", "lead")
        back = encode(General(Motion.BACK))
        for page in (ours, teacher):
            page.locator("input[name=select-red]").check()

        def goes_back_after(moment_ns: int) -> bool:
            return back in [data for _, data in judge.written_after(moment_ns)]

        hold_until_driving(ours, judge)
        taken_ns = time.time_ns()
        teacher.locator("[data-motion=back]").hover()
        teacher.mouse.down()
        wait_for(lambda: goes_back_after(taken_ns), "the lead drives it")
        expect(ours.locator(".results")).to_contain_text("teacher drives red now.")
        expect(ours.locator("[data-control=drive] .refused")).to_contain_text("teacher drives red.")
        expect(ours.locator(".pad.held")).to_have_count(0)
        expect(teacher.locator("[data-motion=back].held")).to_have_count(1)
        assert judge.driving

        # The pupil lets go and presses again: the car of a lead stays with the lead.
        ours.mouse.up()
        pressed_ns = time.time_ns()
        ours.mouse.down()
        ours.wait_for_timeout(1000)
        ours.mouse.up()
        assert encode(General(Motion.FORWARD)) not in [data for _, data in judge.written_after(pressed_ns)]
        assert judge.driving
        teacher.mouse.up()
        judge.wait_off(time.time_ns(), watched_s=1.0)
        expect(ours.locator("[data-control=drive] .refused")).to_have_count(0)
        hold_until_driving(ours, judge)
        ours.mouse.up()
        judge.wait_off(time.time_ns(), watched_s=0.6)
        assert console.process.end() == 0
    finally:
        fleet.close()

"""The pages of a lead and of a group, in a real browser. They show rights before a person tries an action."""

from collections.abc import Iterator

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect, sync_playwright

from tests.support.console import DESKTOP, ConsoleProcess, find_chromium, hold_until_driving
from tests.support.judge import Judge
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)
PEOPLE = ("teacher:lead", "group_a", "group_b:other")


class Room:
    """One car of group a, and a page for each person."""

    def __init__(self, fleet: FleetProcesses) -> None:
        self.fleet = fleet
        _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
        fleet.gateway(link, "--people-only", *(word for name in PEOPLE for word in ("--person", name)))
        self.judge = Judge.follow(fleet.bus, "red")
        fleet.ready("red")
        self.playwright = sync_playwright().start()
        self.browser = self.playwright.chromium.launch(executable_path=find_chromium(self.playwright))
        self.consoles = {name: ConsoleProcess(fleet, "--as", name) for name in ("teacher", "group_a", "group_b")}

    def page(self, person: str) -> Page:
        """Open the drive page of a person, with the car selected."""
        page = self.browser.new_context(**DESKTOP).new_page()
        page.set_default_timeout(PATIENCE_S * 1000)
        page.goto(f"{self.consoles[person].address}/#/drive")
        page.locator("input[name=select-red]").check()
        return page

    def close(self) -> None:
        self.browser.close()
        self.playwright.stop()
        self.fleet.close()


@pytest.fixture
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    opened = Room(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("people")))
    yield opened
    opened.close()


def test_lead_pauses_takes_lends_and_all_pages_show_it(room: Room) -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)
    teacher, ours, theirs = (room.page(person) for person in room.consoles)
    expect(teacher.get_by_text("You are teacher, a lead.")).to_be_visible()
    expect(ours.get_by_text("You are group_a.")).to_be_visible()
    forward = "[data-motion=forward]"

    # A group that has other cars sees why it cannot drive this one, and may stop it.
    expect(theirs.locator("[data-control=drive] .refused")).to_have_text("group_b drives other cars, not red.")
    expect(theirs.locator("[data-mode], [data-do]")).to_have_count(0)
    assert theirs.locator(forward).get_attribute("aria-disabled") == "true"
    theirs.locator(forward).click(force=True)
    hold_until_driving(ours, room.judge)
    theirs.keyboard.press("Escape")
    wait_for(lambda: not room.judge.driving, "anybody stops")
    ours.mouse.up()

    # Only the lead pauses. A group that holds the button loses the car, and holding on does not bring it back.
    expect(ours.locator("[data-mode]").first).to_be_enabled()
    expect(ours.locator("#pause, [data-control=lend]")).to_have_count(0)
    hold_until_driving(ours, room.judge)
    teacher.locator("#pause").click()
    teacher.locator("input[name=why]").fill("look here")
    teacher.locator("[data-asking=pause] .danger").click()
    wait_for(lambda: not room.judge.driving, "the pause stops it")
    expect(ours.locator("[data-paused]")).to_contain_text("Paused by teacher: look here")
    expect(ours.locator("[data-paused] button")).to_be_disabled()
    assert ours.locator(forward).get_attribute("aria-disabled") == "true"
    for page in (teacher, ours):
        found = Axe().run(page)
        assert not [each for each in found.response["violations"] if each["impact"] in ("serious", "critical")]
    teacher.locator("[data-paused] button").click()
    expect(ours.locator("[data-paused]")).to_have_count(0)
    assert not room.judge.driving, "the end of a pause moves nothing, though the button is still held"
    ours.mouse.up()

    # The lead takes the car and gives it back.
    hold_until_driving(teacher, room.judge)
    expect(ours.locator("[data-control=drive] .refused")).to_contain_text("teacher drives red.")
    teacher.mouse.up()
    wait_for(lambda: not room.judge.driving, "red stands")
    expect(ours.locator("[data-control=drive] .refused")).to_have_count(0)
    hold_until_driving(ours, room.judge)
    ours.mouse.up()

    # The car is lent to the other group, and comes back.
    teacher.locator("[data-control=lend] select[name=to]").select_option("group_b")
    teacher.locator("[data-do=lend]").click()
    expect(ours.locator("[data-control=drive] .refused")).to_have_text("red is lent to group_b (by teacher).")
    expect(theirs.locator("[data-control=drive] .refused")).to_have_count(0)
    hold_until_driving(theirs, room.judge)
    teacher.goto(f"{room.consoles['teacher'].address}/#/")
    teacher.locator("[data-car=red]").click()
    teacher.get_by_role("button", name="End the loan red").click()
    wait_for(lambda: not room.judge.driving, "the end of the loan stops it")
    theirs.mouse.up()
    expect(ours.locator("[data-control=drive] .refused")).to_have_count(0)
    hold_until_driving(ours, room.judge)
    ours.mouse.up()


def test_group_sees_own_cars_first(room: Room) -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)
    _, (link,) = room.fleet.simulate("blue:arduino:tcp")
    people = ("teacher:lead", "group_b", "group_a:other")
    room.fleet.gateway(link, "--people-only", *(word for name in people for word in ("--person", name)), car="blue")
    room.fleet.ready("blue")
    ours, teacher = room.page("group_a"), room.page("teacher")
    chips = "(all) => all.map((each) => each.name.slice(7))"
    for page, own in ((ours, ["red"]), (teacher, ["blue", "red"])):
        page.goto(page.url.replace("drive", ""))
        expect(page.locator("[data-car]")).to_have_count(2)
        page.reload()  # the place of a car that came later is behind
        expect(page.locator("[data-car]")).to_have_count(2)
        cars = page.locator("[data-car]").evaluate_all("(all) => all.map((each) => each.dataset.car)")
        assert cars == (["red", "blue"] if page is ours else own)
        page.locator("nav a", has_text="Drive").click()
        own_chips = page.locator(".chooser > .rail .car-chips input")
        expect(own_chips).to_have_count(len(own))
        assert own_chips.evaluate_all(chips) == own
    expect(teacher.locator(".others")).to_have_count(0)
    blue = ours.locator(".others input[name=select-blue]")
    expect(blue).not_to_be_visible()
    ours.locator(".others summary").click()
    ours.locator("input[name=select-red]").uncheck()
    blue.check()
    expect(ours.locator("[data-control=drive] .refused")).to_have_text("group_a drives other cars, not blue.")
    expect(ours.locator("[data-mode], [data-do]")).to_have_count(0)
    ours.locator("nav a", has_text="Fleet").click()
    ours.locator("[data-set=mine]").click()
    expect(ours.locator("[data-car]")).to_have_count(1)
    expect(ours.locator("[data-car=red]")).to_be_visible()

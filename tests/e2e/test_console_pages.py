"""Plan, Plots, and how old it is what one sees, in a real browser; and the pure parts of these pages as tables."""

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from fleet.policy.plan.plan_parser import parse
from tests.e2e.test_console import serious
from tests.support.console import ConsoleStage
from tests.support.processes import PATIENCE_S, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

DAY_MS = 86_400_000
NOW_MS = 20_000 * DAY_MS + 12 * 3_600_000
"""Noon of Thursday, the 4th of October 2024, UTC."""


@pytest.fixture(scope="module", autouse=True)
def patient() -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)


def call(page: Page, module: str, name: str, *arguments: Any) -> Any:
    """Call a pure function of a module of the page."""
    return page.evaluate(
        "async ([module, name, given]) => (await import(`/static/${module}.js`))[name](...given)",
        [module, name, list(arguments)],
    )


def test_days_and_lengths_are_said_as_a_person_does(stage: ConsoleStage) -> None:
    page = stage.page()
    calendar = page.evaluate("async () => (await import('/static/texts.js')).t.calendar")
    days = {
        (0, 0): "today",
        (-DAY_MS // 2, 0): "today",
        (-DAY_MS // 2 - 1, 0): "yesterday",
        (-DAY_MS // 2 - 1, 3600): "today",  # the zone of the computer counts
        (-2 * DAY_MS, 0): "Wednesday",
        (-6 * DAY_MS, 0): "Saturday",
        (-7 * DAY_MS, 0): "27 September",
        (-300 * DAY_MS, 0): "9 December 2023",
        (DAY_MS, 0): "5 October",  # a clock that is wrong
    }
    found = {
        (back, zone): call(page, "when", "dayWords", NOW_MS + back, zone, NOW_MS, zone, calendar) for back, zone in days
    }
    assert found == days
    lengths = {0: "0 s", 59.4: "59 s", 59.6: "1 min", 2100: "35 min", 3600: "1 h", 3599: "1 h", 7500: "2 h 5 min"}
    assert {s: call(page, "when", "lengthWords", s) for s in lengths} == lengths


FIELDS = {"mode": "tracking", "count": 2, "needs": "battery_v > 7", "cars": ["red", "on"], "priority": -1}


@pytest.mark.parametrize(
    ("before", "rest"),
    [
        ("", ""),
        ("roles:\n  old: {mode: manual}\n", ""),
        ("# Name.\nroles:\n  old:\n    mode: manual\n# Rules.\nrules: []\n", "rules: []"),
        ("fixed: {blue: {mode: manual}}\n", "fixed:"),
        ("fixed: {blue: {mode: manual}}\nroles: {}\n", "fixed:"),
        ("fixed: {blue: {mode: manual}}\nroles:\n  old: {mode: manual}", "fixed:"),
    ],
)
def test_form_writes_the_roles_and_leaves_the_rest(stage: ConsoleStage, before: str, rest: str) -> None:
    page = stage.page()
    roles = [["guide", FIELDS], ["yes", {"mode": "manual", "count": "all", "needs": ""}]]
    text = call(page, "plan-text", "withRoles", before, roles)
    plan = parse(text)
    assert list(plan.roles)[:2] == ["guide", "yes"]
    guide = plan.roles["guide"]
    assert (guide.mode, guide.count, guide.cars, guide.priority) == ("tracking", 2, ("red", "on"), -1)
    assert guide.needs_text == str(parse("roles: {a: {mode: manual, needs: battery_v > 7}}").roles["a"].needs)
    assert (plan.roles["yes"].count, plan.roles["yes"].needs) == (None, None)
    assert rest in text
    for comment in re.findall("# .*", before):
        assert comment in text
    assert call(page, "plan-text", "withRoles", text, roles) == text, "written again it is the same"


def test_example_is_changed_in_the_form_and_tried(stage: ConsoleStage) -> None:
    page = stage.page("#/plan")
    page.locator("select[name=example]").select_option(index=1)
    area = page.locator("textarea")
    expect(area).to_have_value(re.compile("^# yaml-language-server.*\n# Two cars patrol"))
    page.locator("[data-plan=form]").click()
    first = page.locator("[data-form-role='0']")
    expect(first.locator("input[name=role]")).to_have_value("patrol")
    first.locator("select[name=count]").select_option("1")
    page.locator("[data-form=add]").click()
    page.locator("[data-form-role]").last.locator("input[name=role]").fill("lamp")
    page.locator("[data-form-role]").last.locator("select[name=mode]").select_option("color_led")
    plan = parse(area.input_value())
    assert (plan.roles["patrol"].count, plan.roles["lamp"].mode) == (1, "color_led")
    page.locator("[data-plan=check]").click()
    expect(page.locator("[data-try]")).to_have_count(3)
    expect(page.locator("[data-try][data-changed=true]").first).to_contain_text(
        re.compile("no role → (patrol|guide|lamp)")
    )
    assert serious(page) == []
    written = area.input_value()
    page.locator("nav a[href='#/']").click()
    page.locator("[data-car=red]").wait_for()
    page.locator("nav a[href='#/plan']").click()
    expect(area).to_have_value(written)
    expect(page.locator("[data-form-role]")).to_have_count(len(plan.roles))
    expect(page.locator("[data-try]")).to_have_count(3)
    page.reload()
    expect(area).to_have_value(written)
    page.locator("[data-plan=check]").click()
    expect(page.locator("[data-try]")).to_have_count(3)
    area.fill(f"{area.input_value()}#\n")
    expect(page.locator("[data-trial]")).to_have_count(0)
    assert page.locator("[data-plan=set]").is_disabled(), "another text was tried"


def pixels(page: Page, plot: str) -> int:
    """Return a sum of what is drawn."""
    script = """(canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data
      .reduce((sum, value, at) => (sum * 31 + value * (at % 7)) % 1000003, 0)"""
    return int(page.locator(f"{plot} canvas").evaluate(script))


def test_plot_has_title_pause_zoom_and_pointer(stage: ConsoleStage) -> None:
    page = stage.page("#/plots")
    plot = page.locator("[data-plot='0']")
    plot.locator("canvas").wait_for()
    expect(plot.locator(".plot-area")).to_have_attribute("aria-label", "Distance, m")
    expect(plot.locator("select option:checked")).to_have_text("Distance, m")
    plot.locator(".newest").filter(has_text=re.compile(r"red [\d.]+")).wait_for()
    page.locator("[data-view=pause]").click()
    paused = page.locator("[data-view=pause] ~ .hint")
    expect(paused).to_contain_text("Paused")
    page.wait_for_timeout(200)  # what was asked to be drawn before is drawn
    before = pixels(page, "[data-plot='0']")
    seen = page.locator(".newest").first.inner_text()
    wait_for(lambda: page.locator(".newest").first.inner_text() != seen, "new values come")
    assert pixels(page, "[data-plot='0']") == before, "it stands still"
    words = paused.inner_text()
    page.locator("[data-view=closer]").click()
    expect(paused).not_to_have_text(words)
    box = plot.locator(".u-over").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 50)
    value = plot.locator(".u-legend tr").nth(0)
    expect(value).to_contain_text(re.compile(r"\d\d:\d\d:\d\d\.\d"))
    words = paused.inner_text()
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.7, box["y"] + 60, steps=4)
    page.mouse.up()
    expect(paused).not_to_have_text(words)
    assert serious(page) == []
    page.locator("[data-view=pause]").click()
    wait_for(lambda: pixels(page, "[data-plot='0']") != before, "it goes on")


def test_lanes_of_modes_and_stops_reach_page_that_asks(stage: ConsoleStage) -> None:
    page = stage.page("#/plots")
    page.locator("[data-plot='0'] canvas").wait_for()
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    spans = "async () => (await import('/static/lanes.js')).liveSpans()"
    lanes: dict[str, list[str]] = {}

    def told() -> dict[str, list[str]]:
        lanes.clear()
        for each in page.evaluate(spans):
            lanes.setdefault(f"{each['car']} {each['lane']}", []).append(each["words"])
        return lanes

    def has_all() -> bool:
        return any("complete" in words for words in told().get("red stop", ())) and "red hold" in lanes

    wait_for(lambda: "red driver" in told(), "the drive is in its lane")
    page.keyboard.press("Escape")
    stage.stands()
    wait_for(has_all, "the lanes of the drive and its stop")
    assert lanes["red mode"] == ["manual"]
    assert lanes["red driver"] == ["mia"]
    assert not any("@" in words for words in (*lanes["red stop"], *lanes["red hold"]))


def test_page_shows_age_and_reason_of_refusal(stage: ConsoleStage) -> None:
    page = stage.page(wired=True)
    expect(page.locator("[data-connection]")).to_have_attribute("data-connection", "live")
    stage.wire.cut()
    expect(page.locator("[data-connection=old]")).to_contain_text(re.compile(r"[2-9] s old"))
    stage.wire.mend()
    expect(page.locator("[data-connection]")).to_have_attribute("data-connection", "live")
    fill = """() => Promise.all(Array.from({length: 100}, () => new Promise((resume) => {
      const socket = new WebSocket(`ws://${location.host}/ws`);
      (window.more ??= []).push(socket);
      socket.onopen = socket.onclose = resume;
    })))"""
    try:
        page.evaluate(fill)
        refused = stage.browser.new_context().new_page()
        refused.goto(f"{stage.console.address}/")
        expect(refused.locator("[data-refused]")).to_contain_text("too many pages are open")
        refused.context.close()
    finally:
        page.evaluate("() => { for (const each of window.more) each.close(); }")

"""The time line in a real browser: lanes, jumps, links; and that nothing but stops is commanded from the past."""

import json
import re
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.e2e.test_console import serious
from tests.e2e.test_console_pages import call
from tests.fleet.replay.make_session import START_NS, make
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for
from tests.support.sorted_writer import SortedWriter

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)

HOUR_S = 3600
MAX_JUMP_S = 0.3
"""Maximum time of a jump in a session of an hour, from the press to the tiles."""
JUMPS = 20
FLUSHED_MS = 2500
"""Time after which what was recorded is in the file: the recorder ends a chunk each second."""
OLD = "20260921T141320Z-fleet"
START_MS = START_NS // 1_000_000


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recordings") / "sessions"
    (made / OLD).mkdir(parents=True)
    make(made / OLD / "0001.mcap", HOUR_S, SortedWriter)
    return made


@pytest.fixture(scope="module")
def stages(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    expect.set_options(timeout=PATIENCE_S * 1000)
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--sessions", str(place))
    recorder = stage.fleet.start("-m", "fleet.cli", "record", "run", "--sessions", str(place), "--json")
    recorder.line()
    yield stage
    stage.close()


def link(page: str, at_ms: int, session: str = OLD) -> str:
    at = datetime.fromtimestamp(at_ms / 1000, UTC).replace(tzinfo=None).isoformat(timespec="milliseconds")
    return f"#/{page}?session={session}&at={at}Z"


def shown_at(page: Page, at_ms: int) -> Locator:
    """Wait until the page shows this moment."""
    bar = page.locator("[data-past-at]")
    expect(bar).to_have_attribute("data-past-at", str(at_ms))
    expect(bar).to_have_attribute("data-coming", "false")
    return bar


SPANS = [
    {"car": "red", "lane": "mode", "begin": 0, "end": 100, "words": "manual", "bad": False},
    {"car": "red", "lane": "mode", "begin": 100, "end": 200, "words": "tracking", "bad": False},
    {"car": "red", "lane": "stop", "begin": 150, "end": 160, "words": "stop by mia", "bad": True},
]


def test_where_spans_are_and_what_they_say(stage: ConsoleStage) -> None:
    page = stage.page()
    placed = call(page, "spans", "placed", SPANS, 50, 150)
    assert [(each["left"], each["width"]) for each in placed] == [(0, 0.5), (0.5, 0.5), (1, 0)]
    assert call(page, "spans", "eventTimes", SPANS, [[120, "here", ""]]) == [0, 100, 120, 150]
    for at, before, after in ((0, None, 100), (100, 0, 200), (130, 0, 200), (200, 100, None)):
        times = [0, 100, 200]
        assert (call(page, "spans", "previousTime", times, at), call(page, "spans", "nextTime", times, at)) == (
            before,
            after,
        )
    said = {
        at: [each["words"] for each in call(page, "spans", "saidAt", SPANS, "red", at)] for at in (50, 100, 155, 201)
    }
    assert said == {50: ["manual"], 100: ["tracking"], 155: ["tracking", "stop by mia"], 201: []}
    assert [each[3] for each in call(page, "spans", "around", SPANS, [[120, "here", "mia"]], 130, 30)] == [
        "tracking",
        "here (mia)",
        "stop by mia",
    ]


def test_link_shows_a_moment_on_every_page(stage: ConsoleStage) -> None:
    at_ms = START_MS + 4500  # the cars drive, and red is in mode manual
    page = stage.page(link("", at_ms))
    shown_at(page, at_ms)
    red = page.locator("[data-car=red]")
    expect(red).to_contain_text("forward")
    expect(red).to_contain_text("Manual")
    page.locator("nav a", has_text="Plots").click()
    page.locator("[data-plot='0'] canvas").wait_for()
    assert "at=" in page.evaluate("location.hash"), "the link is that of this page, too"
    expect(page.locator(".newest").first).to_contain_text(re.compile(r"red [\d.]+"))
    page.locator("nav a", has_text="Inspect").click()
    page.get_by_role("heading", name="Inspect").wait_for()
    page.locator("main select").select_option("red")
    expect(page.locator("tbody tr").filter(has_text="led by ann").first).to_be_visible()
    expect(page.locator("tbody tr").filter(has_text="$1,0,0,0").first).to_be_visible()
    for tab in page.locator("nav a").all():
        tab.click()
        tab.and_(page.locator("[aria-current=page]")).wait_for()
        expect(page.locator("[data-past-at]")).to_have_count(1)
        assert page.evaluate("document.documentElement.matches('[data-past]')")
        assert page.title().startswith("Past: ")
    again = stage.page(page.evaluate("location.hash"))
    shown_at(again, at_ms)
    page.locator("[data-live-now]").click()
    expect(page.locator("[data-past-at]")).to_have_count(0)
    assert "?" not in page.evaluate("location.hash")


def test_nothing_but_stops_is_commanded_from_the_past(stage: ConsoleStage, place: Path) -> None:
    page = stage.driving_page("red")
    running = next(each.name for each in place.iterdir() if each.name != OLD)
    at_ms = time.time_ns() // 1_000_000
    sent: list[dict[str, Any]] = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda text: sent.append(json.loads(str(text)))))
    page.reload()
    page.locator("input[name=select-red]").check()
    page.wait_for_timeout(FLUSHED_MS)
    with stage.held(page, "forward"):
        page.evaluate("(hash) => { location.hash = hash; }", link("drive", at_ms, running))
        stage.stands()
        shown_at(page, at_ms)
        before = len(sent)
        for key in ("w", "ArrowUp"):
            page.keyboard.down(key)
            page.keyboard.up(key)
    page.locator("[data-motion=forward]").hover()
    page.mouse.down()
    page.mouse.up()
    assert page.locator("[data-motion=forward]").get_attribute("aria-disabled") == "true"
    expect(page.get_by_text("You look at the past.").first).to_be_visible()
    enabled = page.locator("main :is(button, input):enabled:not([name^=select-], .pad)")
    assert [each.inner_text() for each in enabled.all()] == [], "no control of a car"
    page.evaluate("async () => (await import('/static/console.js')).command('whistle', ['red'])")
    page.evaluate("async () => (await import('/static/console.js')).press('forward', ['red'], 'x')")
    page.evaluate("async () => (await import('/static/console.js')).lease('take', ['red'])")
    assert {each["t"] for each in sent[before:]} <= {"ping", "lanes", "lanes_end"}
    stage.person.car("blue").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["blue"].driving, "blue drives")
    page.keyboard.press("Escape")
    stage.stands("blue")
    expect(page.locator("[data-past-at]")).to_have_count(1)
    page.locator("nav a", has_text="Fleet").click()
    stage.details(page, "red").locator(".stop-one").click()
    wait_for(lambda: any(each["t"] == "do" and each["verb"] == "stop" for each in sent), "a stop of one car is sent")
    page.locator("[data-live-now]").click()
    page.locator("nav a", has_text="Drive").click()
    with stage.held(page, "forward"):
        pass
    stage.stands()


def test_live_time_line_leads_back_and_to_running_session(stage: ConsoleStage) -> None:
    page = stage.page("#/time")
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    drove_ms = time.time_ns() // 1_000_000
    red = page.locator("[data-lanes=red]")
    expect(red.locator(".lane-driver span").last).to_have_text("mia drives")
    page.keyboard.press("Escape")
    stage.stands()
    expect(red.locator(".lane-stop span").last).to_contain_text("complete")
    expect(red.locator(".lane-hold span").last).to_contain_text("hold by")
    assert serious(page) == []
    wait_for(lambda: page.locator("[data-go=back10]").is_enabled(), "the running session is known")
    page.wait_for_timeout(FLUSHED_MS)
    page.locator("[data-all-near]").click()
    page.locator(".event", has_text="mia drives").last.click()
    bar = page.locator("[data-past-at]")
    at_ms = int(bar.get_attribute("data-past-at") or 0)
    assert abs(at_ms - drove_ms) < 2500
    shown_at(page, at_ms)
    page.locator("[data-go=on1]").click()
    shown_at(page, at_ms + 1000)
    page.locator("nav a", has_text="Fleet").click()
    expect(page.locator("[data-car=red]")).to_contain_text("mia drives")
    expect(page.locator("[data-car=red]")).not_to_contain_text("standing")
    page.locator("nav a", has_text="Time line").click()
    expect(page.locator("[data-lanes=red] .lane-mode span").first).to_be_attached()
    page.locator("[data-live-now]").click()


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_session_is_opened_scrubbed_by_hand_and_by_keys(stage: ConsoleStage, size: str) -> None:
    page = stage.phone("#/sessions") if size == "phone" else stage.page("#/sessions")
    page.locator(f"[data-session='{OLD}'] .main").click()
    expect(page.locator("[data-past-at]")).to_have_count(1)
    lanes = page.locator("[data-lanes=red] .lane-mode")
    expect(lanes.locator("span")).to_have_count(3)
    first = int(page.locator("[data-past-at]").get_attribute("data-past-at") or 0)
    assert abs(first - START_MS) < 100
    scrub = page.locator("input[name=scrub]")
    scrub.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    shown_at(page, first + 200)
    box = page.locator(".time-lanes").bounding_box()
    assert box is not None
    page.locator(".time-lanes").click(position={"x": box["width"] / 2, "y": 30})
    middle = page.locator("[data-past-at]").get_attribute("data-past-at")
    assert middle is not None
    assert abs(int(middle) - START_MS - HOUR_S * 500) < 30_000
    shown_at(page, int(middle))
    page.locator("[data-go=next]").click()
    expect(page.locator("[data-past-at]")).not_to_have_attribute("data-past-at", middle)
    assert serious(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    page.locator("select[name=session]").select_option("")
    expect(page.locator("[data-past-at]")).to_have_count(0)


def test_time_of_day_is_what_the_clock_of_the_console_says(stage: ConsoleStage) -> None:
    page = stage.page()
    noon_ms, zone_s = 1_790_000_000_000 // 86_400_000 * 86_400_000 + 43_200_000, 3600  # 13:00 on that clock
    for text, reference_ms, s in (
        ("12:05", noon_ms, -3300),
        ("1205", noon_ms, -3300),
        ("12:05:30", noon_ms, -3270),
        ("14:05", noon_ms, 3900 - 86_400),  # not come yet: that of yesterday
        ("14:05", noon_ms - 172_800_000, 3900 - 172_800),  # of the day that is looked at
    ):
        assert call(page, "when", "momentOf", text, reference_ms, zone_s, noon_ms) == noon_ms + 1000 * s, text
    for text in ("", "noon", "25:00", "12:60", "12:05:61", "12:5"):
        assert call(page, "when", "momentOf", text, noon_ms, zone_s, noon_ms) is None, text


def test_which_recording_covers_a_moment(stage: ConsoleStage) -> None:
    page = stage.page()
    listed = [
        {"name": "old", "at_ms": 1000, "length_s": 2},
        {"name": "odd", "at_ms": None, "length_s": 9},
        {"name": "now", "at_ms": 9000, "length_s": 1},
    ]
    for at, name, nearest in (
        (2000, "old", 2000),
        (5000, "old", 3000),
        (8000, "now", 9000),
        (20_000, "now", 20_000),
        (31_000, "now", 30_000),
    ):
        found = call(page, "spans", "recordingAt", listed, "now", 30_000, at)
        assert (found["name"], found["at"]) == (name, nearest), at
    assert call(page, "spans", "recordingAt", [], "", 30_000, 5) is None


def test_earlier_time_of_day_is_typed_and_what_nothing_covers_says_so(stage: ConsoleStage) -> None:
    page = stage.page("#/time")
    expect(page.locator("[data-since]")).to_contain_text("when the console started")
    wait_for(lambda: page.locator("[data-go=back10]").is_enabled(), "the running session is known")
    page.wait_for_timeout(FLUSHED_MS)
    now_ms = time.time_ns() // 1_000_000
    page.locator("input[name=clock]").fill(time.strftime("%H:%M:%S", time.localtime(now_ms / 1000 - 2)))
    page.locator("[data-go=clock]").click()
    at_ms = int(page.locator("[data-past-at]").get_attribute("data-past-at") or 0)
    assert at_ms == (now_ms // 1000 - 2) * 1000
    page.locator("[data-live-now]").click()
    before = time.localtime(now_ms / 1000 - 7200)
    page.locator("input[name=clock]").fill(time.strftime("%H:%M", before))
    page.keyboard.press("Enter")
    missing = page.locator("[data-missing]")
    expect(missing).to_contain_text(f"No recording covers {time.strftime('%H:%M', before)}:00.")
    expect(page.locator("[data-past-at]")).to_have_count(0)
    missing.get_by_role("button").click()
    expect(page.locator("[data-past-at]")).to_have_count(1)
    expect(missing).to_have_count(0)
    page.locator("[data-live-now]").click()
    page.locator("input[name=clock]").fill("soon")
    page.locator("[data-go=clock]").click()
    assert page.locator("input[name=clock]:invalid").count() == 1


def test_round_times_stand_above_the_lanes(stage: ConsoleStage) -> None:
    page = stage.page()
    minute = 60_000
    assert call(page, "spans", "ticks", 30_000, 4 * minute, 0) == [minute, 2 * minute, 3 * minute, 4 * minute]
    assert call(page, "spans", "ticks", 0, 50 * minute, 19_800) == [each * minute for each in range(0, 51, 10)]
    assert call(page, "spans", "ticks", 100, 200, 0) == []


PRESSES = [
    {"car": "red", "lane": "driver", "begin": begin, "end": begin + 900, "words": "mia", "bad": False}
    for begin in (1000, 3000, 5000)
]


def test_time_line_joins_repeated_presses_into_one_drive(stage: ConsoleStage) -> None:
    page = stage.page()
    assert [each[0] for each in call(page, "spans", "around", PRESSES, [], 4000, 30_000)] == [1000]
    late = [*PRESSES, PRESSES[0] | {"begin": 25_000, "end": 26_000}]
    assert [each[0] for each in call(page, "spans", "around", late, [], 4000, 30_000)] == [1000, 25_000]
    assert call(page, "spans", "nearest", [[1], [5], [9], [20]], 8, 2) == [[5], [9]]
    assert call(page, "spans", "usedLanes", SPANS, "red") == ["mode", "stop"]


@pytest.mark.parametrize("view", ["", "map"])
def test_jump_in_a_session_of_an_hour_is_fast(view: str, stage: ConsoleStage) -> None:
    page = stage.page(link(view, START_MS + 1000))
    shown_at(page, START_MS + 1000)
    if view == "map":
        expect(page.locator("[data-mark]")).to_have_count(3)
    took: list[float] = []
    for number in range(JUMPS):
        at_ms = START_MS + (number * 7919 % HOUR_S) * 1000 + 500
        ms = page.evaluate(
            """async ([session, at]) => {
              const { jump } = await import("/static/past.js");
              const { store } = await import("/static/console.js");
              const began = performance.now();
              jump(session, at);
              while (store.past.shown?.at_ms !== at) await new Promise(requestAnimationFrame);
              await new Promise(requestAnimationFrame);
              return performance.now() - began;
            }""",
            [OLD, at_ms],
        )
        took.append(ms / 1000)
    took.sort()
    print(f"\njump with {view or 'fleet'}: p50 {took[len(took) // 2] * 1000:.0f} ms, longest {took[-1] * 1000:.0f} ms")
    assert took[-1] < MAX_JUMP_S


def test_recording_that_is_not_there_says_so(stage: ConsoleStage) -> None:
    page = stage.page("#/time?session=nothing&at=2026-01-01T00:00:00Z")
    expect(page.locator("[data-past-at]")).to_contain_text("There is no session 'nothing'.")
    page.locator("[data-live-now]").click()
    expect(page.locator("[data-past-at]")).to_have_count(0)

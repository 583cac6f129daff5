"""The console's page says and does what is so, in a real browser. The simulated cars' true motors are the judge."""

import contextlib
import re
import signal
import time

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from playwright.sync_api import Dialog, Page, expect

from gateway.drivers.yahboom.protocol.frames import General, encode
from schemas.topics import TOPICS
from schemas.words import Motion
from tests.support.console import CARS, ConsoleStage
from tests.support.processes import PATIENCE_S, freeze, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)


@pytest.fixture(scope="module", autouse=True)
def patient() -> None:
    expect.set_options(timeout=PATIENCE_S * 1000)


def hold_key(stage: ConsoleStage, page: Page, key: str, car: str = "red") -> None:
    """Hold a key until the car drives. If the dead-man timer ends a press on a busy machine, press again."""
    for _ in range(10):
        page.keyboard.down(key)
        try:
            wait_for(lambda: stage.judges[car].driving, "it drives", 2.0)
        except AssertionError:
            page.keyboard.up(key)
            page.wait_for_timeout(700)  # after a stop, the gateway rejects a stream that does not pause
        else:
            return
    raise AssertionError(page.locator(".results").inner_text())


def wait_motion(stage: ConsoleStage, motion: Motion, since_ns: int, car: str = "red") -> None:
    """Wait until the newest motion that reached the car is this one."""
    motions = {encode(General(each)): each for each in Motion}

    def newest() -> bool:
        found = [motions[data] for _, data in stage.judges[car].written_after(since_ns) if data in motions]
        return bool(found) and found[-1] is motion

    wait_for(newest, f"{car} gets {motion}")


def test_stop_report_changes_when_car_moves_again(stage: ConsoleStage) -> None:
    page = stage.page(timezone_id="Pacific/Auckland", viewport={"width": 1280, "height": 900})
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    began_ns = time.time_ns()
    report = stage.report(page, lambda: page.keyboard.press("Escape"))
    red = report.locator("[data-stop=red].stop-shown")
    stage.stands(since_ns=began_ns)
    expect(red).to_contain_text(re.compile(r"stood at \d\d:\d\d:\d\d, shown"))
    said = red.inner_text()
    shown = [time.strftime("%H:%M:%S", time.localtime(began_ns // 10**9 + after)) for after in range(60)]
    assert any(f"stood at {each}," in said for each in shown), said
    stage.person.resume(["red"])
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives again")
    expect(report.locator("[data-stop=red].stop-moved")).to_contain_text(
        re.compile(r"moves again since \d\d:\d\d:\d\d")
    )
    assert stage.judges["red"].driving
    # The other cars keep their rows. That of red is closed with the drive, which no STOP ended.
    blue = report.locator("[data-stop=blue]").inner_text()
    assert re.search(r"at \d\d:\d\d:\d\d", blue), blue
    stage.person.car("red").drive("stop", 1.0).check()
    stage.stands()
    expect(report.locator("[data-stop=red]")).to_have_count(0)
    assert report.locator("[data-stop=blue]").inner_text() == blue
    expect(report.get_by_role("status")).to_contain_text("1 moved since")


def test_pause_is_named_a_pause(stage: ConsoleStage) -> None:
    page = stage.page()
    try:
        page.locator("#pause").click()
        report = stage.report(page, page.locator("[data-asking=pause] .danger").click)
        expect(report.locator("strong").first).to_have_text("Paused")
        for car in CARS:
            stage.stands(car)
    finally:
        page.locator("[data-paused] button").click()
    expect(page.locator("[data-paused]")).to_have_count(0)


@pytest.mark.parametrize("frozen_s", [0.3, 0.7, 1.2, 1.7])
def test_no_press_outlives_short_hub_hang(stage: ConsoleStage, frozen_s: float) -> None:
    """Shorter than the lease of the bus, which tells nobody. The drives of the gateway last for half a second."""
    page = stage.driving_page("red")
    hold_key(stage, page, "w")
    hub, began = stage.fleet.hub, time.monotonic()
    frozen_ns = time.time_ns()
    freeze(hub.pid)
    try:
        wait_for(lambda: time.monotonic() - began >= frozen_s, "the hub stands still")
    finally:
        hub.popen.send_signal(signal.SIGCONT)
    page.wait_for_timeout(1500)  # longer than any stream needs to begin again
    assert stage.judges["red"].on_after(frozen_ns) == []
    if stage.judges["red"].driving:  # shorter than a drive: the motors were never off
        expect(page.locator(".pad.held")).to_have_count(1)
    else:
        expect(page.locator(".pad.held")).to_have_count(0)
    page.keyboard.up("w")
    hold_key(stage, page, "w")
    page.keyboard.up("w")
    stage.stands()


@pytest.mark.parametrize("how", ["freezes", "dies"])
def test_no_press_outlives_the_hub(stage: ConsoleStage, how: str) -> None:
    page = stage.driving_page("red")
    hold_key(stage, page, "w")
    hub = stage.fleet.hub
    if how == "dies":
        hub.kill()
        hub.wait()
    else:
        freeze(hub.pid)
    lost_ns = time.time_ns()
    try:
        expect(page.get_by_text("The console has lost the bus.", exact=False).first).to_be_visible()
    finally:  # a gateway starts another hub where one has died
        if how == "freezes":
            hub.popen.send_signal(signal.SIGCONT)
    for car in CARS:
        stage.fleet.ready(car)
    # A hub that was frozen knows some gateways twice for a while.
    wait_for(lambda: [type(each) for each in stage.fleet.get("fleet/*/state/link")].count(str) == 0, "all answer")
    expect(page.locator(".banner")).to_have_count(0)
    stage.stands(since_ns=lost_ns)
    page.wait_for_timeout(2000)  # longer than any stream needs to begin again
    assert stage.judges["red"].on_after(lost_ns) == []
    expect(page.locator(".pad.held")).to_have_count(0)
    page.keyboard.up("w")
    hold_key(stage, page, "w")
    page.keyboard.up("w")
    stage.stands()


def test_longest_held_key_wins_and_forward_with_turn_is_arc(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    hold_key(stage, page, "w")
    began_ns = time.time_ns()
    for key, pressed in (("d", Motion.RIGHT), ("a", Motion.LEFT), ("s", Motion.BACK)):
        at_ns = time.time_ns()
        page.keyboard.down(key)
        wait_motion(stage, pressed, at_ns)
        at_ns = time.time_ns()
        page.keyboard.up(key)
        wait_motion(stage, Motion.FORWARD, at_ns)
    page.keyboard.down("s")
    page.keyboard.down("d")
    wait_motion(stage, Motion.SPIN_RIGHT, began_ns)
    page.keyboard.up("d")
    wait_motion(stage, Motion.BACK, time.time_ns())
    assert stage.judges["red"].on_after(began_ns) == [], "the motors were never off between two directions"
    page.keyboard.up("s")
    page.keyboard.up("w")
    stage.stands()


def test_two_fingers_drive_arc_and_remaining_one_drives_on(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", **stage.playwright.devices["Pixel 7"])
    fingers = page.context.new_cdp_session(page)

    def place(motion: str) -> dict[str, float]:
        box = page.locator(f"[data-motion={motion}]").bounding_box()
        assert box is not None
        return {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}

    first, second = place("forward") | {"id": 0}, place("spin_left") | {"id": 1}

    def touch(kind: str, *points: dict[str, float]) -> int:
        now_ns = time.time_ns()
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})
        return now_ns

    for _ in range(10):
        touch("touchStart", first)
        with contextlib.suppress(AssertionError):
            wait_for(lambda: stage.judges["red"].driving, "it drives", 2.0)
            break
        touch("touchEnd", first)
        page.wait_for_timeout(700)
    began_ns = time.time_ns()
    wait_motion(stage, Motion.LEFT, touch("touchStart", first, second))
    wait_motion(stage, Motion.FORWARD, touch("touchEnd", second))
    assert stage.judges["red"].on_after(began_ns) == []
    touch("touchEnd", first)
    stage.stands()


def test_stopped_stick_drives_again_only_from_center(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    page.evaluate("window.stick = [0, 0]; navigator.getGamepads = () => [null, { axes: window.stick }]")

    def drives(stick: str) -> bool:
        page.evaluate(f"window.stick = {stick}")
        with contextlib.suppress(AssertionError):
            wait_for(lambda: stage.judges["red"].driving, "it drives", 3.0)
        if not stage.judges["red"].driving:
            page.evaluate("window.stick = [0, 0]")
            page.wait_for_timeout(700)
        return stage.judges["red"].driving

    wait_for(lambda: drives("[0, -0.9]"), "it drives")
    stopped_ns = time.time_ns()
    page.keyboard.press("Escape")
    stage.stands(since_ns=stopped_ns)
    page.evaluate("window.stick = [0.9, 0]")  # past the middle, in no moment in it
    page.wait_for_timeout(1500)
    assert stage.judges["red"].on_after(stopped_ns) == []
    page.evaluate("window.stick = [0, 0]")
    page.wait_for_timeout(700)
    wait_for(lambda: drives("[0.9, 0]"), "it drives again")
    page.evaluate("window.stick = [0, 0]")
    stage.stands()


def test_frozen_tab_with_held_keys_starts_nothing(stage: ConsoleStage) -> None:
    page = stage.driving_page("red")
    page.keyboard.down("d")
    hold_key(stage, page, "w")
    frozen, frozen_ns = stage.renderers(), time.time_ns()
    for each in frozen:
        each.suspend()
    try:
        stage.stands(since_ns=frozen_ns)
    finally:
        for each in frozen:
            each.resume()
    page.locator(".pad.held").wait_for(state="detached")
    thawed_ns = time.time_ns()
    page.keyboard.up("d")  # the other one of two keys, too, must be pressed again
    page.keyboard.down("w")  # a repetition, as of a key that stays down
    page.wait_for_timeout(1000)
    assert stage.judges["red"].on_after(thawed_ns) == []
    page.keyboard.up("w")
    hold_key(stage, page, "w")
    page.keyboard.up("w")
    stage.stands()


def test_wifi_that_breaks_while_two_keys_are_held_ends_both(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", wired=True)
    hold_key(stage, page, "w")
    page.keyboard.down("a")
    cut_ns = stage.wire.cut()
    try:
        stage.stands(since_ns=cut_ns)
        expect(page.locator(".banner")).to_contain_text("The console does not answer")
    finally:
        stage.wire.mend()
    expect(page.locator(".banner")).to_have_count(0)
    mended_ns = time.time_ns()
    page.keyboard.up("a")
    page.wait_for_timeout(1000)
    assert stage.judges["red"].on_after(mended_ns) == []
    page.keyboard.up("w")


def test_mode_and_take_over_pressed_in_dead_wifi_do_nothing_when_it_is_back(stage: ConsoleStage) -> None:
    page = stage.driving_page("blue", wired=True)
    stage.wire.cut()
    try:
        expect(page.locator(".banner")).to_contain_text("The console does not answer")
        page.locator("[data-mode=tracking]").click()
        page.get_by_label("Take over blue").click()
        page.wait_for_timeout(2500)  # not a wait: the test is about this time
    finally:
        stage.wire.mend()
    expect(page.locator(".results")).to_contain_text("Press again")
    page.locator("[data-do=whistle]").click()  # it comes after both
    expect(page.locator(".results")).to_contain_text("whistle", ignore_case=True)
    assert stage.fleet.state("mode", "blue").asked == "manual"
    assert not stage.fleet.state("safety", "blue").HasField("lease")
    page.locator("[data-mode=color_led]").click()  # no car leaves its place
    wait_for(lambda: stage.fleet.state("mode", "blue").asked == "color_led", "pressed again, it changes its mode")


def test_sleeping_phone_stops_car_and_wakes_without_driving(stage: ConsoleStage) -> None:
    page = stage.driving_page("red", wired=True)
    hide = "Object.defineProperty(document, 'visibilityState', { value: 'hidden', configurable: true })"
    hold_key(stage, page, "w")
    asleep_ns = time.time_ns()
    page.evaluate(f"{hide}; document.dispatchEvent(new Event('visibilitychange'))")
    stage.wire.cut()  # the radio sleeps, too
    try:
        stage.stands(since_ns=asleep_ns)
    finally:
        stage.wire.mend()
    page.evaluate("delete document.visibilityState; document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator(".banner")).to_have_count(0)
    page.keyboard.down("w")  # a repetition
    page.wait_for_timeout(1000)
    assert stage.judges["red"].on_after(asleep_ns) == []
    page.keyboard.up("w")


def test_cards_without_news_say_their_age_and_claim_nothing(stage: ConsoleStage) -> None:
    page = stage.page(wired=True)
    red, blue = (page.locator(f"[data-car={car}]") for car in ("red", "blue"))
    details = stage.details(page)
    expect(details.get_by_text("online")).to_be_visible()
    expect(page.locator("[data-old]")).to_have_count(0)
    freeze(stage.gateways["red"].pid)
    try:
        expect(red.locator("[data-old]")).to_contain_text(re.compile(r"(Nothing new|LOST) for \d+ s"))
        expect(details.get_by_text(re.compile(r"Nothing new for \d+ s: what this card shows"))).to_be_visible()
        expect(details.get_by_text("online")).to_have_count(0)
        expect(blue.locator("[data-old]")).to_have_count(0)
    finally:
        stage.gateways["red"].popen.send_signal(signal.SIGCONT)
    expect(page.locator("[data-old]")).to_have_count(0)
    stage.wire.cut()
    try:
        expect(page.locator("[data-old]")).to_have_count(len(CARS))
        first = page.locator("[data-old]").first.inner_text()
        expect(page.locator("[data-old]").first).not_to_have_text(first)
    finally:
        stage.wire.mend()
    expect(page.locator("[data-old]")).to_have_count(0)
    stage.fleet.ready("red")


WRONG_CLOCK = """
const Real = Date;
window.Date = class extends Real {
  constructor(...words) { words.length === 0 ? super(Real.now() + 5.4e9) : super(...words); }
  static now() { return Real.now() + 5.4e9; }
};
"""


def test_times_are_of_console_not_browser_clock(stage: ConsoleStage) -> None:
    page = stage.page(timezone_id="Asia/Kathmandu", viewport={"width": 1280, "height": 900})
    page.add_init_script(WRONG_CLOCK)
    page.reload()
    assert page.evaluate("Date.now()") > time.time() * 1000 + 5e9
    now_s = int(time.time())
    stage.person.car("red").whistle().check()
    allowed = [time.strftime("%H:%M:%S", time.localtime(now_s + after)) for after in range(60)]
    said = stage.details(page).locator("time")
    wait_for(lambda: said.inner_text() in allowed, f"{allowed[0]} or soon after")
    page.goto(f"{stage.console.address}/#/inspect")
    page.locator("select").select_option("red")
    wait_for(lambda: page.locator("tbody td").first.inner_text()[:8] in allowed, "a frame of now")
    page.goto(f"{stage.console.address}/#/plots")
    expect(page.locator("[data-plot='0'] .newest")).to_contain_text(re.compile(r"red [\d.]+"))


def test_browser_with_a_wrong_clock_drives_and_stops(stage: ConsoleStage) -> None:
    page = stage.page("#/drive")
    page.add_init_script(WRONG_CLOCK)
    page.reload()
    page.locator("input[name=select-red]").check()
    assert page.evaluate("Date.now()") > time.time() * 1000 + 5e9
    hold_key(stage, page, "w")
    began_ns = time.time_ns()
    wait_for(lambda: time.time_ns() > began_ns + 1_000_000_000, "longer than a drive lasts")
    assert stage.judges["red"].driving
    page.keyboard.up("w")
    stage.stands()
    hold_key(stage, page, "w")
    stopped_ns = time.time_ns()
    page.keyboard.press("Escape")
    stage.stands(since_ns=stopped_ns)
    page.keyboard.up("w")


SEEN_ON = {"map": "[data-place=red]", "board": "[data-board=red]", "time": "[data-lanes=red]"}
"""Where the pages that are looked at say what a car does."""


@pytest.mark.parametrize("how", ["wifi", "frozen"])
@pytest.mark.parametrize("view", SEEN_ON)
def test_page_that_was_cut_off_or_frozen_says_so_and_is_live_again(how: str, view: str, stage: ConsoleStage) -> None:
    page = stage.page(f"#/{view}", wired=True)
    page.add_init_script(WRONG_CLOCK)
    page.reload()
    red, connection = page.locator(SEEN_ON[view]), page.locator("[data-connection]")
    expect(red).to_be_visible()
    frozen = stage.renderers() if how == "frozen" else []
    for each in frozen:
        each.suspend()
    if how == "wifi":
        stage.wire.cut()
    try:
        if how == "wifi":
            expect(page.locator(".banner")).to_contain_text("The console does not answer")
            expect(connection).to_have_attribute("data-connection", "old")
            expect(red).to_contain_text("nothing known" if view == "time" else re.compile(r"Nothing new for \d+ s"))
        else:
            time.sleep(3.0)  # longer than a page is silent before it says so
    finally:
        for each in frozen:
            each.resume()
        stage.wire.mend()
    expect(connection).to_have_attribute("data-connection", "live")
    stage.person.car("red").drive("spin_left", 10.0, wait=False).check()
    expect(red).to_contain_text("mia drives")
    if view == "time":
        shown = page.locator("[data-moment]").inner_text()
        times = [time.strftime("%H:%M:%S", time.localtime(time.time() - late_s)) for late_s in range(4)]
        assert shown.partition(".")[0] in times, "by the clock of the console"
    page.keyboard.press("Escape")
    stage.stands()


def test_car_that_does_not_stop_is_said_to_be_so_on_each_page(stage: ConsoleStage) -> None:
    page = stage.page()
    stage.person.car("red").mode("obstacle_avoidance").check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    stage.sim.say({"car": "red", "fault": "deaf", "for_s": 120})
    try:
        page.keyboard.press("Escape")
        expect(page.locator("[data-car=red]")).to_contain_text("STOP NOT CONFIRMED")
        expect(page.locator("[data-stop=red].stop-failed")).to_be_visible()
        assert stage.judges["red"].driving
        expect(page.locator("[data-trouble=red]")).to_contain_text("STOP NOT CONFIRMED")
        for path in ("board", "map"):
            page.goto(f"{stage.console.address}/#/{path}")
            expect(page.locator(SEEN_ON[path])).to_contain_text("STOP NOT CONFIRMED")
            assert "free" not in page.locator(SEEN_ON[path]).inner_text()
    finally:
        stage.sim.say({"car": "red", "fault": "deaf", "for_s": 0})
    expect(page.locator(SEEN_ON["map"])).not_to_contain_text("NOT CONFIRMED")
    stage.stands()
    page.goto(f"{stage.console.address}/#/board")
    expect(page.locator(SEEN_ON["board"])).to_contain_text("stopped by")


MARKUP = "<img src=x onerror=alert(1)><b>bold</b>"
TURNED = "\u202eevil\u200b\u2066\u0007"
HEBREW = "\u05d0\u05d1\u05d2 1"


def test_texts_of_others_are_text_and_turn_nothing_around(stage: ConsoleStage) -> None:
    page = stage.page()
    said: list[str] = []

    def on_dialog(dialog: Dialog) -> None:
        said.append(dialog.message)
        dialog.dismiss()

    page.on("dialog", on_dialog)
    card = stage.details(page)
    words = f"{MARKUP}{TURNED}{HEBREW}"
    shown = f"\u2068{MARKUP} evil {HEBREW}\u2069"  # the gateway writes blanks
    publisher = stage.fleet.bus.publisher("fleet/red/event/log", TOPICS["event/log"], "red")
    try:
        publisher.put(
            Log(message=words, name="red other", level=Log.WARNING), time.time_ns()
        )  # of a stranger, not cleaned
        expect(card.locator(".row", has_text="Last event")).to_contain_text(f"\u2068{MARKUP}evil{HEBREW}\u2069")
        stage.person.car("red").estop(words).check()
        expect(card.locator(".alarm p", has_text="E-stop of this car by mia")).to_contain_text(shown)
        assert card.locator("img, b").count() == 0
        stage.person.pause(words)
        expect(page.locator("[data-paused]")).to_contain_text(f"Paused by mia: {shown}. Nobody")
        for link in page.locator("nav a").all():
            link.click()
            link.and_(page.locator("[aria-current=page]")).wait_for()
            text = page.locator("body").inner_text()
            assert not re.search("[\u202a-\u202e\u2066\u2067\u200b-\u200f\u0007]", text), link.inner_text()
            assert page.locator("main img[src=x], main b").count() == 0
    finally:
        stage.person.unpause()
    assert said == []

"""A sleep of the computer: the car is stopped first, and nothing from before the sleep goes on. Virtual time."""

import pytest

from gateway.control.commands import Drive, EmergencyStop, Fan, Led, Lend, Pause, SetMode, Stop
from gateway.control.refusals import AFTER_SLEEP_S
from schemas.limits import STREAM_SILENCE_S
from schemas.words import Basis, Mode, Motion, Phase, Reason
from tests.gateway.control.workbench import MODE00, PERSON, RUN, SCRIPT, STOP, Workbench

FORWARD = Drive(Motion.FORWARD, 5.0)
NIGHT_S = 8 * 3600.0


@pytest.fixture
def desk() -> Workbench:
    return Workbench().ready()


def sleep(desk: Workbench, slept_s: float = NIGHT_S, *, counted: bool = False) -> None:
    """Let the computer sleep. `counted`: the clock of the gateway goes on meanwhile, as on Windows."""
    if counted:
        desk.now += slept_s
        desk.car.report_at += slept_s
    desk.sent.clear()
    desk.control.on_sleep(slept_s, desk.now, counted=counted)
    desk.pump()


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi", "stm32"])
def test_sleep_ends_drive_and_stops_car_first(platform: str, *, counted: bool) -> None:
    desk = Workbench(platform).ready()
    desk.ask(FORWARD, PERSON, identity="drive")
    desk.run(1.0)
    sleep(desk, counted=counted)
    assert desk.end("drive") == (Phase.EXPIRED, Reason.EXPIRED)
    assert desk.frames[0] in (STOP, MODE00), "the stop goes out at once"
    assert [entry.code for entry in desk.logs] == ["slept"]
    assert desk.control.safety.lease is None
    desk.run(8.0)
    assert RUN not in desk.frames
    assert desk.control.driver.model.motors == "off"


@pytest.mark.parametrize("counted", [False, True])
def test_queued_commands_expire_after_sleep(desk: Workbench, *, counted: bool) -> None:
    desk.ask(Led(1, 2, 3), identity="led", pump=False)
    desk.ask(Fan(), identity="fan", pump=False)
    desk.ask(FORWARD, identity="drive", pump=False)
    desk.ask(SetMode(Mode.TRACKING), identity="mode", pump=False)
    sleep(desk, counted=counted)
    desk.run(20.0)
    assert not [data for data in desk.frames if data not in (STOP, MODE00)]
    assert {desk.end(each) for each in ("led", "fan", "mode")} == {(Phase.EXPIRED, Reason.EXPIRED)}


def test_sleep_stops_running_mode(desk: Workbench) -> None:
    desk.ask(SetMode(Mode.TRACKING))
    desk.run(4.0)
    sleep(desk)
    desk.run(12.0)
    assert MODE00 in desk.frames
    assert desk.control.driver.model.at_rest


def test_car_shown_standing_gets_no_frame_after_sleep(desk: Workbench) -> None:
    desk.ask(Stop())
    desk.run(8.0)
    assert desk.control.driver.model.basis is Basis.SHOWN
    sleep(desk)
    desk.run(4.0)
    assert desk.frames == []
    assert [entry.code for entry in desk.logs] == ["slept"]


@pytest.mark.parametrize("counted", [False, True])
def test_sleep_is_no_silence_of_car(desk: Workbench, *, counted: bool) -> None:
    desk.ask(Stop())
    desk.run(8.0)
    sleep(desk, counted=counted)
    for _ in range(10):
        desk.now += 0.2
        desk.control.tick(desk.now)
        desk.pump()
    assert desk.control.driver.model.is_heard
    assert [entry.code for entry in desk.logs] == ["slept"]


def test_report_times_from_before_the_sleep_show_nothing(desk: Workbench) -> None:
    """The pause between two reports holds the whole sleep."""
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.ask(Stop(), identity="stop")
    desk.run(1.5)
    sleep(desk, 1.9, counted=True)
    desk.hear()
    assert desk.control.driver.model.basis is not Basis.SHOWN, "one report after the sleep shows no pause"


def test_stop_continues_after_sleep(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.ask(Stop(), identity="stop", pump=False)
    sleep(desk)
    desk.run(9.0)
    assert desk.end("stop")[0] is Phase.COMPLETE


@pytest.mark.parametrize("counted", [False, True])
def test_stream_must_pause_after_sleep(desk: Workbench, *, counted: bool) -> None:
    for _ in range(5):
        desk.ask(Drive(Motion.FORWARD, 0.5), PERSON, streamed=True, age_s=0.0)
        desk.run(0.05)
    sleep(desk, counted=counted)
    assert desk.ask(FORWARD, PERSON, streamed=True, age_s=0.0).reason is Reason.HELD
    desk.run(STREAM_SILENCE_S)
    assert desk.ask(FORWARD, PERSON, streamed=True, age_s=0.0).status is not Phase.REJECTED


def test_command_after_sleep_needs_a_timestamp(desk: Workbench) -> None:
    sleep(desk)
    assert desk.ask(FORWARD, SCRIPT).reason is Reason.STALE
    assert desk.ask(FORWARD, SCRIPT, age_s=NIGHT_S).reason is Reason.STALE
    for what in (Stop(), EmergencyStop(), Pause()):
        assert desk.ask(what, PERSON).reason is None
    other = Workbench().ready()
    sleep(other)
    assert other.ask(FORWARD, SCRIPT, age_s=0.1).reason is None
    third = Workbench().ready()
    sleep(third)
    third.run(AFTER_SLEEP_S)
    assert third.ask(FORWARD, SCRIPT).reason is None


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize(("slept_s", "left"), [(590.0, True), (610.0, False)])
def test_loan_time_includes_sleep(desk: Workbench, slept_s: float, *, left: bool, counted: bool) -> None:
    desk.ask(Lend("ann", 600.0), PERSON)
    sleep(desk, slept_s, counted=counted)
    assert (desk.control.safety.loan_at(desk.now) is not None) is left


def test_sleep_with_link_down_sends_nothing_and_is_told(desk: Workbench) -> None:
    desk.control.driver.link_down("gone", desk.now)
    desk.logs.clear()
    sleep(desk)
    assert desk.frames == []
    assert [entry.code for entry in desk.logs] == ["slept"]


def test_stop_awaiting_evidence_is_resent_after_sleep(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.ask(Stop(), identity="stop")
    desk.until(lambda: bool(desk.control.driver.stops.running and desk.control.driver.stops.running.try_sent))
    sleep(desk)
    desk.run(0.1)
    assert MODE00 in desk.frames


def test_sleep_at_shutdown_begins_no_stop_after_it() -> None:
    desk = Workbench("raspberry_pi").ready()
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.control.driver.shut_down(desk.now)
    sleep(desk)
    desk.run(10.0)
    assert desk.control.driver.finished
    desk.sent.clear()
    sleep(desk)
    assert desk.control.driver.finished

"""Tests of commands through control: phases, merging and queueing, hold, refusals, recovery, shutdown."""

import random
import re
from collections.abc import Callable
from itertools import pairwise

import pytest

from gateway.control import command_queue
from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Drive,
    EmergencyStop,
    Fan,
    Find,
    Led,
    MoveArm,
    MoveServo,
    Resume,
    SetLight,
    SetMode,
    Signal,
    Stop,
)
from gateway.control.safety_state import PersistedSafety
from gateway.drivers.yahboom.protocol.frames import ModeOpen, parse_sent
from gateway.drivers.yahboom.stop_renewal import RENEWAL_INTERVALS_S
from gateway.drivers.yahboom.stops import cases
from gateway.drivers.yahboom.stops.stop_in_progress import RETRY_S
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.commands import Verb
from schemas.limits import MAX_QUEUE_TIME_S, SHUTDOWN_S
from schemas.rights import Hold, Sender
from schemas.words import (
    Basis,
    CarTrust,
    FrameOrigin,
    Light,
    Mode,
    Motion,
    Phase,
    Platform,
    Reason,
    ServoAction,
    SpeedStep,
    Verdict,
)
from tests.gateway.control.workbench import (
    BACK,
    COORDINATOR,
    MODE00,
    PERSON,
    RUN,
    SCRIPT,
    SHOWN_STOP,
    STOP,
    TRACKING,
    Workbench,
)
from tests.support.stops import ENDS_S
from tests.support.virtual import Pair

ASKED, QUEUED, SENT, COMPLETE = Phase.ASKED, Phase.QUEUED, Phase.SENT, Phase.COMPLETE
WHISTLE = Signal(Verb.WHISTLE)
LIGHT = SetLight(Light.RED)
FORWARD = Drive(Motion.FORWARD, 5.0)


SHORT_S = 9.0


@pytest.fixture
def desk() -> Workbench:
    return Workbench().ready()


# ---------------------------------------------------------------------- the life of each command


@pytest.mark.parametrize(
    ("what", "frames", "life"),
    [
        (Drive(Motion.FORWARD, 0.3), [RUN, STOP, STOP], [ASKED, QUEUED, SENT, SENT]),
        (Drive(Motion.SPIN_LEFT, 0.3), [b"$0,1,0,0,0,0,0,0,0#", STOP, STOP], [ASKED, QUEUED, SENT, SENT]),
        (Drive(Motion.STOP), [], [ASKED, SENT]),
        (SetMode(Mode.TRACKING), [b"$4WD,MODE21#"], [ASKED, QUEUED, SENT, Phase.EFFECT_SEEN]),
        (SetMode(Mode.MANUAL), SHOWN_STOP, [ASKED, QUEUED, SENT, Phase.EFFECT_SEEN]),
        (Led(1, 2, 3), [b"$4WD,CLR1,CLG2,CLB3#"], [ASKED, QUEUED, SENT]),
        (AimServo(30), [b"$4WD,PTZ30#"], [ASKED, QUEUED, SENT]),
        (LIGHT, [b"$0,0,0,0,0,0,2,0,0#"], [ASKED, QUEUED, SENT]),
        (WHISTLE, [b"$0,0,1,0,0,0,0,0,0#"], [ASKED, QUEUED, SENT]),
        (MoveServo(ServoAction.FRONT_RESET), [b"$0,0,0,0,0,0,0,0,1#"], [ASKED, QUEUED, SENT]),
        (ChangeSpeed(SpeedStep.UP), [b"$0,0,0,1,0,0,0,0,0#"], [ASKED, QUEUED, SENT]),
        (Fan(), [b"$0,0,0,0,0,0,0,1,0#"], [ASKED, QUEUED, SENT]),
        (Fan(on=True), [b"$0,0,0,0,0,0,0,1,0#"], [ASKED, QUEUED, SENT]),
        (Fan(on=False), [], [ASKED, SENT]),
        (
            Find(),
            [b"$0,0,1,0,0,0,0,0,0#", b"$4WD,CLR255,CLG255,CLB255#", b"$0,0,1,0,0,0,0,0,0#", b"$4WD,CLR0,CLG0,CLB0#"],
            [ASKED, QUEUED, SENT],
        ),
        (Stop(), SHOWN_STOP, [ASKED, QUEUED, SENT, COMPLETE]),
        (EmergencyStop("smoke"), SHOWN_STOP, [ASKED, QUEUED, SENT, COMPLETE]),
        (Resume(), [], [ASKED, SENT]),
    ],
    ids=str,
)
def test_command_writes_its_frames_and_passes_its_phases(
    desk: Workbench, what: Action, frames: list[bytes], life: list[Phase]
) -> None:
    answer = desk.ask(what, identity="it")
    assert answer.status in (QUEUED, SENT)
    desk.run(6.0 if frames is SHOWN_STOP else 4.0)
    shown = desk.control.driver.model.basis == Basis.SHOWN or isinstance(what, SetMode)
    assert desk.frames == (frames if shown else [*frames, STOP]), "a rest that nothing has shown is renewed"
    assert shown or desk.sent[-1][2] is FrameOrigin.REPEAT
    assert desk.life("it") == life
    assert all(b.at >= a.at for a, b in zip(desk.records, desk.records[1:], strict=False))


def test_mode_effect_is_seen_by_reading_of_that_mode(desk: Workbench) -> None:
    desk.ask(SetMode(Mode.TRACKING), identity="it")
    desk.run(2.4)
    assert desk.life("it")[-1] is SENT
    desk.hear(TRACKING)
    record = desk.records[-1]
    assert (record.phase, record.evidence) == (Phase.EFFECT_SEEN, ("a reading as in mode tracking",))
    again = desk.ask(SetMode(Mode.TRACKING))
    assert again.status is SENT
    assert "tracking already (confirmed)" in again.words


# ---------------------------------------------------------------------- motion is a state


def test_changed_motion_is_resent_exactly_once(desk: Workbench) -> None:
    began = desk.now
    desk.ask(FORWARD)
    desk.run(4.9)
    assert [(round(at - began, 3), data, why) for at, data, why in desk.sent] == [
        (0.0, RUN, FrameOrigin.COMMAND),
        (1.1, RUN, FrameOrigin.REPEAT),
    ]


def test_repeated_drive_of_same_motion_writes_no_frame(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD), identity="first")
    for number in range(20):
        desk.run(0.25)
        assert desk.ask(Drive(Motion.FORWARD), identity=f"more{number}").status is SENT
        assert desk.life(f"more{number}") == [ASKED, SENT]
        older = desk.records_of(f"more{number - 1}" if number else "first")
        assert (older[-1].phase, older[-1].basis) == (SENT, Basis.SENT), "somebody may wait for its end"
    assert desk.frames == [RUN, RUN]
    desk.ask(Drive(Motion.FORWARD, 0.2), PERSON, identity="hers")
    assert desk.end("more19") == (Phase.SUPERSEDED, Reason.SUPERSEDED)
    assert desk.control.owner == "mia"
    desk.run(0.1)
    assert desk.frames == [RUN, RUN]
    desk.run(3.0)
    assert desk.frames == [RUN, RUN, STOP, STOP]
    assert desk.end("hers") == (SENT, None)


def test_stop_does_not_wait_for_a_possible_block() -> None:
    """Nobody has measured whether moving the arm blocks a car, so only actions wait for that."""
    desk = Workbench("arduino+head=3WD+arm").ready()
    desk.ask(Drive(Motion.FORWARD))
    desk.run(1.3)
    desk.hear()
    desk.ask(MoveArm((90,) * 6))
    desk.until(lambda: b"ServoJ" in desk.frames[-1], 1.0)
    desk.run(0.15)
    desk.sent.clear()
    asked_at = desk.now
    desk.ask(Stop())
    desk.run(0.1)
    assert [(at - asked_at, frame) for at, frame, _ in desk.sent] == [(pytest.approx(0.0, abs=0.01), b"$3WD,MODE00#")]


def test_newest_queued_drive_supersedes_earlier_ones(desk: Workbench) -> None:
    desk.ask(WHISTLE)  # blocks for 0.3 s, so the next commands wait
    for number, motion in enumerate([Motion.FORWARD, Motion.LEFT, Motion.RIGHT, Motion.BACK]):
        assert desk.ask(Drive(motion, 2.0), identity=f"m{number}").status is QUEUED
    desk.run(1.0)
    assert desk.frames[1:] == [BACK]
    for number in range(3):
        assert desk.life(f"m{number}") == [ASKED, QUEUED, Phase.SUPERSEDED]
    assert desk.life("m3") == [ASKED, QUEUED, SENT]


def test_motion_overtakes_what_queues(desk: Workbench) -> None:
    for _ in range(3):
        desk.ask(WHISTLE)
    desk.ask(Drive(Motion.FORWARD, 3.0))
    desk.run(1.5)
    assert desk.frames[:4] == [b"$0,0,1,0,0,0,0,0,0#", RUN, b"$1,0,1,0,0,0,0,0,0#", b"$1,0,1,0,0,0,0,0,0#"]


@pytest.mark.parametrize(
    ("what", "frame"),
    [
        (LIGHT, b"$1,0,0,0,0,0,2,0,0#"),
        (WHISTLE, b"$1,0,1,0,0,0,0,0,0#"),
        (ChangeSpeed(SpeedStep.DOWN), b"$1,0,0,2,0,0,0,0,0#"),
        (Fan(), b"$1,0,0,0,0,0,0,1,0#"),
    ],
    ids=str,
)
def test_one_shot_frame_carries_held_motion(desk: Workbench, what: Action, frame: bytes) -> None:
    desk.ask(FORWARD)
    desk.run(2.0)
    desk.ask(what)
    desk.run(1.0)
    assert desk.frames == [RUN, RUN, frame]


def test_drive_repeat_after_one_shot_has_motion_only(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(0.5)
    desk.ask(Fan())
    desk.run(3.0)
    assert desk.frames == [RUN, b"$1,0,0,0,0,0,0,1,0#", RUN], "a toggle is never repeated"


def test_drive_end_sends_soft_stop(desk: Workbench) -> None:
    began = desk.now
    desk.ask(Drive(Motion.BACK, 0.7), identity="it")
    desk.run(3.0)
    assert [(round(at - began, 3), data) for at, data, _ in desk.sent] == [(0.0, BACK), (0.7, STOP), (1.8, STOP)]
    assert (desk.records[-1].phase, desk.records[-1].basis, desk.records[-1].words) == (
        SENT,
        Basis.SENT,
        "sent for 0.7 s",
    )
    assert (desk.control.driver.model.motors, desk.control.driver.model.basis) == ("off", Basis.SENT)


def test_unshown_rest_is_renewed_with_growing_pauses(desk: Workbench) -> None:
    desk.ask(Drive(Motion.BACK, 0.7))
    desk.run(2.0)
    began, sent = desk.sent[-1][0], len(desk.sent)
    desk.run(30.0)
    renewed = [(round(at - began, 1), data, why) for at, data, why in desk.sent[sent:]]
    assert [data for _, data, _ in renewed] == [STOP] * len(renewed)
    assert {why for _, _, why in renewed} == {FrameOrigin.REPEAT}
    times = [0.0, *(at for at, _, _ in renewed)]
    gaps = [round(later - earlier, 1) for earlier, later in pairwise(times)]
    assert gaps[:3] == list(RENEWAL_INTERVALS_S)
    assert set(gaps[2:]) == {RENEWAL_INTERVALS_S[-1]}


def test_shown_rest_sends_no_more_stops(desk: Workbench) -> None:
    desk.run(60.0)
    assert (desk.frames, desk.control.driver.model.basis) == ([], Basis.SHOWN)


def test_delayed_drive_has_full_duration_and_says_it_waited(desk: Workbench) -> None:
    desk.ask(SetMode(Mode.MANUAL))
    desk.run(0.1)
    desk.ask(Drive(Motion.BACK, 4.5), identity="it")
    desk.run(8.0)
    (words,) = [record.words for record in desk.records if record.phase is SENT and record.basis]
    assert re.search(r" 1\.\d s: red .* 4\.5 s$", words)


def test_repeated_waiting_drive_has_last_duration(desk: Workbench) -> None:
    desk.ask(WHISTLE)
    for duration_s in (3.0, 1.0):
        assert desk.ask(Drive(Motion.BACK, duration_s), identity=f"for {duration_s}").status is QUEUED
    desk.run(3.0)
    assert desk.frames[1:] == [BACK, STOP, STOP]
    assert [each.words for each in desk.records if each.basis][-1].endswith("sent for 1.0 s")


def test_drive_replaces_soft_stop_at_once(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 0.3))
    desk.run(0.6)
    desk.ask(Drive(Motion.FORWARD, 1.0), identity="on")
    assert desk.frames == [RUN, STOP, RUN]
    desk.run(0.9)
    assert desk.life("on") == [ASKED, QUEUED, SENT]
    desk.run(3.0)
    assert desk.frames[3:] == [STOP, STOP]


@pytest.mark.parametrize("duration_s", [0.1, 0.5, 9.0])
def test_drive_during_full_stop_waits_for_first_frames(desk: Workbench, duration_s: float) -> None:
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.ask(Stop())
    answer = desk.ask(Drive(Motion.BACK, duration_s), identity="it")
    assert answer.status is QUEUED
    assert "1.2 s at most" in answer.words
    assert (desk.control.expires_in_s(desk.now) or 0.0) >= duration_s + 1.0
    desk.until(lambda: SENT in desk.life("it"))
    assert desk.frames == [RUN, MODE00, STOP, BACK], "after the first frames of the stop, not after its evidence"
    began = desk.now
    desk.until(lambda: desk.life("it").count(SENT) == 2)
    assert desk.now - began == pytest.approx(duration_s, abs=0.06)


def test_streamed_drive_is_rejected_if_it_would_wait(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(1.0)
    desk.ask(Stop())
    desk.run(0.55)
    short = desk.ask(Drive(Motion.BACK, 0.5), streamed=True)
    assert (short.status, short.reason) == (Phase.REJECTED, Reason.EXPIRED)


def test_drive_stop_releases_held_motion_without_hold(desk: Workbench) -> None:
    desk.ask(FORWARD, identity="it")
    desk.run(0.5)
    assert desk.ask(Drive(Motion.STOP), identity="off").status is QUEUED
    desk.run(2.0)
    assert desk.frames == [RUN, STOP, STOP]
    assert desk.end("it") == (SENT, None)
    assert desk.life("off") == [ASKED, QUEUED, SENT, SENT]
    last = desk.records[-1]
    assert (last.basis, last.words) == (Basis.SENT, cases.SOFT.why("red"))
    assert desk.control.safety.hold is None, "a release is no stop"


# ---------------------------------------------------------------------- senders, stalls


def test_sender_token_away_for_one_second_ends_drive(desk: Workbench) -> None:
    desk.control.on_sender_token("mia", alive=True, now=desk.now)
    desk.ask(Drive(Motion.FORWARD, 10.0), PERSON, identity="it")
    desk.run(2.0)
    desk.control.on_sender_token("mia", alive=False, now=desk.now)
    desk.run(0.5)
    desk.control.on_sender_token("mia", alive=True, now=desk.now)  # the hub was restarted
    desk.run(2.0)
    assert desk.frames == [RUN, RUN]
    desk.control.on_sender_token("mia", alive=False, now=desk.now)
    gone = desk.now
    desk.run(3.0)
    assert [(round(at - gone, 3), data) for at, data, _ in desk.sent[2:]] == [(1.0, STOP), (2.1, STOP)]
    assert desk.end("it") == (Phase.EXPIRED, Reason.EXPIRED)
    assert desk.records[-1].words == "its sender mia disconnected"


@pytest.mark.parametrize("away_s", [0.5, 1.5])
def test_waiting_mode_of_a_lost_sender_is_dropped(desk: Workbench, away_s: float) -> None:
    """As of `fleet mode` that is killed before the car has stopped: it would drive off with nobody watching."""
    desk.control.on_sender_token("mia", alive=True, now=desk.now)
    desk.ask(FORWARD, PERSON)
    desk.run(1.0, reports=False)
    desk.ask(SetMode(Mode.TRACKING), PERSON, identity="it")
    desk.control.on_sender_token("mia", alive=False, now=desk.now)
    desk.run(away_s, reports=False)
    desk.control.on_sender_token("mia", alive=True, now=desk.now)  # the hub was restarted
    desk.run(20.0)
    ended = desk.end("it") == (Phase.EXPIRED, Reason.EXPIRED)
    assert (ended, b"$4WD,MODE21#" in desk.frames) == ((False, True) if away_s < 1.0 else (True, False))


def test_sender_token_that_comes_after_its_drive_is_watched(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 10.0), PERSON, identity="it")
    desk.run(0.01)
    desk.control.on_sender_token("mia", alive=True, now=desk.now)
    desk.run(1.0)
    desk.control.on_sender_token("mia", alive=False, now=desk.now)
    gone = desk.now
    desk.run(3.0)
    assert round(desk.sent[-2][0] - gone, 3) == 1.0
    assert desk.frames[-2:] == [STOP, STOP]
    assert "mia disconnected" in desk.records[-1].words


def test_sender_without_token_is_not_watched(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 5.0), PERSON)
    desk.control.on_sender_token("ann", alive=False, now=desk.now)
    desk.run(4.0)
    assert desk.frames == [RUN, RUN]


def test_loop_stall_stops_held_drive(desk: Workbench) -> None:
    desk.ask(FORWARD, identity="it")
    desk.run(2.0)
    desk.control.driver.on_stall(0.4, desk.now)
    desk.pump()
    assert desk.frames == [RUN, RUN]
    desk.control.driver.on_stall(0.6, desk.now)
    desk.pump()
    assert desk.frames == [RUN, RUN, STOP]
    assert desk.end("it") == (Phase.EXPIRED, Reason.EXPIRED)
    assert [entry.code for entry in desk.logs] == ["stalled"]
    desk.run(2.0)
    desk.control.driver.on_stall(9.0, desk.now)
    assert len(desk.logs) == 1, "nothing is held now"


# ---------------------------------------------------------------------- actions on parts of the car


def test_one_shot_queue_is_bounded_and_sends_each_once(desk: Workbench) -> None:
    answers = [desk.ask(Fan() if number % 2 else ChangeSpeed(SpeedStep.UP)) for number in range(12)]
    accepted = [answer for answer in answers if answer.status is not Phase.REJECTED]
    assert len(accepted) == 9, "one was written, eight wait"
    assert {answer.reason for answer in answers[9:]} == {Reason.QUEUE_FULL}
    desk.run(2.0)
    assert [data[15:16] + data[7:8] for data in desk.frames] == [b"01", b"10"] * 4 + [b"01"]


def test_mode_answer_announces_delay_by_its_stop(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(1.0)
    wait_s, asked_at = desk.control.wait_s(SetMode(Mode.TRACKING), desk.now), desk.now
    answer = desk.ask(SetMode(Mode.TRACKING), identity="it")
    assert f" {wait_s:.1f} s " in answer.words
    desk.until(lambda: SENT in desk.life("it"))
    assert desk.now <= asked_at + wait_s


def test_drive_waits_for_recovery_after_connect() -> None:
    desk = Workbench()
    desk.control.link_up(desk.now)
    desk.pump()
    assert desk.ask(Drive(Motion.FORWARD, 0.5), identity="it").words.startswith("begins in ")
    desk.run(MAX_QUEUE_TIME_S + 0.1, reports=False)
    assert desk.life("it")[:3] == [ASKED, QUEUED, Phase.SENT], "also if the car sends nothing"


@pytest.mark.parametrize("actions", [0, 5])
def test_wait_of_a_mode_counts_after_waiting_actions(desk: Workbench, actions: int) -> None:
    desk.ask(FORWARD)
    for degrees in range(actions):
        desk.ask(AimServo(degrees))
    said = desk.ask(SetMode(Mode.TRACKING)).words
    assert said.startswith("opens in ")
    assert ("at most after" in said) is bool(actions)


@pytest.mark.parametrize("what", [WHISTLE, SetMode(Mode.TRACKING)], ids=str)
def test_queued_command_expires_for_busy_car(what: Action, monkeypatch: pytest.MonkeyPatch) -> None:
    """No car is busy for so long, so the limit is shortened."""
    monkeypatch.setattr(command_queue, "MAX_QUEUE_TIME_S", SHORT_S)
    desk = Workbench()
    desk.control.link_up(desk.now)
    desk.pump()
    desk.ask(what, identity="it")
    desk.run(SHORT_S + 0.1, reports=False)
    assert desk.life("it") == [ASKED, QUEUED, Phase.EXPIRED]
    assert desk.end("it") == (Phase.EXPIRED, Reason.EXPIRED)


def test_blinking_that_expires_says_how_much_was_sent(desk: Workbench, monkeypatch: pytest.MonkeyPatch) -> None:
    desk.ask(Find(), identity="it")
    desk.until(lambda: len(desk.frames) == 2)
    monkeypatch.setattr(command_queue, "MAX_QUEUE_TIME_S", 0.0)
    desk.run(0.1)
    assert desk.end("it") == (Phase.EXPIRED, Reason.EXPIRED)
    assert desk.records_of("it")[-1].words.startswith("only 2 of its 4 frames were sent: ")


def test_one_shots_queued_before_mode_are_sent_before_it(desk: Workbench) -> None:
    desk.ask(WHISTLE)
    desk.ask(AimServo(30))
    desk.ask(SetMode(Mode.TRACKING))
    assert desk.ask(AimServo(60)).reason is Reason.WRONG_MODE
    desk.run(3.0)
    assert desk.frames == [b"$0,0,1,0,0,0,0,0,0#", b"$4WD,PTZ30#", b"$4WD,MODE21#"]


def test_mode_while_driving_stops_then_opens(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.run(2.0)
    desk.ask(WHISTLE)
    desk.ask(WHISTLE)
    desk.ask(SetMode(Mode.TRACKING), identity="mode")
    desk.until(lambda: SENT in desk.life("mode"))
    whistle = b"$0,0,1,0,0,0,0,0,0#"
    assert desk.frames == [RUN, RUN, b"$1,0,1,0,0,0,0,0,0#", MODE00, STOP, whistle, b"$4WD,MODE21#"]


# ---------------------------------------------------------------------- hold


def test_stop_of_person_holds_car_against_coordinator(desk: Workbench) -> None:
    assert desk.ask(FORWARD, COORDINATOR).status is QUEUED
    desk.ask(Stop(), PERSON)
    assert desk.control.safety.hold == Hold("mia", int(desk.now * 1e9))
    desk.run(600.0)
    everything: list[Action] = [FORWARD, Drive(Motion.STOP), SetMode(Mode.TRACKING), SetMode(Mode.MANUAL), LIGHT, Fan()]
    for what in [*everything, ChangeSpeed(SpeedStep.UP), Find(), Resume()]:
        answer = desk.ask(what, COORDINATOR)
        assert (answer.status, answer.reason) == (Phase.REJECTED, Reason.HELD), what
    for what in (Stop(), EmergencyStop("smoke")):
        assert desk.ask(what, COORDINATOR, identity=type(what).__name__).status is QUEUED
    assert desk.control.safety.hold is not None
    assert desk.control.safety.hold.by == "mia", "the first keeps it"
    assert desk.ask(Resume(("EmergencyStop",)), PERSON).status is SENT
    for what in (LIGHT, WHISTLE, Find()):
        assert desk.ask(what, PERSON).status is QUEUED
    assert desk.control.safety.hold is not None, "only a drive, a mode or resume end it"


@pytest.mark.parametrize("what", [FORWARD, SetMode(Mode.TRACKING), SetMode(Mode.MANUAL), Resume()])
@pytest.mark.parametrize("sender", [PERSON, SCRIPT], ids=["person", "script"])
def test_drive_mode_or_resume_of_person_or_script_ends_hold(desk: Workbench, what: Action, sender: Sender) -> None:
    desk.ask(Stop(), PERSON)
    desk.run(2.0)
    assert desk.ask(what, sender).status is not Phase.REJECTED
    assert desk.control.safety.hold is None
    assert desk.logs[-1].code == "hold_ended"


def test_refused_command_does_not_end_hold(desk: Workbench) -> None:
    desk.ask(Stop(), PERSON)
    assert desk.ask(FORWARD, age_s=9.0).reason is Reason.STALE
    desk.control.driver.link_down("unplugged", desk.now)
    assert desk.ask(FORWARD).reason is Reason.LINK_DOWN
    assert desk.control.safety.hold is not None
    assert desk.ask(Resume()).status is SENT, "resume needs no car"
    assert desk.control.safety.hold is None


def test_coordinator_stop_sets_no_hold_and_coordinator_may_not_resume(desk: Workbench) -> None:
    desk.ask(Stop(), COORDINATOR)
    assert desk.control.safety.hold is None
    desk.run(2.0)
    assert desk.ask(Resume(), COORDINATOR).reason is Reason.HELD
    assert desk.ask(FORWARD, COORDINATOR).status is QUEUED


def test_hold_survives_gateway_restart() -> None:
    desk = Workbench(kept=PersistedSafety(Hold("mia", 1))).ready()
    assert desk.ask(FORWARD, COORDINATOR).reason is Reason.HELD
    assert desk.ask(FORWARD, PERSON).status is QUEUED


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize("what", [FORWARD, LIGHT, AimServo(1), Fan(), ChangeSpeed(SpeedStep.UP), Find()], ids=str)
def test_in_another_mode_the_car_would_ignore_it(desk: Workbench, what: Action) -> None:
    desk.ask(SetMode(Mode.TRACKING))
    desk.run(3.0)
    answer = desk.ask(what)
    assert answer.reason is Reason.WRONG_MODE
    words = " while in mode tracking. First: `fleet mode red manual` (or `fleet stop red` if a plan runs)."
    assert answer.words.startswith("red ignores ")
    assert answer.words.endswith(words)
    assert desk.ask(Drive(Motion.STOP)).status is QUEUED
    desk.run(4.0)
    assert desk.frames == [b"$4WD,MODE21#", MODE00, MODE00], "where a soft stop is not safe it is a full one"


@pytest.mark.parametrize(
    ("platform", "what"),
    [
        ("raspberry_pi", SetMode(Mode.TRACKING)),
        ("raspberry_pi", SetLight(Light.YELLOW)),
        ("raspberry_pi", Fan(on=True)),
        ("unknown", SetMode(Mode.FOLLOWING)),
        ("unknown", AimServo(3)),
        ("arduino", MoveArm((1, 2, 3, 4, 5, 6))),
        ("arduino", MoveServo(ServoAction.VERTICAL_UP)),
    ],
    ids=str,
)
def test_unsupported_action_is_never_sent(platform: str, what: Action) -> None:
    desk = Workbench(platform).ready()
    assert desk.ask(what, identity="it").reason is Reason.UNSUPPORTED
    desk.run(2.0)
    assert set(desk.frames) <= {STOP, MODE00}, "a rest that nothing has shown is renewed"
    assert {why for _, _, why in desk.sent} <= {FrameOrigin.REPEAT}
    assert desk.life("it") == [ASKED, Phase.REJECTED]


def test_duplicate_and_stale(desk: Workbench) -> None:
    assert desk.ask(Fan(), identity="x").status is QUEUED
    life = desk.life("x")
    assert desk.ask(Fan(), identity="x").reason is Reason.DUPLICATE
    assert desk.life("x") == life, "the record of the first says nothing of the second"
    assert [log.code for log in desk.logs] == ["duplicate"]
    assert desk.ask(Fan(), identity="y", age_s=2.1).reason is Reason.STALE
    assert desk.ask(Fan(), identity="y").status is QUEUED, "a refused id is not used up"
    assert desk.ask(Stop(), identity="x", age_s=99.0).status is QUEUED, "a stop never is"


# ---------------------------------------------------------------------- streams


def test_stream_is_recorded_at_start_changes_and_end(desk: Workbench) -> None:
    for motion in [Motion.FORWARD] * 10 + [Motion.LEFT] * 5:
        desk.ask(Drive(motion, 0.5), PERSON, streamed=True)
        desk.run(0.05)
    desk.run(3.0)
    assert [(record.phase, record.count) for record in desk.records] == [
        (QUEUED, 1),
        (SENT, 1),
        (Phase.SUPERSEDED, 10),
        (QUEUED, 1),
        (SENT, 1),
        (SENT, 5),
    ]


def test_refused_stream_is_recorded_once_per_cause(desk: Workbench) -> None:
    desk.ask(Stop(), PERSON)
    before = len(desk.records)
    for _ in range(50):
        desk.ask(FORWARD, COORDINATOR, streamed=True)
    assert [record.reason for record in desk.records[before:] if record.phase is Phase.REJECTED] == [Reason.HELD]


# ---------------------------------------------------------------------- link and recovery


def test_link_loss_fails_queued_and_held_commands(desk: Workbench) -> None:
    desk.ask(FORWARD, identity="held")
    desk.ask(WHISTLE, identity="act")
    desk.control.driver.link_down("unplugged", desk.now)
    desk.take()
    for identity in ("held", "act"):
        assert desk.end(identity) == (Phase.FAILED, Reason.LINK_DOWN), identity
    assert (
        desk.control.driver.model.motors,
        desk.control.driver.model.motion,
        desk.control.driver.model.believed.fan,
    ) == (
        "unknown",
        None,
        None,
    )
    stop = desk.ask(Stop(), PERSON)
    assert (stop.status, stop.reason) == (Phase.REJECTED, Reason.LINK_DOWN)
    assert desk.control.safety.hold is not None, "a stop by hand holds, reached or not"
    desk.run(60.0)
    assert desk.frames == [RUN]


def test_write_failure_fails_its_command_and_queued_ones(desk: Workbench) -> None:
    desk.ask(FORWARD, identity="it", pump=False)
    desk.ask(WHISTLE, identity="act", pump=False)
    write = desk.control.driver.poll(desk.now)
    assert write is not None
    desk.control.driver.link_down("a write failed: gone", desk.now, cause=Reason.WRITE_FAILED)
    desk.take()
    for identity in ("it", "act"):
        assert desk.end(identity) == (Phase.FAILED, Reason.WRITE_FAILED)
    assert desk.ask(FORWARD).reason is Reason.LINK_DOWN
    desk.control.link_up(desk.now)
    desk.pump()
    assert desk.frames == [b"#"], "recovery"


def test_stop_in_progress_fails_with_link_loss(desk: Workbench) -> None:
    desk.ask(Stop(), identity="it")
    desk.control.driver.link_down("unplugged", desk.now)
    desk.take()
    assert desk.end("it") == (Phase.FAILED, Reason.LINK_DOWN)


def test_unanswered_recovery_goes_on_with_growing_pauses() -> None:
    desk = Workbench()
    began = desk.now
    desk.control.link_up(began)
    desk.pump()
    desk.ask(Stop(), PERSON, identity="it")
    desk.run(120.0, reports=False)
    again = [b"#", MODE00, MODE00, STOP]
    tries = [desk.frames[first : first + 4] for first in range(0, len(desk.frames) - 3, 4)]
    assert tries == [again] * len(tries)
    assert len(tries) > 8
    times = [at - began for at, _, _ in desk.sent]
    assert [round(at, 2) for at in times[:4]] == [0.0, 0.05, 3.7, 4.8]
    assert max(later - earlier for earlier, later in pairwise(times)) <= RETRY_S[-1]
    assert (desk.control.driver.model.motors, desk.control.driver.model.basis) == ("unknown", None)
    assert desk.control.driver.model.trust.state is CarTrust.UNHEARD
    assert [log.code for log in desk.logs].count("unheard") == 1
    assert desk.end("it") == (Phase.FAILED, Reason.NOT_SHOWN)
    assert desk.ask(FORWARD, identity="unheard").status is QUEUED, "what is not shown forbids nothing"
    assert any("nothing shows" in record.words for record in desk.records[-2:])
    assert desk.ask(Stop(), identity="again").status is QUEUED, "a stop is always tried"
    desk.run(60.0, reports=False)
    assert desk.end("again") == (Phase.FAILED, Reason.NOT_SHOWN)
    desk.hear()
    desk.run(15.0)
    assert (desk.control.driver.model.motors, desk.control.driver.model.basis) == ("off", Basis.SHOWN)


def test_reports_alone_confirm_nothing_and_two_block_gaps_do() -> None:
    desk = Workbench()
    desk.control.link_up(desk.now)
    desk.pump()
    for _ in range(4):
        desk.run(0.95, reports=False)
        desk.hear()
        assert not desk.control.driver.model.known, "it reports, and nothing shows that it reads"
    desk.until(lambda: desk.control.driver.model.known)
    assert desk.control.driver.model.basis == Basis.SHOWN
    assert desk.control.driver.model.trust.evidence.endswith(" after MODE00")
    assert desk.logs[-1].code == "recovered"


# ---------------------------------------------------------------------- the end


def idle(desk: Workbench) -> None:
    pass


def driving(desk: Workbench) -> None:
    desk.ask(FORWARD, identity="it")


def acting(desk: Workbench) -> None:
    desk.ask(Find(), identity="it")
    desk.ask(AimServo(1))


def opening(desk: Workbench) -> None:
    desk.ask(SetMode(Mode.TRACKING), identity="it")


def stopping(desk: Workbench) -> None:
    desk.ask(Stop())
    desk.run(0.3)


def recovering(desk: Workbench) -> None:
    desk.control.driver.link_down("gone", desk.now)
    desk.control.link_up(desk.now)
    desk.run(1.0, reports=False)


STATES = [idle, driving, acting, opening, stopping, recovering]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi", "unknown"])
def test_shutdown_ends_when_stop_is_shown_or_sent(platform: str, state: Callable[[Workbench], None]) -> None:
    desk = Workbench(platform).ready()
    state(desk)
    began, sent = desk.now, len(desk.sent)
    desk.control.driver.shut_down(desk.now)
    desk.control.driver.shut_down(desk.now)
    while not desk.control.driver.finished:
        assert desk.now - began <= SHUTDOWN_S
        desk.run(0.01)
    assert not desk.control.driver.stops.not_stopped
    assert (desk.control.driver.model.motors, desk.control.driver.model.basis is not None) == ("off", True)
    assert platform != "arduino" or desk.control.driver.model.basis == Basis.SHOWN
    assert platform != "raspberry_pi" or desk.control.driver.model.basis == Basis.SENT
    if state is idle and platform == "arduino":
        assert (desk.now, len(desk.sent)) == (began, sent), "it has shown that it stands: nothing is sent"
    if desk.life("it"):
        assert desk.life("it")[-1] in (Phase.SUPERSEDED, SENT, Phase.REJECTED)
    for what in (FORWARD, WHISTLE, Stop()):
        assert desk.ask(what).reason is Reason.LINK_DOWN


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("platform", ["arduino", "unknown"])
def test_shutdown_without_reports_ends_in_time_and_says_not_stopped(
    platform: str, state: Callable[[Workbench], None]
) -> None:
    desk = Workbench(platform).ready()
    state(desk)
    if desk.control.driver.model.basis is not None:
        desk.ask(Drive(Motion.FORWARD, 0.2))
        desk.run(0.1)
    began = desk.now
    desk.control.driver.shut_down(desk.now)
    while not desk.control.driver.finished:
        assert desk.now - began <= SHUTDOWN_S
        desk.run(0.01, reports=False)
    desk.take()
    assert desk.now - began == pytest.approx(SHUTDOWN_S, abs=0.02)
    assert "not reacted" in desk.control.driver.stops.not_stopped
    assert desk.logs[-1].code == "not_stopped"
    assert desk.logs[-1].words.startswith("red may still ")
    assert desk.control.driver.stops.not_stopped in desk.logs[-1].words
    assert desk.control.driver.model.basis is None


def test_shutdown_without_link_says_not_stopped_at_once(desk: Workbench) -> None:
    desk.control.driver.link_down("unplugged", desk.now)
    desk.control.driver.shut_down(desk.now)
    assert desk.control.driver.finished
    desk.take()
    assert [entry.code for entry in desk.logs] == ["not_stopped"]
    assert "red is unreachable (unplugged)" in desk.logs[0].words


def test_stop_command_during_shutdown_says_not_confirmed_or_not_stopped(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 5.0))
    desk.run(0.5)
    desk.control.driver.shut_down(desk.now)
    assert desk.ask(Stop()).words.startswith("NOT CONFIRMED: ")
    desk.control.driver.link_down("unplugged", desk.now)
    assert desk.ask(Stop()).words.startswith("NOT STOPPED: red ")


def test_shutdown_before_first_link_says_car_not_reached() -> None:
    """The previous gateway may have left the car driving."""
    desk = Workbench()
    desk.control.driver.shut_down(desk.now)
    assert desk.control.driver.finished
    desk.take()
    assert [entry.code for entry in desk.logs] == ["not_stopped"]
    assert desk.control.driver.stops.not_stopped


def test_shutdown_while_tracking_is_told() -> None:
    """The link loses all frames. Before the gateway gives up, it tries a recovery and waits for evidence."""
    pair = Pair(start_s=2.0).ready()
    pair.ask(SetMode(Mode.TRACKING))
    pair.run(8.0)
    pair.lose_frames()
    began = pair.now
    pair.control.driver.shut_down(began)
    pair.until(lambda: pair.control.driver.finished, SHUTDOWN_S + 0.1)
    assert pair.car.truth.mode is Mode.TRACKING
    assert pair.control.driver.stops.not_stopped
    assert pair.logs[-1].code == "not_stopped"


def test_shutdown_while_tracking_waits_until_stop_is_shown() -> None:
    pair = Pair(start_s=2.0).ready()
    pair.ask(SetMode(Mode.TRACKING))
    pair.run(8.0)
    pair.control.driver.shut_down(pair.now)
    assert pair.until(lambda: pair.control.driver.finished, SHUTDOWN_S) <= 1.1 + 4.5
    assert pair.control.driver.model.mode.verdict is Verdict.CONFIRMED
    assert pair.control.driver.model.basis == Basis.SHOWN
    assert not pair.control.driver.stops.not_stopped


def test_link_loss_during_shutdown_logs_not_stopped(desk: Workbench) -> None:
    desk.ask(FORWARD)
    desk.control.driver.shut_down(desk.now)
    desk.run(0.5)
    assert desk.frames == [RUN, MODE00]
    desk.control.driver.link_down("unplugged", desk.now)
    desk.take()
    assert desk.control.driver.finished
    assert [entry.code for entry in desk.logs] == ["not_stopped"]


# ---------------------------------------------------------------------- everything at once


def anything(moments: random.Random) -> Action:
    return moments.choice(  # type: ignore[return-value]  # joined to object
        [
            *(Drive(motion, moments.choice([0.1, 0.5, 3.0])) for motion in Motion),
            *(SetMode(mode) for mode in (Mode.MANUAL, Mode.TRACKING, Mode.COLOR_LED)),
            *(WHISTLE, LIGHT, AimServo(90), Led(1, 2, 3), Find(), Resume()),
            *(Fan(), ChangeSpeed(SpeedStep.UP), Stop()),
        ]
    )


@pytest.mark.parametrize("platform", ["arduino", "raspberry_pi", "unknown"])
def test_any_commands_keep_one_frame_in_flight_and_stop_wins(platform: str) -> None:
    stops = {b"#", STOP, MODE00}
    for seed in range(60):
        moments = random.Random(seed)
        desk = Workbench(platform).ready()
        links = {0}
        for _ in range(moments.randrange(5, 40)):
            desk.ask(anything(moments), moments.choice([PERSON, SCRIPT, COORDINATOR]), streamed=False)
            if moments.random() < 0.02:
                desk.control.driver.link_down("unplugged", desk.now)
                desk.control.link_up(desk.now)
                links.add(len(desk.sent))
            desk.run(moments.choice([0.0, 0.01, 0.05, 0.3, 1.5]), reports=moments.random() < 0.8)
        before = len(desk.sent)
        desk.ask(Stop(), identity="the-stop")
        desk.run(ENDS_S)
        assert set(desk.frames[before:]) <= stops, seed
        ends = [each for each in desk.records if each.command.id == "the-stop"]
        if (
            desk.car.fan and not desk.control.driver.model.believed.fan_may_run
        ):  # the fan ran when the link was lost, so control does not know why the car is silent
            assert (ends[-1].phase, ends[-1].reason) == (Phase.FAILED, Reason.NOT_SHOWN), seed
            assert desk.control.driver.model.motors == "unknown", seed
            continue
        assert desk.control.driver.model.motors == "off", seed
        assert (ends[-1].phase is COMPLETE) == (ends[-1].basis == Basis.SHOWN), seed
        assert ends[-1].phase is COMPLETE or (ends[-1].phase, ends[-1].basis) == (SENT, Basis.SENT), seed

        profile = desk.control.driver.model.profile
        for index in set(range(1, len(desk.sent))) - links:
            (earlier, first, _), (later, second, why) = desk.sent[index - 1 : index + 1]
            frame = parse_sent(first)
            assert frame is not None
            gap = later - earlier + 1e-6
            if first == b"#":
                assert gap >= 0.05
            elif why is FrameOrigin.RECOVERY or (second in stops and platform != "arduino"):
                assert gap >= 0.06, "recovery, and the stops of these platforms, do not wait for a block's end"
            elif isinstance(frame, ModeOpen) and second == MODE00:
                assert gap >= 1.1, "the opening frame is read by then: MODE00 is alone when its block ends"
            else:
                assert gap >= profile.block_s(frame) >= 0.06, (seed, first, second)
        sent = [record.command.what for record in desk.records if record.phase is SENT]
        assert sum(data[15:16] == b"1" for data in desk.frames if data[2:3] == b",") == sent.count(Fan())
        assert sum(data[7:8] == b"1" for data in desk.frames if data[2:3] == b",") == sent.count(
            ChangeSpeed(SpeedStep.UP)
        )
        ended = {record.command.id for record in desk.records if record.phase not in (ASKED, QUEUED)}
        assert ended == {record.command.id for record in desk.records}, "every command has an end"


def test_believed_fan_and_speed_match_simulated_car() -> None:
    pair = Pair(start_s=2.0).ready()
    for _ in range(3):
        pair.ask(Fan())
        pair.run(2.5)
        assert pair.car.truth.fan is pair.control.driver.model.believed.fan
    for step in (SpeedStep.DOWN, SpeedStep.DOWN, SpeedStep.UP, SpeedStep.UP, SpeedStep.UP, SpeedStep.UP):
        pair.ask(ChangeSpeed(step))
        pair.run(1.2)  # the car has read the step before the next frame
        assert pair.car.truth.speed == max(pair.control.driver.model.believed.speeds[Platform.ARDUINO])


def test_speed_that_a_mode_has_set_is_not_exceeded_by_the_estimate() -> None:
    pair = Pair(start_s=2.0).ready()
    assert pair.car.truth.speed == max(pair.control.driver.model.believed.speeds[Platform.ARDUINO])
    pair.ask(SetMode(Mode.LIGHT_SEEKING))
    pair.run(8.0)
    pair.ask(SetMode(Mode.MANUAL))
    pair.run(8.0)
    assert pair.car.truth.speed == 200
    for _ in range(4):
        assert pair.car.truth.speed <= max(pair.control.driver.model.believed.speeds[Platform.ARDUINO])
        pair.ask(ChangeSpeed(SpeedStep.DOWN))
        pair.run(0.5)


@pytest.mark.parametrize(("platform", "heard"), [("unknown", False), ("arduino", False), ("raspberry_pi", True)])
def test_car_without_readings_gets_advice(platform: str, *, heard: bool) -> None:
    desk = Workbench(platform)
    desk.control.link_up(desk.now)
    if heard:
        desk.run(3.0)
    desk.ask(Stop(), PERSON, identity="it")
    desk.run(40.0, reports=False)
    words = [each.words for each in desk.records if each.phase is Phase.FAILED]
    words += [each.words for each in desk.logs if each.code == "unheard"]
    assert words
    assert all(("+no_readings" in each) is not heard for each in words), words


@pytest.mark.parametrize(("heard", "doubted"), [(True, False), (False, True)])
def test_drive_in_unshown_mode_of_unknown_car_says_so(*, heard: bool, doubted: bool) -> None:
    desk = Workbench("unknown")
    desk.control.link_up(desk.now)
    desk.run(12.0, reports=heard)
    desk.ask(Drive(Motion.FORWARD, 0.5), PERSON, identity="it")
    desk.run(3.0, reports=heard)
    assert desk.end("it") == (SENT, None)
    words = [each.words for each in desk.records if each.command.id == "it"][-1]
    assert ("Name its platform" in words) is doubted, words


def test_level_fan_stays_on_through_lights_drives_reports() -> None:
    pair = Pair("arduino", told="arduino+fan_level", traits=CarTraits(fan_level=True), start_s=2.0).ready()
    pair.control.driver.model.believed.fan = None  # as after a connect: a level needs no known state
    assert pair.ask(Fan(on=True)).status is QUEUED
    for what in (SetLight(Light.RED), Drive(Motion.FORWARD, 0.5)):
        pair.run(4.0)
        pair.ask(what)
        pair.run(4.0)
        assert (pair.car.truth.fan, pair.control.driver.model.believed.fan) == (True, True)
    pair.ask(Fan(on=False))
    pair.run(4.0)
    assert (pair.car.truth.fan, pair.control.driver.model.believed.fan) == (False, False)


def test_silence_is_normal_if_fan_may_run(desk: Workbench) -> None:
    """After the link was lost, nobody knows whether the fan runs, so a toggle may have switched it on."""
    desk.control.driver.link_down("cut", desk.now)
    desk.control.driver.link_up(desk.now)
    desk.run(8.0, reports=False)
    desk.ask(Fan())
    desk.run(4.0, reports=False)
    assert b"$0,0,0,0,0,0,0,1,0#" in desk.frames
    model = desk.control.driver.model
    assert (model.outputs.fan, model.silence_limit_s) == (None, None)


def test_timer_reports_do_not_show_fan() -> None:
    pair = Pair("stm32", start_s=2.0).ready()
    pair.ask(Fan())
    pair.run(6.0)
    assert pair.car.truth.fan
    assert pair.control.driver.model.believed.fan is None
    refused = pair.ask(Fan(on=True))
    assert (refused.status, pair.car.truth.fan) == (Phase.REJECTED, True), "it would turn the fan off"


@pytest.mark.parametrize("mode", [Mode.COLOR_LED, Mode.OBSTACLE_AVOIDANCE, Mode.TRACKING])
def test_command_during_mode_change_is_not_lost(mode: Mode) -> None:
    for seed in range(12):
        pair = Pair("arduino", seed=seed).ready()
        pair.ask(SetMode(mode))
        pair.run(6.0 + 2.0 * random.Random(seed).random())
        pair.ask(SetMode(Mode.MANUAL))
        control = pair.control
        pair.until(lambda control=control: control.driver.stops.running is None, 20.0)
        before = pair.car.truth.fan
        pair.ask(Fan())
        pair.run(7.0)
        assert pair.car.truth.fan is not before, seed


def test_mode_behind_a_waiting_action_keeps_no_loop_busy() -> None:
    """Without an echo, the second action waits for the first. The mode waits for both, and is not due meanwhile."""
    pair = Pair("arduino", world=World.open_field()).ready()
    pair.ask(Drive(Motion.FORWARD, 0.5))
    pair.run(6.0)
    pair.ask(Led(1, 2, 3))
    pair.run(0.3)
    pair.ask(ChangeSpeed(SpeedStep.UP))
    pair.ask(SetMode(Mode.LIGHT_SEEKING))
    pair.run(6.0)  # fails if the loop never sleeps
    assert pair.car.truth.mode is Mode.LIGHT_SEEKING


def test_answers_say_how_long_the_car_has_really_been_silent() -> None:
    """While it is silent, the gateway stops it again and again. The times in which that keeps it busy count, too."""
    pair = Pair("arduino").ready()
    pair.deaf_until = float("inf")
    heard_at = pair.control.driver.model.mode.heard_at
    pair.until(lambda: not pair.control.driver.model.is_heard, 20.0)
    for _ in range(8):
        pair.run(7.3)
        silent = f"silent for {pair.now - heard_at:.0f} s"
        assert silent in pair.ask(Stop()).words
    assert silent in pair.ask(Drive(Motion.FORWARD, 0.2)).words

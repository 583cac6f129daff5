"""Tests of the right to move the car, through control: e-stops, leases, and streams that must pause after a stop."""

import pytest

from gateway.control.commands import Action, ChangeSpeed, Drive, EmergencyStop, Led, Resume, SetMode, Stop, TakeLease
from gateway.control.safety_state import PersistedSafety
from schemas.rights import Estop, Sender
from schemas.words import Mode, Motion, Phase, Rank, Reason, SpeedStep
from tests.gateway.control.workbench import (
    COORDINATOR,
    PERSON,
    RUN,
    SCRIPT,
    SHOWN_STOP,
    STOP,
    TRACKING,
    Workbench,
)

SENT, QUEUED, REJECTED, SUPERSEDED = Phase.SENT, Phase.QUEUED, Phase.REJECTED, Phase.SUPERSEDED
FORWARD = Drive(Motion.FORWARD, 5.0)
BOB = Sender("bob", Rank.PERSON)


@pytest.fixture
def desk() -> Workbench:
    return Workbench().ready()


# ---------------------------------------------------------------------- e-stop


def test_estop_latches_until_its_id_is_resumed(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT)
    answer = desk.ask(EmergencyStop("smoke"), PERSON, identity="e1")
    assert answer.status is QUEUED
    assert answer.words.endswith("`fleet resume red --estops`")
    assert answer.worst_case_s > 0
    desk.run(600.0)
    assert desk.frames == [RUN, *SHOWN_STOP]
    assert desk.life("e1") == [Phase.ASKED, QUEUED, SENT, Phase.COMPLETE]
    for what in (FORWARD, SetMode(Mode.MANUAL), Led(1, 2, 3), TakeLease(), Drive(Motion.STOP)):
        refused = desk.ask(what, PERSON)
        assert (refused.status, refused.reason) == (REJECTED, Reason.ESTOPPED)
        assert 'red is emergency-stopped (mia: "smoke"). Release it with ' in refused.words
        assert "`fleet resume red --estops`" in refused.words
    assert desk.ask(Stop(), SCRIPT).status is QUEUED
    assert desk.ask(Resume(("e2",)), PERSON).reason is Reason.BAD_VALUE
    still = desk.ask(Resume(), PERSON)
    assert (still.status, still.reason) == (SENT, Reason.ESTOPPED), "without ids it ends the hold"
    assert 'by mia ("smoke")' in still.words
    assert "`fleet resume red --estops`" in still.words
    assert desk.control.safety.hold is None
    assert desk.ask(Resume(("e1",)), SCRIPT).status is SENT
    assert desk.logs[-1].code == "estop_ended"
    desk.run(5.0)
    assert desk.ask(FORWARD, SCRIPT).status is QUEUED


def test_hold_outlives_estop(desk: Workbench) -> None:
    desk.ask(EmergencyStop("smoke"), COORDINATOR, identity="e1")
    desk.run(5.0)
    released = desk.ask(Resume(("e1",)), PERSON).words
    assert released.startswith("e-stop released; ")
    assert released.endswith("by plan: `fleet resume red`")
    assert desk.ask(FORWARD, COORDINATOR).reason is Reason.HELD
    assert desk.ask(FORWARD, PERSON).status is QUEUED


def test_resume_counts_only_estops_that_have_ended(desk: Workbench) -> None:
    desk.ask(EmergencyStop("x"), PERSON, identity="e1")
    desk.ask(EmergencyStop("y"), PERSON, identity="e2")
    assert desk.ask(Resume(("e1", "e9")), PERSON).words.startswith("e-stop released; still emergency-stopped by mia")
    assert desk.ask(Resume(("e1",)), PERSON).words.startswith("e-stop released; "), "a copy of the same command"


def test_several_e_stops_in_force_are_named_by_their_ids(desk: Workbench) -> None:
    desk.ask(EmergencyStop("smoke"), PERSON, identity="e1")
    desk.ask(EmergencyStop(), BOB, identity="e2")
    desk.ask(EmergencyStop(fleet_wide=True), BOB, identity="e3")
    released = desk.ask(Resume(("e2",)), PERSON).words
    assert released.startswith("e-stop released; ")
    assert 'by mia ("smoke") [e1], by bob [e3]' in released
    assert "`fleet resume red --estops`" in released
    assert desk.ask(Resume(("e1", "e3")), PERSON).words.startswith("2 e-stops released; ")


def test_estop_of_unreachable_car_is_latched(desk: Workbench) -> None:
    desk.control.driver.link_down("unplugged", desk.now)
    answer = desk.ask(EmergencyStop(), PERSON, identity="e1")
    assert (answer.status, answer.reason) == (REJECTED, Reason.LINK_DOWN)
    assert answer.words == (
        "NOT STOPPED: red is unreachable. If it was driving, it still is: go to the car. "
        "It is emergency-stopped when its link is back."
    )
    desk.control.link_up(desk.now)
    desk.run(10.0)
    assert desk.ask(FORWARD, PERSON).reason is Reason.ESTOPPED


def test_estop_survives_gateway_restart() -> None:
    estop = Estop("e1", "mia", "smoke", 7, fleet_wide=False)
    desk = Workbench(kept=PersistedSafety(None, (estop,), ())).ready()
    assert desk.ask(FORWARD, PERSON).reason is Reason.ESTOPPED
    desk.ask(Resume(("e1",)), PERSON)
    assert desk.control.safety.persisted == PersistedSafety(None, (), ("e1",))


def test_estop_merged_from_other_gateway_stops_car(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT, identity="d")
    estop = Estop("e1", "mia", "smoke", 7, fleet_wide=True)
    desk.control.merge_estops([estop], [], "blue", desk.now)
    desk.run(3.0)
    assert desk.frames == [RUN, *SHOWN_STOP]
    assert desk.end("d") == (SUPERSEDED, Reason.SUPERSEDED)
    assert desk.logs[0].code == "estop_joined"
    assert "by mia: smoke (e-stop e1, seen from blue)" in desk.logs[0].words
    desk.sent.clear()
    desk.control.merge_estops([estop], [], "green", desk.now)
    desk.run(3.0)
    assert desk.frames == [], "it is known already"
    desk.control.merge_estops([], ["e1"], "blue", desk.now)
    assert desk.ask(FORWARD, PERSON).status is QUEUED


def test_estop_at_rest_is_carried_out(desk: Workbench) -> None:
    desk.control.merge_estops([Estop("e1", "mia", "", 7, fleet_wide=True)], [], "blue", desk.now)
    desk.run(6.0)
    assert desk.frames == SHOWN_STOP


# ---------------------------------------------------------------------- lease


def test_drive_lease_lasts_two_seconds_longer(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 3.0), SCRIPT)
    other = Sender("other")
    refused = desk.ask(Drive(Motion.LEFT), other)
    assert (refused.status, refused.reason) == (REJECTED, Reason.LEASED)
    assert "red is driven by script (script) for another 5.0 s. Wait until the car is free." in refused.words
    desk.run(4.9)
    assert desk.ask(Drive(Motion.STOP), other).reason is Reason.LEASED, "whose idle stick would stop another's car"
    assert desk.ask(Led(1, 2, 3), other).status is QUEUED
    desk.run(0.2)
    assert desk.ask(Drive(Motion.LEFT), other).status is QUEUED


def test_finished_command_line_keeps_lease_from_lower_rank_only(desk: Workbench) -> None:
    """If a person stops a car and drives it a little, the coordinator must not drive it off at once."""
    desk.control.on_sender_token("mia", alive=True, now=desk.now)
    desk.ask(Drive(Motion.FORWARD, 1.0), PERSON)
    desk.run(1.1)
    desk.control.on_sender_token("mia", alive=False, now=desk.now)
    for other in (SCRIPT, COORDINATOR):
        assert desk.ask(FORWARD, other).reason is Reason.LEASED
    desk.run(1.8)
    assert desk.ask(SetMode(Mode.TRACKING), COORDINATOR).reason is Reason.LEASED
    assert desk.ask(Drive(Motion.LEFT, 1.0), BOB).status is QUEUED
    desk.run(3.1)
    assert desk.ask(FORWARD, COORDINATOR).status is QUEUED


def test_lease_holder_that_reconnects_keeps_lease(desk: Workbench) -> None:
    """A restart of the hub removes all tokens for a moment."""
    desk.control.on_sender_token("mia", alive=True, now=desk.now)
    desk.ask(Drive(Motion.FORWARD, 1.0), PERSON)
    desk.run(1.1)
    for alive in (False, True):
        desk.control.on_sender_token("mia", alive=alive, now=desk.now)
    assert desk.ask(FORWARD, BOB).reason is Reason.LEASED


def test_stop_of_person_ends_lease_of_coordinator(desk: Workbench) -> None:
    desk.ask(FORWARD, COORDINATOR)
    desk.ask(Stop(), PERSON)
    assert desk.control.safety.lease_at(desk.now) is None


def test_drive_release_shortens_lease(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 9.0), SCRIPT)
    desk.ask(Drive(Motion.STOP), SCRIPT)
    desk.run(2.1)
    assert desk.ask(FORWARD, Sender("other")).status is QUEUED


def test_person_outranks_script_and_loser_learns_by_whom(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT, identity="d")
    assert desk.ask(Drive(Motion.LEFT, 1.0), PERSON).status is QUEUED
    assert desk.end("d") == (SUPERSEDED, Reason.SUPERSEDED)
    assert next(record.words for record in desk.records if record.phase is SUPERSEDED) == "left by mia"
    assert desk.logs[-1].code == "lease_taken"
    assert desk.logs[-1].words == "taken over by mia (person) from script (script)", "who prints it names the car"
    assert "mia (person)" in desk.ask(FORWARD, SCRIPT).words


def test_between_persons_the_holder_keeps_it_unless_it_is_taken(desk: Workbench) -> None:
    desk.ask(FORWARD, PERSON, identity="d")
    assert "(--take)" in desk.ask(FORWARD, BOB).words
    assert desk.ask(Drive(Motion.BACK, 1.0), BOB, take=True).status is QUEUED
    assert desk.end("d") == (SUPERSEDED, Reason.SUPERSEDED)
    assert desk.ask(FORWARD, PERSON).reason is Reason.LEASED
    assert desk.ask(FORWARD, SCRIPT, take=True).reason is Reason.LEASED, "only a person may take"


@pytest.mark.parametrize("what", [TakeLease(), ChangeSpeed(SpeedStep.UP)])
def test_command_during_drive_does_not_shorten_lease(desk: Workbench, what: Action) -> None:
    desk.ask(FORWARD, PERSON)
    desk.run(0.5)
    assert desk.ask(what, PERSON).status in (SENT, QUEUED)
    desk.run(3.5)
    assert desk.ask(FORWARD, BOB).reason is Reason.LEASED, "mia drives still"


def test_taking_the_lease_alone_stops_what_the_other_drove(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT, identity="d")
    assert desk.ask(TakeLease(), PERSON).status is SENT
    assert desk.end("d") == (SUPERSEDED, Reason.SUPERSEDED)
    desk.run(3.0)
    assert desk.frames == [RUN, STOP, STOP]


def test_lease_release_frees_car_and_ends_drive(desk: Workbench) -> None:
    desk.ask(FORWARD, PERSON, identity="d")
    assert "no lease" in desk.ask(TakeLease(release=True), BOB).words
    assert desk.ask(TakeLease(release=True), PERSON).words == "red is free"
    assert desk.end("d") == (Phase.SENT, None)
    assert desk.ask(FORWARD, BOB).status is QUEUED


def test_stop_needs_no_lease_and_ends_lease(desk: Workbench) -> None:
    desk.ask(Drive(Motion.FORWARD, 9.0), PERSON)
    assert desk.ask(Stop(), SCRIPT).status is QUEUED
    desk.run(2.1)
    assert desk.ask(FORWARD, BOB).status is QUEUED


# ---------------------------------------------------------------------- streams after a stop


def test_held_stick_does_not_resume_after_stop_of_another(desk: Workbench) -> None:
    stick = Drive(Motion.FORWARD, 0.5)
    for _ in range(10):
        desk.ask(stick, SCRIPT, streamed=True)
        desk.run(0.1)
    desk.ask(Stop(), PERSON, identity="s")
    for _ in range(50):
        refused = desk.ask(stick, SCRIPT, streamed=True)
        assert (refused.reason, "was just stopped" in refused.words) == (Reason.HELD, True)
        desk.run(0.1)
    assert desk.frames == [RUN, *SHOWN_STOP]
    assert desk.control.safety.hold is not None, "what was refused ends no hold"
    rejected = [record for record in desk.records if record.phase is REJECTED]
    assert len(rejected) == 1, "one record for the whole stream"
    desk.run(0.5)
    assert desk.ask(stick, SCRIPT, streamed=True).status is QUEUED, "let go, and taken again"


def test_continues_drive_does_not_begin_one(desk: Workbench) -> None:
    held = Drive(Motion.FORWARD, 0.5, continues=True)
    assert desk.ask(held, PERSON, streamed=True).reason is Reason.LAPSED, "nothing to continue"
    desk.ask(Drive(Motion.FORWARD, 0.5), PERSON, streamed=True)
    for _ in range(20):
        desk.run(0.3)
        assert desk.ask(held, PERSON, streamed=True).status is not REJECTED
    assert set(desk.frames) == {RUN}, "prolonged by samples that come in time, and not stopped"
    for other, sender in ((Drive(Motion.BACK, 0.5, continues=True), PERSON), (held, SCRIPT)):
        assert desk.ask(other, sender, streamed=True).status is REJECTED, "another motion, or another sender"
    desk.run(2.0)  # the bus stands still
    written = list(desk.frames)
    for _ in range(20):
        assert desk.ask(held, PERSON, streamed=True).reason is Reason.LAPSED
        desk.run(0.1)
    assert RUN not in desk.frames[len(written) :]
    assert desk.ask(Drive(Motion.FORWARD, 0.5), PERSON, streamed=True).status is QUEUED, "pressed again"


def test_stick_kept_out_by_lease_does_not_drive_after_stop(desk: Workbench) -> None:
    stick = Drive(Motion.FORWARD, 0.5)
    for _ in range(10):
        desk.ask(stick, PERSON, streamed=True)
        assert desk.ask(stick, SCRIPT, streamed=True).reason is Reason.LEASED
        desk.run(0.1)
    desk.ask(Stop(), BOB)
    for _ in range(50):
        assert desk.ask(stick, SCRIPT, streamed=True).status is REJECTED
        desk.run(0.1)
    assert desk.frames == [RUN, *SHOWN_STOP]


def test_stream_that_sends_stop_may_drive_again_at_once(desk: Workbench) -> None:
    stick = Drive(Motion.FORWARD, 0.5)
    desk.ask(stick, SCRIPT, streamed=True)
    desk.ask(Stop(), SCRIPT)
    desk.run(0.1)
    assert desk.ask(stick, SCRIPT, streamed=True).reason is Reason.HELD
    desk.ask(Drive(Motion.STOP), SCRIPT, streamed=True)
    desk.run(0.1)
    assert desk.ask(Drive(Motion.FORWARD, 9.0), SCRIPT, streamed=True).status is QUEUED


def test_single_drive_after_stop_needs_no_pause(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT)
    desk.ask(Stop(), PERSON)
    desk.run(2.0)
    assert desk.ask(FORWARD, SCRIPT).status is QUEUED


def test_repeated_drives_release_first(desk: Workbench) -> None:
    for _ in range(5):
        desk.ask(Drive(Motion.FORWARD, 0.5), SCRIPT)
        desk.run(0.1)
    desk.ask(Stop(), PERSON)
    for _ in range(20):
        assert desk.ask(FORWARD, SCRIPT).reason is Reason.HELD
        desk.run(0.1)
    desk.run(0.5)
    assert desk.ask(FORWARD, SCRIPT).status is QUEUED


def test_script_may_drive_again_right_after_its_own_stop(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT)
    desk.run(0.1)
    desk.ask(Stop(), SCRIPT)
    desk.run(0.1)
    assert desk.ask(FORWARD, SCRIPT).status is QUEUED


# ---------------------------------------------------------------------- what ends no hold


def test_refused_drive_and_released_stick_end_no_hold(desk: Workbench) -> None:
    desk.ask(FORWARD, SCRIPT)
    desk.ask(Stop(), PERSON)
    desk.run(0.55)
    short = desk.ask(Drive(Motion.FORWARD, 0.1), SCRIPT, streamed=True)
    assert short.reason is Reason.EXPIRED, "the stop takes longer"
    assert desk.control.safety.hold is not None
    assert desk.control.safety.lease is None or desk.control.safety.lease.holder == SCRIPT
    desk.run(3.0)
    desk.ask(Drive(Motion.STOP), SCRIPT, streamed=True)
    desk.ask(Drive(Motion.STOP), PERSON)
    assert desk.control.safety.hold is not None
    assert desk.ask(SetMode(Mode.TRACKING), COORDINATOR).reason is Reason.HELD


def test_car_that_went_its_own_way_is_not_standing(desk: Workbench) -> None:
    for _ in range(3):
        desk.run(0.3, reports=False)
        desk.hear(TRACKING)
    assert (desk.control.driver.model.motors, desk.control.driver.model.motion) == ("unknown", None)
    assert desk.ask(Led(1, 2, 3), PERSON).reason is None, "the gateway stops it first"


def test_mode_sender_has_lease_until_mode_is_in_force(desk: Workbench) -> None:
    """A mode opens for 3.5 s, longer than a lease outlives its drive. The coordinator must not close it meanwhile."""
    desk.ask(SetMode(Mode.TRACKING), PERSON)
    desk.run(4.0, reports=False)
    assert desk.ask(SetMode(Mode.MANUAL), COORDINATOR).reason is Reason.LEASED
    desk.run(2.0, reports=False)
    assert desk.ask(SetMode(Mode.MANUAL), COORDINATOR).status is QUEUED


def test_unknown_token_that_ends_ends_the_drive() -> None:
    """The bus service merges changes of tokens. Of a token that came and went within 50 ms it reports only the end."""
    desk = Workbench().ready()
    desk.ask(Drive(Motion.FORWARD, 60.0), SCRIPT, identity="drive")
    desk.control.on_sender_token(SCRIPT.name, alive=False, now=desk.now)
    desk.run(1.5)
    assert desk.life("drive")[-1] is Phase.EXPIRED
    assert STOP in desk.frames

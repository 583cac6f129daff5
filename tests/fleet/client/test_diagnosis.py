"""Each row of the doctor's table, and its result for a car without faults."""

from typing import Any

import pytest
from msgspec.structs import replace

from fleet.client.car_state import CarState
from fleet.client.diagnosis import CHECKS, CarEvidence, as_dict, describe, describe_reports, diagnose
from gateway import drivers
from schemas.bluetooth import describe_full
from schemas.gen import fleet_v1_pb2 as pb

WELL: dict[str, Any] = {
    "state/link": pb.Link(state="online", rx_frames=500, tx_frames=20, last_rx_s=0.2),
    "state/mode": pb.Mode(asked="manual", inferred="manual", verdict="confirmed", evidence="reports come"),
    "state/motion": pb.Motion(motion="stop"),
    "state/safety": pb.Safety(motors="off", motors_basis="shown", trust="stopped"),
    "state/health": pb.Health(platform="arduino", platform_evidence=["a sonar with fractions"], uptime_s=90),
    "sensor/battery": pb.Battery(voltage_v=7.9, level="ok"),
}


def evidence(*, present: bool = True, states: dict[str, Any] = WELL, age_s: float = 0.0, **more: Any) -> CarEvidence:
    state = CarState("red", present)
    for topic, message in states.items():
        state.take(topic, message, 100.0 - age_s)
    return CarEvidence(state, 100.0, **{"recording": pb.Recording(state="recording"), **more})


def with_states(**messages: Any) -> CarEvidence:
    changed = {("sensor/battery" if name == "battery" else f"state/{name}"): each for name, each in messages.items()}
    return evidence(states=WELL | changed)


def refused(reason: str, *, phase: str = "rejected", words: str = "no", age_s: float = 3.0) -> Any:
    return age_s, pb.CommandEvent(verb="drive", sender="mia", phase=phase, reason=reason, words=words)


def process(**fields: Any) -> pb.Supervised:
    return pb.Supervised(name="red", kind="gateway", **{"state": "running", **fields})


STALE = pb.Link(state="stale", last_rx_s=12, url="tcp://x:1")
ODD: dict[str, CarEvidence] = {
    "gateway_unheard": evidence(present=False, states={}, process=process(), runs_here=True),
    "gateway_ended": evidence(present=False, states={}, process=process(state="waiting", words="exit code 1")),
    "no_gateway": evidence(present=False, states={}),
    "gateway_hung": evidence(states={}),
    "adapter_full": with_states(link=pb.Link(state="lost", reason=f"ble://x: {describe_full('hci0', 5)}", since_s=12)),
    "link_down": with_states(link=pb.Link(state="lost", reason="no such port", since_s=12)),
    "platform_contradicted": with_states(health=pb.Health(platform="stm32", platform_contradictions=["7.91 V"])),
    "not_shown": with_states(safety=pb.Safety(motors="unknown", trust="unproven")),
    "out_of_range": with_states(health=pb.Health(platform="arduino", out_of_range=["PV"])),
    "no_frames": with_states(
        link=pb.Link(state="stale", last_rx_s=12, rx_frames=40, rejects={"no_start": 40, "wrong_baud": 1})
    ),
    "no_reading": with_states(link=pb.Link(state="stale", since_s=60, last_rx_s=0.4, rx_frames=900)),
    "fan_silence": with_states(link=STALE, motion=pb.Motion(fan=True)),
    "silent": with_states(link=STALE),
    "port_shared": with_states(link=pb.Link(state="online", rx_frames=90, rejects={"port_shared": 1})),
    "damaged_frames": with_states(link=pb.Link(state="online", rx_frames=90, rejects={"truncated": 8, "noise": 3})),
    "flood": with_states(link=pb.Link(state="online", rx_frames=4206, rejects={"flood_bytes": 806360})),
    "estopped": with_states(safety=pb.Safety(motors="off", trust="stopped", estops=[pb.Estop(by="ann", why="smoke")])),
    "paused": with_states(safety=pb.Safety(motors="off", trust="stopped", pauses=[pb.Pause(by="ann", why="listen")])),
    "lent": replace(
        with_states(safety=pb.Safety(motors="off", trust="stopped", loan=pb.Loan(to="bob", by="ann"))),
        commands=[refused("lent")],
    ),
    "mode_contradicted": with_states(mode=pb.Mode(asked="tracking", inferred="manual", verdict="contradicted")),
    "battery_low": with_states(battery=pb.Battery(voltage_v=6.6, level="critical")),
    "leased": replace(
        with_states(safety=pb.Safety(motors="on", trust="driving", lease=pb.Lease(holder="jo", kind="person"))),
        commands=[refused("leased")],
    ),
    "link_breaks": with_states(link=pb.Link(state="online", rx_frames=90, reconnects=3)),
    "gateway_restarted": evidence(process=process(restarts=2, words="killed by signal 9")),
    "clock_off": evidence(process=process(), coordinated=True, clock_off_s=-240.0),
    "overloaded": with_states(health=pb.Health(platform="arduino", loop_lag_s=0.8)),
    "flooded": with_states(link=pb.Link(state="online", rx_frames=90, tx_airtime=0.95)),
    "held": with_states(safety=pb.Safety(motors="off", trust="stopped", hold=pb.Hold(by="mia"))),
    "plan_stopped": evidence(coordinated=True, assignment=pb.Assignment(stopped_by="mia")),
    "refused": evidence(commands=[refused("queue_full", words="red ignores drive commands.")]),
    "not_recorded": evidence(recording=pb.Recording(state="full", error="50 MB are free")),
    "service_missing": evidence(services={"@hub": "", "@coordinator": "it has not answered for 4 s"}),
    "recorder_drops": evidence(recording=pb.Recording(state="recording", drops={"fleet/red/sensor/line": 7})),
}


def test_healthy_car_has_no_finding() -> None:
    assert diagnose(evidence(process=process(), coordinated=True)) == []


def test_service_that_does_not_answer_is_not_called_absent() -> None:
    services = {"@recorder": "", "@coordinator": ""}
    words = dict(describe(evidence(recording=None, services=services)))["services"]
    assert words.endswith("recorder does not answer, coordinator does not answer")
    assert dict(describe(evidence(recording=None)))["services"].endswith("no recorder, no plan")


def test_recorder_that_cannot_write_is_one_finding() -> None:
    full = pb.Recording(state="failed", error="50 MB are free")
    found = diagnose(evidence(recording=full, services={"@recorder": "50 MB are free"}))
    assert [each.code for each in found] == ["not_recorded"]


def test_checks_are_all_tested() -> None:
    assert set(ODD) == {check.code for check in CHECKS}


@pytest.mark.parametrize("code", ODD)
def test_finding_has_code_cause_and_todo(code: str) -> None:
    found = diagnose(ODD[code])
    assert [each.code for each in found] == [code]
    assert found[0].of_fleet is (code in ("not_recorded", "service_missing", "recorder_drops"))
    assert found[0].cause.endswith((".", "?"))
    assert found[0].todo.startswith("fleet ")
    assert "{" not in found[0].todo


@pytest.mark.parametrize(
    ("mode", "later", "codes"),
    [
        ("tracking", [], ["refused"]),
        ("manual", [], []),
        ("tracking", [(1.0, pb.CommandEvent(verb="drive", phase="sent"))], []),
        ("tracking", [(1.0, pb.CommandEvent(verb="led", phase="sent"))], ["refused"]),
        ("tracking", [(1.0, pb.CommandEvent(verb="drive", phase="superseded"))], ["refused"]),
    ],
)
def test_past_refusal_without_cause_is_no_finding(mode: str, later: list[Any], codes: list[str]) -> None:
    now = with_states(mode=pb.Mode(asked=mode, inferred=mode, verdict="assumed"))
    assert [each.code for each in diagnose(replace(now, commands=[refused("wrong_mode"), *later]))] == codes


def test_doctor_lists_likely_cause_first_without_duplicates() -> None:
    lost = with_states(link=pb.Link(state="lost", reason="unplugged"), safety=ODD["held"].state.safety)
    found = diagnose(replace(lost, commands=[refused("link_down")]))
    assert [each.code for each in found] == ["link_down", "held"]
    other = diagnose(replace(lost, commands=[refused("battery_low")]))
    assert [each.code for each in other] == ["link_down", "held", "refused"]


def test_bytes_without_frame_are_neither_silence_nor_bad_wire() -> None:
    counts = {"no_start": 40, "no_frames": 1}
    (found,) = diagnose(with_states(link=pb.Link(state="stale", last_rx_s=1, rx_frames=40, rejects=counts)))
    assert "baud rate" in found.cause
    read = pb.Link(state="online", rx_frames=500, rejects={"wrong_baud": 1})
    assert diagnose(with_states(link=read)) == [], "it was set right: readings come"


def test_rejected_frame_counts_once() -> None:
    """The frames that came include the rejected ones. Other counts of a link are no frames."""
    (found,) = diagnose(with_states(link=pb.Link(state="online", rx_frames=40, rejects={"truncated": 10})))
    assert found.cause.startswith("10 of 40 frames ")
    assert " truncated. " in found.cause
    few = {"truncated": 9, "flood_bytes": 5000, "raw_not_published": 700, "not_obeyed": 1, "text": 90}
    others = diagnose(with_states(link=pb.Link(state="online", rx_frames=40, rejects=few)))
    assert [each.code for each in others] == ["flood"]
    over = pb.Link(state="online", rx_frames=20 * 12 - 5, rejects={"truncated": 12})
    assert [each.code for each in diagnose(with_states(link=over))] == ["damaged_frames"]
    within = pb.Link(state="online", rx_frames=20 * 12 + 1, rejects={"truncated": 12})
    assert diagnose(with_states(link=within)) == []


def test_doubted_car_is_finding_and_car_that_cannot_show_is_none() -> None:
    cannot = pb.Health(platform="arduino", shows_stops="no", shows_stops_words="red's reports do not react to frames")
    sent = pb.Safety(motors="off", motors_basis="sent", trust="stopped")
    lost = pb.Link(state="online", rx_frames=500, rejects={"not_obeyed": 4})
    cannot_show = with_states(health=cannot, safety=sent, link=lost)
    assert diagnose(cannot_show) == []
    assert "do not react" in dict(describe(cannot_show))["reports"]
    is_doubted = with_states(health=pb.Health(platform="arduino", shows_stops="yes", doubted=True))
    for evidence, ends in ((is_doubted, True), (ODD["not_shown"], False)):
        (found,) = diagnose(evidence)
        assert found.code == "not_shown"
        assert found.todo == "fleet stop red"
        assert ("`fleet resume red`" in found.cause) is ends, "only a doubt is ended by a person"
        assert "RX" not in found.cause


def test_doctor_describes_learned_report_interval() -> None:
    health = pb.Health(platform="arduino", shows_stops="yes", shows_stops_words="they show it", interval_s=1.25)
    health.blocks_s["mode_close"] = 1.0
    assert "1.25 s (spread 0.00 s, mode close +1.00 s)" in dict(describe(with_states(health=health)))["reports"]


def test_last_claims_of_gone_gateway_are_told_as_past() -> None:
    gone = evidence(present=False, age_s=40.0)
    facts = dict(describe(gone))
    assert facts["motors"].startswith("unknown: ")
    assert "off (shown" in facts["motors"]
    assert facts["motors"].endswith("40 s ago")
    assert facts["link"].startswith("no gateway")
    assert [each.code for each in diagnose(gone)] == ["no_gateway"]


def test_superseded_command_is_no_finding() -> None:
    assert diagnose(evidence(commands=[refused("superseded", phase="failed")])) == []


@pytest.mark.parametrize("code", ODD)
def test_all_that_is_known_fits_ten_lines(code: str) -> None:
    facts = dict(describe(ODD[code]))
    assert len(facts) <= 8
    assert as_dict(ODD[code])["facts"] == facts


def test_facts_have_counts_evidence_and_last_refusal() -> None:
    last = refused("held", words="red is on hold.")
    facts = dict(describe(replace(ODD["damaged_frames"], commands=[refused("leased", age_s=60), last])))
    assert "90 frames in" in facts["link"]
    assert "rejected: 3 noise, 8 truncated" in facts["link"]
    assert facts["mode"] == "manual (confirmed): reports come"
    assert facts["motors"] == "off (shown); trust stopped"
    assert facts["platform"] == "arduino, battery 7.90 V (ok): a sonar with fractions"
    assert facts["refused"].startswith("drive of mia 3 s ago: ")
    assert facts["refused"].endswith(" [held] (1 more before)")


def test_facts_of_a_car_that_shows_neither_mode_nor_platform() -> None:
    mode = pb.Mode(asked="manual", inferred="unknown", verdict="assumed", evidence="this car has one mode")
    facts = dict(describe(with_states(mode=mode, health=pb.Health(platform="tank"))))
    assert facts["mode"] == "manual (assumed): this car has one mode"
    assert "nothing was seen" not in facts["platform"], "its readings may arrive, but do not show the platform"


@pytest.mark.parametrize(("platform", "advised"), [("arduino", True), ("", True), ("ugv_rover", False)])
def test_silent_car_of_another_family_is_not_advised_as_the_first(platform: str, advised: bool) -> None:
    found = diagnose(with_states(link=STALE, health=pb.Health(platform=platform)))
    assert any("raspberry_pi+no_readings" in each.cause for each in found) is advised
    own = drivers.hint(platform, "silent")
    assert own
    assert any(each.code == "silent" and each.cause.endswith(own) for each in found)
    was_heard = diagnose(with_states(link=pb.Link(state="stale", rx_frames=7), health=pb.Health(platform=platform)))
    assert not any(own in each.cause for each in was_heard)


@pytest.mark.parametrize(("platform", "advised"), [("arduino+arm", True), ("stm32", False), ("wave_rover", False)])
def test_reports_that_show_no_stop_are_explained_by_the_family(platform: str, advised: bool) -> None:
    health = pb.Health(platform=platform, shows_stops="no", shows_stops_words="they show none")
    assert ("RX pin" in describe_reports(health)) is advised
    health.shows_stops = "yes"
    assert describe_reports(health) == "they show none"

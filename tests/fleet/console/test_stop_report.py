"""The course of a STOP, from the events and outcomes of its cars."""

from typing import Any

import pytest

from fleet.client.claims import NOT_STOPPED
from fleet.client.outcome import Outcome
from fleet.console.stop_report import StopReport
from schemas.gen import fleet_v1_pb2 as pb


def states(report: StopReport) -> dict[str, Any]:
    return {car["name"]: (car["state"], car["words"]) for car in report.as_dict()["cars"]}


def event(phase: str, verb: str = "stop", **fields: Any) -> Any:
    return pb.CommandEvent(verb=verb, phase=phase, **fields)


def test_stop_report_shows_car_by_complete_stop_only() -> None:
    report = StopReport(1, "stop", "us", ["red", "blue", "green"], 10.0, 0)
    report.on_event("red", event("sent"), 10.1)
    report.on_event("blue", event("sent", basis="sent"), 10.2)
    assert states(report) == {"red": ("stopping", ""), "blue": ("sent", ""), "green": ("asked", "")}
    assert not report.over
    report.on_event("red", event("complete", basis="shown"), 11.4)
    report.on_event("green", event("failed", words="the link broke"), 12.0)
    assert states(report)["green"] == ("failed", "the link broke")
    assert report.over
    assert report.as_dict()["cars"][2]["took_s"] == 1.4


def test_complete_stop_without_basis_is_not_shown() -> None:
    report = StopReport(1, "stop", "us", ["red", "blue"], 10.0, 0)
    report.on_event("red", event("complete"), 10.1)
    report.on_event("blue", event("sent", basis="sent", words="blue sends no readings"), 10.2)
    assert states(report) == {"red": ("sent", ""), "blue": ("sent", "blue sends no readings")}


def test_stop_report_ignores_drives_and_late_events() -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 0)
    report.on_event("red", event("complete", verb="drive"), 10.1)
    assert states(report)["red"][0] == "asked"
    report.on_event("red", event("complete", basis="shown"), 10.2)
    report.on_event("red", event("asked"), 10.3)
    assert states(report)["red"][0] == "shown"


def test_stop_report_of_car_without_outcome_is_failed() -> None:
    report = StopReport(1, "stop", "us", ["red", "blue"], 10.0, 0)
    answer = Outcome("blue", ok=False, phase="no_answer", words="its gateway went away")
    found = Outcome("green", ok=True, phase="complete", basis="shown")
    report.on_outcomes([answer, found], 15.0)
    assert states(report) == {
        "red": ("failed", "its gateway is not on the bus: look at the car"),
        "blue": ("failed", "its gateway went away"),
        "green": ("shown", ""),
    }


def claim(at_s: float, since_s: float, basis: str = "sent") -> Any:
    """Return a claim that the motors are off, stamped at `at_s` by the clock of its gateway, and so for `since_s`."""
    found = pb.Safety(motors="off", motors_basis=basis, trust_since_s=since_s)
    found.stamp.FromNanoseconds(int(at_s * 1e9))
    return found


def test_stop_report_is_shown_by_later_safety_state() -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 50_000)
    report.on_safety("red", claim(50.1, 0.0, "shown"), 10.1)
    assert states(report)["red"][0] == "asked", "the state may be older than the stop"
    report.on_outcomes([], 12.0)
    report.on_safety("red", pb.Safety(motors="on"), 13.0)
    assert states(report)["red"][0] == "failed"
    report.on_safety("red", claim(54.0, 0.5, "shown"), 14.0)
    assert states(report)["red"][0] == "shown"


@pytest.mark.parametrize(
    "old",
    [
        claim(54.0, 30.0),  # off since long before
        claim(49.0, 0.5),  # handed over late, by a bus that hung
        claim(64.0, 4.5),  # by a clock that is ahead
        pb.Safety(motors="off", motors_basis="sent"),  # nobody knows since when
    ],
)
def test_older_claim_is_no_result_of_undelivered_stop(old: Any) -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 50_000)
    report.on_outcomes([], 12.0)
    report.on_safety("red", old, 14.0)
    assert states(report)["red"][0] == "failed"


def test_stop_report_counts_events_of_own_command_only() -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 50_000)
    report.command_id = "this"
    report.on_event("red", event("complete", id="other", basis="shown"), 10.5)
    assert states(report)["red"][0] == "asked"
    report.on_outcomes([], 12.0)
    report.on_event("red", event("complete", id="other", basis="shown"), 12.5)
    assert states(report)["red"][0] == "failed"
    report.on_event("red", event("complete", id="this", basis="shown"), 13.0)
    assert states(report)["red"][0] == "shown"


@pytest.mark.parametrize(("lost_bus", "begins"), [(True, NOT_STOPPED), (False, "its gateway is not on the bus")])
def test_untaken_stop_says_whether_bus_was_lost(lost_bus: bool, begins: str) -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 0)
    report.on_outcomes([], 12.0, lost_bus=lost_bus)
    assert states(report)["red"][1].startswith(begins)


def safety(motors: str, at_s: int, basis: str = "") -> Any:
    found = pb.Safety(motors=motors, motors_basis=basis)
    found.stamp.seconds = at_s
    return found


@pytest.mark.parametrize("basis", ["shown", "sent"])
def test_car_that_moves_again_is_not_standing_and_keeps_time(basis: str) -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 1_000_000)
    done = event("complete", basis=basis)
    done.stamp.seconds = 50
    report.on_event("red", done, 11.5)
    report.on_safety("red", safety("on", 49), 11.6)
    assert states(report)["red"][0] == basis, "this state is older than the stop"
    report.on_safety("red", safety("off", 51, basis), 11.7)
    report.on_safety("red", safety("unknown", 52), 11.8)
    assert states(report)["red"][0] == basis
    report.on_safety("red", safety("on", 53), 30.0)
    (car,) = report.as_dict()["cars"]
    assert (car["state"], car["at_ms"], car["moved_at_ms"], car["took_s"]) == ("moved", 1_001_500, 1_020_000, 1.5)
    assert report.over


def moved(*cars: str) -> StopReport:
    """Return a report of cars of which the first one moves again since 53."""
    report = StopReport(1, "stop", "us", cars, 10.0, 0)
    for name in cars:
        done = event("complete", basis="shown")
        done.stamp.seconds = 50
        report.on_event(name, done, 11.5)
    report.on_safety(cars[0], safety("on", 53), 30.0)
    return report


@pytest.mark.parametrize("motors", ["off", "stopping", "unknown"])
def test_row_of_moved_car_closes_when_it_stands(motors: str) -> None:
    report = moved("red", "blue")
    report.on_safety("red", safety(motors, 52), 30.1)
    report.on_safety("red", safety("on", 54), 31.0)
    assert states(report) == {"red": ("moved", ""), "blue": ("shown", "")}, "that state is older than the motion"
    report.on_safety("red", safety(motors, 55), 32.0)
    assert states(report) == {"blue": ("shown", "")}
    assert report.as_dict()["closed"] == 1
    again = event("complete", basis="shown")
    again.stamp.seconds = 56
    report.on_event("red", again, 33.0)  # another stop of the same person: of red alone
    report.on_outcomes([Outcome("red", ok=True, phase="complete", basis="shown")], 34.0)
    assert states(report) == {"blue": ("shown", "")}


def test_moved_car_with_lost_gateway_does_not_move_for_ever() -> None:
    report = moved("red", "blue")
    report.on_presence(["red"])
    assert states(report) == {"red": ("moved", ""), "blue": ("shown", "")}, "that blue stood stays true"
    report.on_presence([])
    assert states(report) == {"blue": ("shown", "")}


def test_outcome_without_event_is_as_new_as_last_state() -> None:
    report = StopReport(1, "stop", "us", ["red"], 10.0, 0)
    report.on_safety("red", safety("stopping", 60), 10.1)
    report.on_outcomes([Outcome("red", ok=True, phase="complete", basis="shown")], 11.0)
    report.on_safety("red", safety("on", 60), 11.1)
    assert states(report)["red"][0] == "shown"
    report.on_safety("red", safety("on", 61), 11.2)
    assert states(report)["red"][0] == "moved"

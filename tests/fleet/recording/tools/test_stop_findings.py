"""Which stops of a session were not shown: car, time and cause, each once."""

from collections.abc import Iterator

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.recording.tools.stop_findings import StopFindings
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.zones import zone

NOON = 1_795_608_000  # 2026-11-25 12:00 UTC
NOT_REACTED = "NOT CONFIRMED: red has not reacted to the stop yet. Look at the car. The gateway keeps stopping it."


@pytest.fixture(autouse=True)
def _in_berlin() -> Iterator[None]:
    with zone("CET-1"):
        yield


def failed(at_s: int, verb: str = "stop", reason: str = "not_shown", words: str = NOT_REACTED) -> pb.CommandEvent:
    return pb.CommandEvent(
        car="red", verb=verb, sender="mia", phase="failed", reason=reason, words=words, stamp=Timestamp(seconds=at_s)
    )


def logged(at_s: int, code: str, words: str = NOT_REACTED) -> Log:
    return Log(name=f"red {code}", message=words, timestamp=Timestamp(seconds=at_s))


def test_stop_finding_has_car_time_person_cause_once() -> None:
    found = StopFindings()
    found.add("red", "state/link", pb.Link(state="lost", reason="unplugged"))
    found.add("red", "state/health", pb.Health(shows_stops="yes", doubted=True, shows_stops_words="red is in doubt"))
    found.add("red", "event/command", failed(NOON))
    found.add("red", "event/log", logged(NOON + 1, "not_shown"))
    found.add("red", "event/command", pb.CommandEvent(verb="drive", phase="failed", reason="link_down"))
    (stop,) = found.stops
    assert (stop.car, stop.code, stop.asked) == ("red", "not_shown", "stop by mia")
    assert stop.cause == "its link was lost (unplugged), red is in doubt"
    assert stop.as_dict()["at"] == "13:00:00 CET"
    assert "red at 13:00:00 CET" in stop.describe()


def test_log_alone_is_enough_and_not_stopped_weighs_more() -> None:
    found = StopFindings()
    found.add(
        "red", "event/log", logged(NOON, "not_stopped", "red may still be moving: red has not reacted to the stop.")
    )
    found.add("red", "event/command", failed(NOON, words="has not reacted to the stop"))
    (stop,) = found.stops
    assert (stop.code, stop.asked, stop.cause) == ("not_stopped", "stop by mia", "")


def test_two_stops_are_two() -> None:
    found = StopFindings()
    found.add("red", "event/command", failed(NOON))
    found.add("red", "event/command", failed(NOON + 60))
    found.add("blue", "event/command", failed(NOON + 60))
    found.add("red", "event/command", failed(NOON + 61, verb="estop", reason="link_down", words="red is unreachable"))
    assert [(each.car, each.code) for each in found.stops] == [
        ("red", "not_shown"),
        ("red", "not_shown"),
        ("blue", "not_shown"),
        ("red", "not_stopped"),
    ]
    assert len(found.of("not_stopped")) == 1


def test_stop_that_ended_as_sent_is_no_finding() -> None:
    found = StopFindings()
    found.add("red", "event/command", pb.CommandEvent(verb="stop", phase="sent", basis="sent"))
    found.add("red", "event/command", pb.CommandEvent(verb="stop", phase="complete", basis="shown"))
    assert found.stops == []

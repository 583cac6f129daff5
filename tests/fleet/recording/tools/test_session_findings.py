"""The figures of `fleet doctor SESSION`, and its findings about a damaged session."""

from typing import Any

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from fleet.recording.tools.session_findings import SessionCheckup
from fleet.recording.tools.verify import Clock, SessionVerdict
from schemas.gen import fleet_v1_pb2 as pb


def log(code: str) -> Log:
    return Log(name=f"red {code}", message="red has not reacted to the stop")


def event(**fields: Any) -> pb.CommandEvent:
    return pb.CommandEvent(car="red", **fields)


@pytest.mark.parametrize(
    ("code", "messages", "verdict"),
    [
        ("not_stopped", [log("not_stopped")], {}),
        ("not_shown", [log("not_shown")], {}),
        ("damage", [], {"damage": {"0001.mcap": "is cut"}}),
        ("not_closed", [], {"closed": False, "ended": "the recorder did not close it"}),
        ("recorder_drops", [], {"dropped": {"fleet/red/sensor/line": 4}}),
        ("gaps", [], {"missing": [{"key": "fleet/red/sensor/line", "count": 3}]}),
        ("gaps", [], {"missed": {"fleet/red/sensor/line": 3}}),
        ("link_breaks", [log("link_lost"), log("link_lost")], {}),
        ("refused", [event(verb="drive", phase="rejected", reason="held")], {}),
        ("not_shown", [event(verb="stop", phase="failed", reason="not_shown")], {}),
        ("not_stopped", [event(verb="estop", phase="rejected", reason="link_down")], {}),
    ],
)
def test_each_condition_has_its_finding(code: str, messages: list[Any], verdict: dict[str, Any]) -> None:
    checkup = SessionCheckup()
    for message in messages:
        checkup.add("red", "event/log" if isinstance(message, Log) else "event/command", message, 0)
    found = list(checkup.findings(SessionVerdict("sessions/a", **verdict), "a"))
    assert [each.code for each in found] == [code]
    assert found[0].todo.startswith("fleet ")
    assert found[0].todo.endswith(" a")


def test_stops_are_counted_by_what_they_rest_on() -> None:
    checkup = SessionCheckup()
    for fields in (
        {"verb": "stop", "phase": "asked"},
        {"verb": "stop", "phase": "complete", "basis": "shown"},
        {"verb": "estop", "phase": "sent", "basis": "sent"},
        {"verb": "stop", "phase": "failed", "reason": "not_shown"},
        {"verb": "drive", "phase": "complete", "basis": ""},
    ):
        checkup.add("red", "event/command", event(**fields), 0)
    facts = dict(checkup.facts(SessionVerdict("a", messages=5, clocks={"red": Clock(0, 0, backwards=2)})))
    assert facts["stops"] == "1 shown, 1 sent, 1 failed"
    assert facts["clock steps"] == "2"
    assert facts["state"] == "whole, 5 messages"
    assert list(SessionCheckup().findings(SessionVerdict("a"), "a")) == []

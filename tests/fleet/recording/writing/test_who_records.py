"""Who starts and stops the recorder: leads, where the fleet has people, by the same rule as the plan."""

from collections.abc import Callable
from pathlib import Path

import pytest

from fleet.client.services import ask_recorder
from fleet.recording.writing.recorder import Recorder
from schemas import keys
from schemas.bus import Bus, Failure
from schemas.gen import fleet_v1_pb2 as pb
from schemas.identity import Service as IdentifiedService
from schemas.identity import car, person, service
from schemas.rights import NO_PEOPLE, People
from schemas.topics import TOPICS
from schemas.words import RecorderVerb

TABLE = People.parse(["ann:lead", "mia"])


def refusals(
    endpoint: str, place: Path, people: Callable[[], People | None], identity: str, **fields: str
) -> list[str]:
    """Return what the recorder says to each verb; empty: it obeys. identity: in the key, as the rules prove it."""
    with Bus.open(endpoint) as own, Bus.open(endpoint) as asker:
        recorder = Recorder(own, "fleet", place, people=people)
        recorder.start()
        asker.identity = identity
        said = []
        for verb, more in (
            (RecorderVerb.MARK, {"text": "here", "by": "mia"}),
            (RecorderVerb.STATUS, {}),
            (RecorderVerb.STOP, {}),
            (RecorderVerb.START, {}),
        ):
            answer = ask_recorder(asker, "fleet", verb, **fields, **more)
            assert answer is not None
            said.append(answer.words if isinstance(answer, Failure) else "")
        recorder.close()
    return said


@pytest.mark.parametrize(
    ("identity", "sender", "obeyed"),
    [
        (person("ann"), "ann@laptop-1", True),
        (person("ann"), "", True),
        (person("mia"), "mia@laptop-1", False),
        (person("mia"), "ann@laptop-1", False),
        (person("eve"), "", False),
        (car("red"), "", False),
        (service(IdentifiedService.CONSOLE), "ann", True),
        (service(IdentifiedService.CONSOLE), "mia", False),
        ("", "ann@laptop-1", True),
        ("", "mia@laptop-1", False),
        ("", "", False),
    ],
)
def test_only_a_lead_starts_and_stops_where_there_is_one(
    endpoint: str, tmp_path: Path, identity: str, sender: str, obeyed: bool
) -> None:
    mark, status, stop, start = refusals(endpoint, tmp_path, lambda: TABLE, identity, sender=sender)
    assert (mark, status) == ("", ""), "everybody marks, and sees"
    assert (stop == "") is obeyed, stop
    if not obeyed:
        assert stop
        assert "is recorded already" not in start


@pytest.mark.parametrize("identity", ["", person("eve"), car("red")])
def test_without_people_everyone_may(endpoint: str, tmp_path: Path, identity: str) -> None:
    assert refusals(endpoint, tmp_path, lambda: NO_PEOPLE, identity) == ["", "", "", ""]
    assert refusals(endpoint, tmp_path, lambda: None, identity) == ["", "", "", ""], "nor does a gateway know any"


def test_without_a_fleet_file_the_gateways_say_who_is_a_lead(endpoint: str, tmp_path: Path) -> None:
    safety = pb.Safety(car="red")
    TABLE.fill(safety.people)
    key = keys.topic_key("fleet", "red", "state/safety")
    with Bus.open(endpoint) as red:
        encoding = TOPICS["state/safety"].encoding
        red.queryable(key, lambda query: _reply(query, key, safety.SerializeToString(), encoding))
        _, _, stop, _ = refusals(endpoint, tmp_path, lambda: None, person("mia"))
        assert stop
        assert refusals(endpoint, tmp_path, lambda: None, person("ann")) == ["", "", "", ""]


def _reply(query: object, key: str, payload: bytes, encoding: str) -> None:
    with query:  # type: ignore[attr-defined]
        query.reply(key, payload, encoding=encoding)  # type: ignore[attr-defined]

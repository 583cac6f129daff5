"""How many commands of a session stopped cars: pure, in session.json, and from files without that number."""

import itertools
import json
from pathlib import Path

import pytest
import zenoh
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from fleet.recording import session_dir
from fleet.recording.stop_count import MAX_RECENT_IDS, StopCount
from fleet.recording.tools.stop_findings import failed_stop_code
from fleet.recording.tools.summary import SessionState, overview
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import PROTOBUF
from tests.support import in_process

NOW = 1_790_000_000_000_000_000
PHASES = ("asked", "queued", "sent", "complete")


def event(verb: str, command: str, phase: str = "asked") -> pb.CommandEvent:
    return pb.CommandEvent(verb=verb, id=command, phase=phase)


def test_stop_of_several_cars_counts_once() -> None:
    found = StopCount()
    for verb, command, phase in itertools.product(("stop", "drive", "resume", "mode"), ("a", "b"), PHASES):
        found.add(event(verb, f"{verb} {command}", phase))
    assert found.count == 2
    found.add(event("estop", "estop"))
    assert found.count == 3
    found.add(event("pause", "pause"))
    assert found.count == 3, "it may be refused"
    found.add(event("pause", "pause", "queued"))
    assert found.count == 4
    found.add(pb.Range(range_m=1.0))
    assert found.count == 4


def test_refused_pause_is_no_stop() -> None:
    found = StopCount()
    for phase in ("asked", "rejected"):
        found.add(pb.CommandEvent(verb="pause", id="a", phase=phase, reason="not_allowed" if phase != "asked" else ""))
    assert found.count == 0
    refused = pb.CommandEvent(verb="pause", id="a", phase="rejected", reason="not_allowed", words="no lead")
    assert failed_stop_code("event/command", refused) == ""
    cut = pb.CommandEvent(verb="pause", id="b", phase="rejected", reason="link_down")
    found.add(cut)
    assert (found.count, failed_stop_code("event/command", cut)) == (1, "not_stopped")


def test_without_an_id_each_asked_one_counts() -> None:
    found = StopCount()
    for phase in PHASES * 2:
        found.add(event("stop", "", phase))
    assert found.count == 2


def test_flood_takes_no_memory() -> None:
    found = StopCount()
    for number in range(3 * MAX_RECENT_IDS):
        found.add(event("stop", str(number)))
    assert found.count == 3 * MAX_RECENT_IDS
    assert len(found._recent) == MAX_RECENT_IDS


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Record two stops of both cars, one of blue alone, one drive, and what is no event, and close the session."""
    writer = SessionWriter(tmp_path, "fleet", Options(), NOW)
    encoding = zenoh.Encoding(f"{PROTOBUF};fleet.v1.CommandEvent")
    commands = (("stop", "1"), ("estop", "2"), ("drive", "3"))
    for at, (car, (verb, command), phase) in enumerate(itertools.product(("red", "blue"), commands, PHASES)):
        payload = event(verb, command, phase).SerializeToString()
        writer.add(f"fleet/{car}/event/command", payload, encoding, None, None, NOW + at)
    writer.add(
        "fleet/blue/event/command", event("pause", "4", "queued").SerializeToString(), encoding, None, None, NOW + 99
    )
    writer.add("fleet/red/event/command", b"\xff\xff", encoding, None, None, NOW + 100)
    writer.add("fleet/red/event/command", b"no event", zenoh.Encoding("text/plain"), None, None, NOW + 101)
    writer.tick(NOW + 200)
    writer.close(NOW + 300)
    return writer.path


def listed(path: Path) -> dict[str, object]:
    done = in_process.fleet("sessions", path.parent, "--json")
    found: dict[str, object] = json.loads(done.stdout)
    return found


def test_recorder_notes_the_number_of_stops(recorded: Path) -> None:
    description = session_dir.SessionInfo.read(recorded)
    assert description is not None
    assert description.stops == 3
    assert listed(recorded)["stops"] == 3
    assert "stops: 3" in in_process.fleet("sessions", "info", recorded).stdout
    out = recorded.parent / "part"
    assert in_process.fleet("sessions", "cut", recorded, "--car", "red", "--to", "1s", "--out", out).returncode == 0
    assert overview(out).stops == 2


@pytest.mark.parametrize("description", [{"stops": None, "closed": True}, {"stops": 7, "closed": False}])
def test_where_the_number_is_not_known_the_events_are_counted(recorded: Path, description: dict[str, object]) -> None:
    path = recorded / session_dir.SESSION_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), **description}))
    assert listed(recorded)["stops"] == 3


def test_file_without_an_end_has_its_stops(recorded: Path) -> None:
    (recorded / session_dir.SESSION_FILE).unlink()
    segment = recorded / "0001.mcap"
    segment.write_bytes(segment.read_bytes()[:-100])
    about = listed(recorded)
    assert (about["state"], about["stops"]) == (SessionState.CUT, 3)


def test_unreadable_session_has_no_number(recorded: Path) -> None:
    (recorded / "0001.mcap").write_bytes(b"no MCAP")
    assert listed(recorded)["stops"] is None
    assert " -  " in in_process.fleet("sessions", recorded.parent).stdout


def test_stop_count_survives_foreign_schema() -> None:
    file = FileDescriptorProto(name="other.proto", package="fleet.v1", syntax="proto3")
    field = file.message_type.add(name="CommandEvent").field.add(name="verb", number=1)
    field.type, field.label = FieldDescriptorProto.TYPE_INT32, FieldDescriptorProto.LABEL_OPTIONAL
    pool = DescriptorPool()
    pool.Add(file)
    found = StopCount()
    found.add(GetMessageClass(pool.FindMessageTypeByName("fleet.v1.CommandEvent"))(verb=3))
    assert found.count == 0

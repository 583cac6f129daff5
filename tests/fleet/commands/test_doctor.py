"""The command `fleet doctor` on real gateways and on a real recording."""

import json
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.recording.writing.segment_writer import Segment
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.conftest import Cars
from tests.fleet.recording.damaged import written
from tests.fleet.recording.tools.test_sessions_command import describe
from tests.support import in_process
from tests.support.zones import zone


def doctor(cars: Cars, *arguments: str) -> CompletedProcess[str]:
    return in_process.fleet("doctor", *arguments, "--connect", cars.endpoint, cwd=cars.directory)


def test_car_has_its_likely_cause_and_ten_lines(cars: Cars) -> None:
    well = doctor(cars, "green")
    assert well.returncode == 0, well.stdout
    assert well.stdout.splitlines()[0].startswith("green: ")
    cars.ask("stop", "red", sender="mia", kind="person")
    cars.ready()
    assert cars.ask("drive", "red", sender="plan", kind="coordinator", motion="forward")["reason"] == "held"
    held = doctor(cars, "red")
    lines = held.stdout.splitlines()
    assert held.returncode == 1
    assert lines[0].startswith("red: On hold: mia ")
    assert lines[0].endswith(f"Type: fleet resume red --connect {cars.endpoint}")
    assert len(lines) <= 10
    assert any(line.startswith("  refused") and "[held]" in line for line in lines), held.stdout
    every = doctor(cars)
    assert [line.partition(":")[0] for line in every.stdout.splitlines()] == ["blue", "green", "red"]
    told = json.loads(doctor(cars, "red", "--json").stdout)
    assert [each["code"] for each in told["findings"]] == ["held"]
    assert "frames in" in told["facts"]["link"]
    cars.ask("resume", "red", sender="mia", kind="person")
    unknown = doctor(cars, "rde")
    assert unknown.returncode == 1
    assert unknown.stderr.startswith("fleet: ")
    assert unknown.stderr.endswith(" mean red?\n")


def test_damaged_session_has_its_findings(tmp_path: Path) -> None:
    session = tmp_path / "sessions" / "20260921T141320Z-fleet"
    session.mkdir(parents=True)
    data = written(session / "0001.mcap").data
    describe(session, closed=True)
    well = in_process.fleet("doctor", "latest", cwd=tmp_path)
    assert well.returncode == 0, well.stdout
    (session / "0001.mcap").write_bytes(data[: len(data) // 2])
    done = in_process.fleet("doctor", "latest", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stdout.splitlines()[0].startswith(f"{session.name}: Damaged: 0001.mcap ")
    assert f"fleet sessions recover {session.name}" in done.stdout
    told = json.loads(in_process.fleet("doctor", session, "--json", cwd=tmp_path).stdout)
    assert "damage" in [each["code"] for each in told["findings"]]


NOON = 1_795_608_000  # 2026-11-25 12:00 UTC
WORDS = "NOT CONFIRMED: red has not reacted to the stop yet. Look at the car. The gateway keeps stopping it."
MOVING = "red may still be moving: red has not reacted to the stop. Look at the car."


class _Recording:
    """A segment that is written message by message."""

    def __init__(self, path: Path) -> None:
        self.segment = Segment(path, {"fleet": "fleet"})
        self._channels: dict[str, int] = {}

    def say(self, key: str, message: Any, at_s: float, received_s: float | None = None) -> None:
        name = message.DESCRIPTOR.full_name
        stamp = Timestamp(seconds=int(at_s), nanos=round(at_s % 1 * 1e9))
        (message.timestamp if name == "foxglove.Log" else message.stamp).CopyFrom(stamp)
        if key not in self._channels:
            self._channels[key] = self.segment.channel(key, messages.encoding_of(name))
        at_ns, received_ns = round(at_s * 1e9), round((at_s if received_s is None else received_s) * 1e9)
        self.segment.add(self._channels[key], received_ns, message.SerializeToString(), at_ns, 0)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Record a session: red did not show a stop and was not stopped at the end, blue could not be reached."""
    path = tmp_path / "sessions" / "20261125T120000Z-fleet"
    path.mkdir(parents=True)
    recording = _Recording(path / "0001.mcap")

    def event(car: str, at_s: float, **fields: Any) -> None:
        recording.say(f"fleet/{car}/event/command", pb.CommandEvent(car=car, **fields), at_s)

    for second in range(120):
        recording.say("fleet/red/state/link", pb.Link(car="red", state="online"), NOON + second)
        motors = pb.Safety(car="red", motors="on" if second < 60 else "unknown", trust="driving")
        recording.say("fleet/red/state/safety", motors, NOON + second)
    doubt = "red has shown its stops before, and did not show the last one"
    recording.say("fleet/red/state/health", pb.Health(shows_stops="yes", doubted=True, shows_stops_words=doubt), NOON)
    event("red", NOON + 60, id="a", verb="stop", sender="mia", phase="queued")
    event("red", NOON + 73, id="a", verb="stop", sender="mia", phase="failed", reason="not_shown", words=WORDS)
    recording.say("fleet/red/event/log", Log(name="red not_shown", message=WORDS), NOON + 73.1)
    event(
        "blue",
        NOON + 80,
        id="b",
        verb="estop",
        sender="bob",
        phase="rejected",
        reason="link_down",
        words="NOT STOPPED: x",
    )
    for at_s in (110.0, 118.0):
        recording.say("fleet/red/event/log", Log(name="red not_stopped", message=MOVING), NOON + at_s)
    recording.segment.finish({})
    describe(path, closed=True)
    return path


def berlin(directory: Path, *arguments: str) -> CompletedProcess[str]:
    with zone("CET-1"):
        return in_process.fleet(*arguments, cwd=directory)


def test_doctor_of_session_names_car_time_and_cause_of_stops(session: Path, tmp_path: Path) -> None:
    told = json.loads(berlin(tmp_path, "doctor", "latest", "--json").stdout)
    assert [(each["car"], each["code"], each["at"]) for each in told["stops"]] == [
        ("red", "not_shown", "13:01:13 CET"),
        ("blue", "not_stopped", "13:01:20 CET"),
        ("red", "not_stopped", "13:01:50 CET"),
        ("red", "not_stopped", "13:01:58 CET"),
    ]
    assert told["stops"][0]["asked"] == "stop by mia"
    assert "the last one" in told["stops"][0]["cause"]
    codes = [each["code"] for each in told["findings"]]
    assert codes[:2] == ["not_stopped", "not_shown"]
    assert "refused" not in codes, "each of them is named above"
    done = berlin(tmp_path, "doctor", session.name, "red")
    assert done.returncode == 1
    assert "red at 13:01:13 CET" in done.stdout
    assert "blue" not in done.stdout
    assert f"--at 13:01:50 --session {session.name}" in done.stdout.splitlines()[0]
    unknown = berlin(tmp_path, "doctor", "latest", "rde")
    assert (unknown.returncode, " mean red?" in unknown.stderr) == (1, True)


def test_why_did_red_not_stop_at_that_time(session: Path, tmp_path: Path) -> None:
    done = berlin(tmp_path, "why", "red", "--session", session.name, "--at", "13:01")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("red at 13:01:13 CET: ")
    assert "by mia" in lines[0]
    assert ": NOT CONFIRMED" in lines[0]
    assert any(line.startswith("  13:01:00 CET  motors unknown") for line in lines)
    assert any("link online" in line for line in lines)
    told = json.loads(berlin(tmp_path, "why", "red", "--session", "latest", "--at", "13:01:13", "--json").stdout)
    assert [each["code"] for each in told["stops"]] == ["not_shown"]
    early = berlin(tmp_path, "why", "red", "--session", "latest", "--at", "13:00:05")
    assert early.stdout.splitlines()[0].startswith("red: no stop ")
    assert "2026-11-25 13:00:05 CET" in early.stdout.splitlines()[0]


def test_why_tells_backfilled_messages_in_their_order(tmp_path: Path) -> None:
    """A recorder writes messages that it has missed, as during a restart of the hub, when it receives them."""
    path = tmp_path / "sessions" / "20261125T120000Z-lab"
    path.mkdir(parents=True)
    recording = _Recording(path / "0001.mcap")

    def say(motors: str, at_s: float, received_s: float | None = None) -> None:
        recording.say("fleet/red/state/safety", pb.Safety(car="red", motors=motors), at_s, received_s)

    for second in range(10):
        say("off" if second < 8 else "on", NOON + second)
    say("stopping", NOON + 12)
    say("on", NOON + 10, NOON + 13)
    say("on", NOON + 11, NOON + 13)
    say("off", NOON + 14)
    recording.segment.finish({})
    describe(path, closed=True)
    entries = json.loads(berlin(tmp_path, "why", "red", "--session", "latest", "--at", "10s", "--json").stdout)[
        "entries"
    ]
    assert [each["words"] for each in entries] == ["motors off", "motors on", "motors stopping", "motors off"]
    assert [each["at"] for each in entries] == [f"13:00:{second} CET" for second in ("00", "08", "12", "14")]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("why", "red", "--at", "13:01"), 2),
        (("why", "--session", "latest", "--at", "13:01"), 2),
        (("why", "red", "--session", "latest", "--at", "9:00"), 2),
        (("why", "red", "--session", "latest", "--at", "soon"), 2),
        (("why", "rde", "--session", "latest", "--at", "13:01"), 1),
        (("doctor", "red", "blue"), 2),
    ],
)
@pytest.mark.usefixtures("session")
def test_doctor_wrong_arguments_exit_codes(tmp_path: Path, arguments: tuple[str, ...], code: int) -> None:
    assert berlin(tmp_path, *arguments).returncode == code

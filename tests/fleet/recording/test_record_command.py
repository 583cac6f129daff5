"""`fleet record` as a process."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet.recording.reading.session import Session
from fleet.recording.session_dir import SESSION_FILE
from fleet.recording.time_spec import iso_ns
from schemas import keys
from schemas.bus import Bus
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import PinCause
from tests.fleet.recording.conftest import heard, popen, publisher
from tests.support import in_process
from tests.support.processes import wait_for
from tests.support.text_parts import has_parts

RECORD = "from fleet.commands.record import record; record()"


def start(code: str, *arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", code, *arguments]
    return popen(command)


def ready(process: "subprocess.Popen[str]") -> Path:
    assert process.stdout is not None
    return Path(json.loads(process.stdout.readline())["session"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_closes_the_session_whole(number: signal.Signals, endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = start(RECORD, "--sessions", str(tmp_path), "--connect", endpoint, "--json")
    session = ready(process)
    out = publisher(bus, "red", "sensor/range")
    for _ in range(100):
        out.put(pb.Range(range_m=1.0), time.time_ns())
    heard(bus._session)
    process.send_signal(number)
    text, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    end = json.loads(text)
    assert end["state"] == "closed"
    assert end["drops"] == end["missed"] == {}
    opened = Session(session)
    numbers = [message.sequence for message in opened.messages() if message.key == out.key]
    assert numbers == list(range(1, 101))
    opened.check()
    assert not opened.damage
    assert opened.description is not None
    assert opened.description.closed


def test_nobody_reads_it_and_it_ends_with_a_closed_session(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    nobody, stdout = os.pipe()
    os.close(nobody)
    arguments = ("--sessions", str(tmp_path), "--connect", endpoint)
    with subprocess.Popen([sys.executable, "-c", RECORD, *arguments], stdout=stdout, stderr=subprocess.PIPE) as process:
        os.close(stdout)
        try:
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, errors) == (1, b""), "no other place was wrong"
    description = Session(next(tmp_path.glob("*-fleet"))).description
    assert description is not None
    assert description.closed


def test_killed_it_loses_at_most_the_last_second(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    """Time of each status, and its number of messages."""
    bus.subscribe(
        "fleet/@recorder/status",
        lambda sample: told.append((sample.time_ns, sample.message().messages)),  # type: ignore[attr-defined]
    )
    process = start(RECORD, "--sessions", str(tmp_path), "--connect", endpoint, "--json")
    session = ready(process)
    out = publisher(bus, "red", "sensor/range")

    def told_often() -> bool:
        out.put(pb.Range(range_m=1.0), time.time_ns())
        return len(told) > 4

    wait_for(told_often, "it says how many it has")
    process.kill()
    process.communicate(timeout=60)
    opened = Session(session)
    rows = list(opened.messages())
    numbers = [message.sequence for message in rows if message.key == out.key]
    assert numbers == list(range(1, len(numbers) + 1))
    # The session has all messages that the status counted. A status comes each second, or sooner after a delayed one.
    times, counts = zip(*told, strict=True)
    assert len(rows) >= counts[-1] > counts[0]
    assert min(after - before for before, after in pairwise(times)) < 1.2e9
    assert "is cut" in opened.damage_words
    assert opened.description is not None
    assert not opened.description.closed


def test_full_disk_is_said_and_what_was_written_stays(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    states: list[str] = []
    bus.subscribe("fleet/@recorder/status", lambda sample: states.append(sample.message().state))  # type: ignore[attr-defined]
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000)); " + RECORD
    process = start(limit, "--sessions", str(tmp_path), "--connect", endpoint, "--json")
    session = ready(process)
    out = publisher(bus, "red", "frame/rx")
    while process.poll() is None:
        out.put(pb.RxFrame(data=os.urandom(200)), time.time_ns())
        time.sleep(0.002)
    text, errors = process.communicate(timeout=60)
    assert (process.returncode, text) == (1, "")
    (line,) = errors.splitlines()
    assert str(session) in line
    assert "File too large" in line
    wait_for(lambda: "failed" in states, "that on the bus")
    opened = Session(session)
    numbers = [message.sequence for message in opened.messages() if message.key == out.key]
    assert len(numbers) > 50
    assert numbers == list(range(1, len(numbers) + 1))
    assert opened.description is not None
    assert "File too large" in opened.description.error


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--fleet", "No Good"], 2, "fleet name 'No Good' is not allowed"),
        (["--connect", "nonsense"], 2, "endpoint 'nonsense' is not allowed"),
        (["--sessions", "/dev/null/x"], 1, "/dev/null/x"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], code: int, words: str, endpoint: str, tmp_path: Path) -> None:
    given = ["--connect", endpoint, "--sessions", str(tmp_path)]
    process = start(RECORD, *given, *arguments)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert words in errors
    assert "Traceback" not in errors


def test_fleet_file_condition_pins_while_recording(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    rules = tmp_path / "fleet.yaml"
    rules.write_text(
        "cars: {red: {link: sim, platform: arduino}}\n"
        "pin: [{when: range_m < 0.1, before: 20s, after: 10s}, {when: \"mode.verdict == 'contradicted'\"}]\n"
    )
    place = tmp_path / "sessions"
    process = start(RECORD, "--sessions", str(place), "--connect", endpoint, "--json", "--fleet-file", str(rules))
    session = ready(process)

    def pins() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads((session / SESSION_FILE).read_text())["pins"]
        return found

    distance, mode = publisher(bus, "red", "sensor/range"), publisher(bus, "red", "state/mode")
    distance.put(pb.Range(range_m=1.0), time.time_ns())
    mode.put(pb.Mode(asked="tracking", verdict="confirmed"), time.time_ns())
    heard(bus._session)
    assert pins() == []
    before_ns = time.time_ns()
    distance.put(pb.Range(range_m=0.05), before_ns)
    wait_for(pins, "the pin, while it records")
    after_ns = time.time_ns()
    mode.put(pb.Mode(asked="tracking", verdict="contradicted"), time.time_ns())
    wait_for(lambda: len(pins()) == 2, "the pin of the other condition")
    heard(bus._session)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    near, other = pins()
    assert (near["cause"], near["words"], near["cars"]) == (PinCause.CONDITION, "range_m < 0.1", ["red"])
    assert (other["cause"], other["cars"]) == (PinCause.CONDITION, ["red"])
    # session.json has milliseconds: the begin is cut, and the end rounded up.
    moment_ns = iso_ns(near["from"]) + 20 * 10**9
    assert before_ns - 10**6 < moment_ns < after_ns
    assert 0 <= iso_ns(near["to"]) - 10 * 10**9 - moment_ns <= 2 * 10**6
    info = in_process.fleet("sessions", "info", session, "--json")
    assert (info.returncode, json.loads(info.stdout)["pins"]) == (0, [near, other])


def test_fleet_file_mistake_costs_pins_not_recording(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    rules = tmp_path / "fleet.yaml"
    rules.write_text("cars: {red: {link: sim, platform: arduino}}\npin: [{when: rnage_m < 0.1}]\n")
    place = tmp_path / "sessions"
    process = start(RECORD, "--sessions", str(place), "--connect", endpoint, "--json", "--fleet-file", str(rules))
    session = ready(process)
    publisher(bus, "red", "sensor/range").put(pb.Range(range_m=0.05), time.time_ns())
    heard(bus._session)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert str(rules) in errors
    assert "rnage_m" in errors
    assert [each.key for each in Session(session).messages() if each.key == "fleet/red/sensor/range"]


def test_recorder_that_does_not_answer_is_not_quoted(endpoint: str, bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """`the recorder says: Timeout`: it had said nothing, and its disk was slow."""
    monkeypatch.setattr("fleet.client.services.RECORDER_TIMEOUT_S", 0.5)
    unanswered: list[zenoh.Query] = []
    for expression in keys.command_keys("fleet", keys.RECORDER):
        bus.queryable(expression, unanswered.append)
    done = in_process.fleet("record", "stop", "--connect", endpoint)
    assert len(unanswered) == 1
    assert done.returncode == 1
    assert has_parts(done.stderr, "has not answered within … may still … (stop) … fleet record status"), done.stderr

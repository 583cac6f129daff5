"""`fleet record` as a process."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest

from fleet.recording.reading.session import Session
from schemas.bus import Bus
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.recording.conftest import heard, popen, publisher, wait_for

RECORD = "from fleet.commands.record import record; record()"


def start(code: str, *arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", code, *arguments]
    return popen(command)


def ready(process: "subprocess.Popen[str]") -> Path:
    assert process.stdout is not None
    return Path(json.loads(process.stdout.readline())["session"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_closes_the_session_whole(number: signal.Signals, endpoint: str, bus: Bus, tmp_path: Path) -> None:
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


def test_a_full_disk_is_said_and_what_was_written_stays(endpoint: str, bus: Bus, tmp_path: Path) -> None:
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

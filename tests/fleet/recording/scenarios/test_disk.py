"""A full, absent or read-only disk, and a quota: written data stays, and the recorder reports the cause."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fleet.recording import session_dir
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.summary import SessionState, of_session, overview
from fleet.recording.tools.verify import verify
from fleet.recording.writing.disk_space import MB, Reserve
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas.bus import Bus, Failure, Sample
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.recording.conftest import heard, popen, publisher
from tests.fleet.recording.test_record_command import ready
from tests.fleet.recording.writing.test_session_writer import BEGUN_NS, SECOND_NS, feed
from tests.support import in_process
from tests.support.disk import DISKS, MAY_MOUNT, disk
from tests.support.processes import wait_for
from tests.support.text_parts import has_parts

pytestmark = pytest.mark.xdist_group("disk")  # these tests fill the same disk


def fleet(endpoint: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return in_process.fleet(*arguments, "--connect", endpoint)


def record(endpoint: str, out: Path, *options: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "fleet.cli", "record", "--sessions", str(out), "--connect", endpoint, "--json"]
    return popen([*command, *options])


def status(bus: Bus) -> Any:
    (answer,) = bus.query("fleet/@recorder/status", timeout_s=10.0)
    assert isinstance(answer, Sample)
    return answer.message()


@pytest.mark.parametrize("kind", DISKS)
def test_full_disk_keeps_written_data_and_recording_resumes(kind: str, endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with disk(kind, tmp_path) as there:
        process = record(endpoint, there.root, *there.options)
        session = ready(process)
        out = publisher(bus, "red", "frame/rx")
        sent = 0

        def publish() -> None:
            nonlocal sent
            out.put(pb.RxFrame(data=os.urandom(2000)), time.time_ns())
            sent += 1
            time.sleep(0.001)

        def publish_until(state: str) -> None:
            def so() -> bool:
                publish()
                return sent % 100 == 0 and status(bus).state == state

            wait_for(so, f"the recorder is {state}")

        while sent < 300:
            publish()

        def in_file() -> set[int]:
            return {message.sequence for message in Session(session).messages() if message.key == out.key}

        wait_for(lambda: set(range(1, 301)) <= in_file(), "that is in the file")
        # A chunk can be read before its flush has ended. The next chunk shows that it has.
        publish()
        wait_for(lambda: 301 in in_file(), "the next chunk is in the file")
        there.fill()
        publish_until("full")
        before = in_file()
        assert set(range(1, 301)) <= before
        found = fleet(endpoint, "record", "status")
        assert found.returncode == 0
        assert found.stdout.startswith("full:")
        assert "Recording pauses" in found.stdout
        for _ in range(100):
            publish()
        there.free()
        publish_until("recording")
        heard(bus._session)
        process.send_signal(signal.SIGTERM)
        text, errors = process.communicate(timeout=60)
        end = json.loads(text)
        numbers = [message.sequence for message in Session(session).messages() if message.key == out.key]
        # The recorder buffered the messages meanwhile, and has recorded them, too.
        assert numbers == list(range(1, sent + 1))
        assert (process.returncode, end["drops"], end["missed"]) == (0, {}, {})
        assert "Recording pauses" in errors
        assert "room again" in errors
        verdict = verify(Session(session))
        assert verdict.whole, "also the file whose end the full disk did not take at once"


def holds(session: Path, key: str) -> list[int]:
    return [message.sequence for message in Session(session).messages() if message.key == key]


@pytest.mark.parametrize("kind", DISKS)
def test_stop_on_full_disk_writes_what_fits_and_tells_drops(kind: str, endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with disk(kind, tmp_path) as there:
        process = record(endpoint, there.root, *there.options)
        session = ready(process)
        out = publisher(bus, "red", "frame/rx")
        sent = 0
        there.fill()

        def publish_until(enough: Callable[[Any], bool]) -> None:
            def so() -> bool:
                nonlocal sent
                for _ in range(100):
                    out.put(pb.RxFrame(data=os.urandom(2000)), time.time_ns())
                    time.sleep(0.001)
                sent += 100
                return enough(status(bus))

            wait_for(so, "what was published is seen")

        publish_until(lambda seen: seen.state == "full")
        publish_until(lambda seen: seen.messages > sent // 2 and "messages wait" in seen.error)
        heard(bus._session)
        process.send_signal(signal.SIGINT)
        text, errors = process.communicate(timeout=60)
        end = json.loads(text)
        description = session_dir.SessionInfo.read(session)
        assert description is not None
        assert description.closed
        dropped = end["drops"].get(out.key, 0)
        assert description.drops == end["drops"]
        assert len(holds(session, out.key)) + dropped == sent
        assert description.messages == end["messages"] == sum(1 for _ in Session(session).messages())
        assert not (session / session_dir.SPARE_FILE).exists()
        if kind == "keep free":  # the reserve has room for the index
            assert (process.returncode, dropped) == (0, 0)
            assert verify(Session(session)).whole
        else:
            assert process.returncode == 1
            total = sum(end["drops"].values())
            assert total >= dropped > 100
            assert f"stayed full: {total} " in errors.splitlines()[-1]
            assert f"{total} waiting messages" in description.error


@pytest.mark.parametrize("kind", DISKS)
def test_disk_full_at_start_is_waited_for(kind: str, endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with disk(kind, tmp_path) as there:
        there.fill()
        process = record(endpoint, there.root, *there.options)
        session = ready(process)
        assert status(bus).state == "full"
        out = publisher(bus, "red", "sensor/range")
        for _ in range(100):
            out.put(pb.Range(range_m=1.0), time.time_ns())
        wait_for(lambda: status(bus).messages > 100, "those wait")
        if kind == "keep free":
            assert (of_session(Session(session)).messages, list(there.root.glob("*"))) == (0, [session])
        else:
            assert list(there.root.glob("*")) == []
        marked = fleet(endpoint, "mark", "full")
        assert marked.returncode == 1
        assert status(bus).error.partition(";")[0] in marked.stderr, "why it is not in a file yet"
        there.free()
        wait_for(lambda: status(bus).state == "recording", "it records")
        process.send_signal(signal.SIGTERM)
        text, errors = process.communicate(timeout=60)
        end = json.loads(text)
        assert (process.returncode, end["session"], end["drops"]) == (0, str(session), {})
        assert holds(session, out.key) == list(range(1, 101))
        opened = Session(session)
        assert verify(opened).whole
        assert opened.description is not None
        assert [mark["text"] for mark in opened.description.marks] == ["full"]
        assert "Recording pauses" in errors
        assert f"room again: recording continues to {session}" in errors


def test_recorder_killed_before_there_was_room_is_in_the_list(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    """It left no trace: what it had buffered was gone, and the next recorder did not fetch it."""
    with disk("keep free", tmp_path) as there:
        there.fill()
        process = record(endpoint, there.root, *there.options)
        session = ready(process)
        out = publisher(bus, "red", "sensor/range")
        out.put(pb.Range(range_m=1.0), time.time_ns())
        wait_for(lambda: status(bus).messages > 1, "it waits")
        os.utime(session / "0001.mcap", (0, 0))
        wait_for(lambda: overview(session).state == SessionState.RECORDING, "it is seen to be at work")
        assert "Recording pauses until there is room" in overview(session).words
        process.kill()
        process.communicate(timeout=60)
        os.utime(
            session / "0001.mcap", (time.time() - 6, time.time() - 6)
        )  # instead of 5 s in which it may be recording
        found = overview(session)
        assert (found.state, found.messages) == (SessionState.CUT, 0)
        assert has_parts(found.words, "the recorder did not close it … are left on the disk … no message is in it")
        there.free()
        process = record(endpoint, there.root, *there.options)
        following = ready(process)
        wait_for(lambda: holds(following, out.key) == [1], "the next one fetches it")
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
        description = session_dir.SessionInfo.read(following)
        assert description is not None
        assert description.continues == session.name


@pytest.mark.parametrize("kind", DISKS)
def test_stop_on_disk_full_from_start_says_so_without_leftovers(kind: str, endpoint: str, tmp_path: Path) -> None:
    with disk(kind, tmp_path) as there:
        there.fill()
        process = record(endpoint, there.root, *there.options)
        session = ready(process)
        process.send_signal(signal.SIGTERM)
        text, errors = process.communicate(timeout=60)
        if kind == "keep free":
            assert process.returncode == 0
            assert verify(Session(session)).whole
            return
        assert process.returncode == 1
        dropped = sum(json.loads(text)["drops"].values())
        assert f"stayed full: {dropped} " in errors.splitlines()[-1]
        assert list(there.root.glob("*")) == []
        with pytest.raises(NoSession):
            Session(session)


@pytest.mark.skipif(not MAY_MOUNT, reason="may not mount a disk of its own")
def test_backlog_is_written_as_room_allows(tmp_path: Path) -> None:
    with disk("really full", tmp_path) as there:
        tape = SessionWriter(there.root, "fleet", Options(reserve=Reserve(0)), BEGUN_NS)
        there.fill()
        written = []
        for second in range(3):
            feed(tape, BEGUN_NS + second * SECOND_NS, count=500, size=1000)
            tape.tick(BEGUN_NS + second * SECOND_NS)
        assert tape.full
        assert tape.waiting == tape.messages == 1500
        there.free()
        there.fill(but=MB)
        for second in range(3, 10):
            tape.tick(BEGUN_NS + second * SECOND_NS)
            written.append(tape.messages - tape.waiting)
        assert 0 < written[-1] < 1500
        assert all(any(Session(segment).messages()) for segment in tape.path.glob("000[2-9].mcap"))
        assert tape.segments < 4
        description = session_dir.SessionInfo.read(tape.path)
        assert description is not None
        assert description.messages == written[-1]
        assert "Recording pauses" in description.error
        there.free()
        tape.tick(BEGUN_NS + 10 * SECOND_NS)
        assert not tape.full
        tape.close(BEGUN_NS + 11 * SECOND_NS)
        assert (tape.drops, tape.cost) == ({}, "")
        assert verify(Session(tape.path)).whole
        description = session_dir.SessionInfo.read(tape.path)
        assert description is not None
        assert "Recording had paused" in description.error
        times = [message.recorded_ns for message in Session(tape.path).messages()]
        assert times == [BEGUN_NS + second * SECOND_NS + number for second in range(3) for number in range(500)]


def test_quota_alone_keeps_what_it_says(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = record(endpoint, tmp_path, "--quota", "1MB")
    session = ready(process)
    out = publisher(bus, "red", "frame/rx")
    sent = 0

    def gone() -> bool:
        nonlocal sent
        for _ in range(10):
            sent += len(out.put(pb.RxFrame(data=os.urandom(2000)), time.time_ns()))
            time.sleep(0.002)
        return not session.exists()

    wait_for(gone, "the oldest session gave way")
    process.send_signal(signal.SIGTERM)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert Path(json.loads(text)["session"]) != session
    assert f"{session} is removed" in errors
    assert errors.count("its quota") <= 2  # reported once at the beginning, not with each status
    assert all(verify(Session(path)).whole for path in tmp_path.iterdir() if path.is_dir())


def test_directory_that_vanishes_is_said_and_ends_the_recorder(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    states: list[str] = []
    bus.subscribe("fleet/@recorder/status", lambda sample: states.append(sample.message().state))  # type: ignore[attr-defined]
    process = record(endpoint, tmp_path / "sessions")
    session = ready(process)
    shutil.rmtree(tmp_path / "sessions")
    text, errors = process.communicate(timeout=60)
    assert (process.returncode, text) == (1, "")
    (line,) = errors.splitlines()
    assert f"{session} failed: " in line
    assert "No such file or directory" in line
    assert "The 0 messages before are intact" in line
    wait_for(lambda: "failed" in states, "that on the bus")


@pytest.mark.parametrize("change", ["removed", "moved", "replaced"])
def test_file_that_vanishes_while_it_is_written_ends_the_recorder(
    change: str, endpoint: str, bus: Bus, tmp_path: Path
) -> None:
    """A recorder went on into a file that nobody can open, and reported it closed, with all messages."""
    process = record(endpoint, tmp_path)
    session = ready(process)
    file = session / "0001.mcap"
    wait_for(lambda: any(Session(session).messages()), "something is in the file")
    if change == "removed":
        file.unlink()
    else:
        file.rename(tmp_path / "elsewhere.mcap")
    if change == "replaced":
        (tmp_path / "elsewhere.mcap").unlink()
        file.write_bytes(b"")
    text, errors = process.communicate(timeout=60)
    assert (process.returncode, text) == (1, "")
    assert "The 0 messages before are intact" in errors
    description = session_dir.SessionInfo.read(session)
    assert description is not None
    assert not description.closed
    assert "somebody has moved or removed" in description.error


def test_next_recorder_fetches_what_a_failed_one_has_lost(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    """`fleet up` starts a failed recorder again. What was lost meanwhile was in no session, and counted nowhere."""
    process = record(endpoint, tmp_path)
    failed = ready(process)
    out = publisher(bus, "red", "sensor/range")
    out.put(pb.Range(range_m=1.0), time.time_ns())
    wait_for(lambda: holds(failed, out.key) == [1], "it is in the file")
    (failed / "0001.mcap").unlink()
    process.communicate(timeout=60)
    assert process.returncode == 1
    out.put(pb.Range(range_m=2.0), time.time_ns())
    process = record(endpoint, tmp_path)
    session = ready(process)
    wait_for(lambda: sorted(holds(session, out.key)) == [1, 2], "both are backfilled")
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    description = session_dir.SessionInfo.read(session)
    assert description is not None
    assert description.continues == failed.name


def test_file_in_the_way_is_one_line(endpoint: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    process = record(endpoint, tmp_path / "file" / "sessions")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert len(errors.splitlines()) == 1
    assert "--sessions" in errors


def test_recorder_stop_start_and_mark_over_bus(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = record(endpoint, tmp_path)
    first = ready(process)
    marked = fleet(endpoint, "mark", "the cat came", "--by", "me")
    assert (marked.returncode, marked.stdout) == (0, f"marked in {first}\n")
    assert "recorder says: " in fleet(endpoint, "record", "start").stderr
    stopped = fleet(endpoint, "record", "stop")
    assert stopped.stdout.startswith(f"stopped: {first}")
    assert verify(Session(first)).whole
    refused = fleet(endpoint, "mark", "nobody hears it")
    assert refused.returncode == 1
    assert "being recorded" in refused.stderr
    started = json.loads(fleet(endpoint, "record", "start", "--json").stdout)
    assert started["state"] == "recording"
    second = Path(started["session"])
    assert second != first
    process.send_signal(signal.SIGTERM)
    text, _ = process.communicate(timeout=60)
    assert json.loads(text)["session"] == str(second)
    description = Session(first).description
    assert description is not None
    assert description.kept
    assert [(mark["text"], mark["by"]) for mark in description.marks] == [("the cat came", "me")]
    marks = [message for message in Session(first).messages() if message.key == "fleet/@recorder/mark"]
    assert len(marks) == 1
    assert marks[0].message == "foxglove.Log"


def test_mark_that_cannot_be_is_refused(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = record(endpoint, tmp_path)
    ready(process)
    for payload in (b"", b"{", b"[]", b'{"text": 3}', b'{"text": ""}', b'{"text": "x", "by": 1}', b"\xff"):
        (answer,) = bus.query("fleet/@recorder/@cmd/mark", payload=payload, timeout_s=10.0)
        assert isinstance(answer, Failure), payload
    (answer,) = bus.query("fleet/@recorder/@cmd/explode", timeout_s=10.0)
    assert isinstance(answer, Failure)
    assert "start, stop, status, mark" in answer.words
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=60)[1] == ""
    assert fleet(endpoint, "mark", " ").returncode == 2
    assert "No recorder of " in fleet(endpoint, "record", "status").stderr


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--segment-size", "3"), "1 MB to 1000 TB"),
        (("--quota", "much"), "1 MB to 1000 TB"),
        (("--keep-free=-1",), "0 to 1000 TB"),
        (("--segment-time", "0s"), "more than 0"),
        (("--quota", "5GB", "--session-size", "3GB"), "at most 2500 MB are allowed"),
        (("--quota", "5GB", "status"), "Write the command first: fleet record status"),
    ],
)
def test_options_that_cannot_be_are_one_line(option: tuple[str, ...], words: str) -> None:
    command = [sys.executable, "-m", "fleet.cli", "record", *option]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert found.returncode == 2
    assert words in found.stderr
    assert len(found.stderr.splitlines()) == 1

"""A disk that is full, goes away or must not be written to, and a quota: what was written stays, and it is said."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fleet.recording.session import Session
from fleet.recording.sessions.verify import verify
from schemas.bus import Bus, Failure, Sample
from schemas.gen import fleet_v1_pb2 as pb

from .conftest import publisher, wait_for
from .test_command import ready

BALLAST = 300_000_000
TINY = 6_000_000


def can_mount() -> bool:
    """Whether this user may mount a disk of its own."""
    return (
        sys.platform == "linux"
        and os.geteuid() == 0
        and not subprocess.run(
            ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False
        ).returncode
    )


class Disk:
    """A disk that can be filled, and emptied again."""

    def __init__(self, root: Path, ballast: Path, size: int, options: tuple[str, ...]) -> None:
        self.root = root
        self.options = options
        self._ballast = ballast
        self._size = size

    def fill(self) -> None:
        with self._ballast.open("wb") as file:
            size = min(self._size, shutil.disk_usage(self._ballast.parent).free)
            os.posix_fallocate(file.fileno(), 0, size)

    def free(self) -> None:
        self._ballast.unlink()


@contextmanager
def disk(kind: str, place: Path) -> Iterator[Disk]:
    """A disk of its own, or of the machine's so much that nothing is really full."""
    if kind == "keep free":
        keep = shutil.disk_usage(place).free - BALLAST // 2
        yield Disk(place / "sessions", place / "ballast", BALLAST, ("--keep-free", str(keep)))
        return
    mounted = place / "disk"
    mounted.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={TINY}", "tmpfs", str(mounted)], check=True)
    try:
        yield Disk(mounted / "sessions", mounted / "ballast", TINY, ("--keep-free", "0"))
    finally:
        subprocess.run(["umount", "-l", str(mounted)], check=True)


def fleet(endpoint: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "fleet.cli", *arguments, "--connect", endpoint]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def record(endpoint: str, out: Path, *options: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "fleet.cli", "record", "--out", str(out), "--connect", endpoint, "--json"]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def status(bus: Bus) -> Any:
    (answer,) = bus.query("fleet/@recorder/status", timeout_s=10.0)
    assert isinstance(answer, Sample)
    return answer.message()


@pytest.mark.parametrize("kind", ["keep free", *(["a disk of its own"] if can_mount() else [])])
def test_a_full_disk_takes_nothing_that_was_written_and_recording_goes_on_when_there_is_room(
    kind: str, endpoint: str, bus: Bus, tmp_path: Path
) -> None:
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
        wait_for(lambda: status(bus).bytes > 300 * 2000, "that is in the file")
        there.fill()
        publish_until("full")
        before = {message.sequence for message in Session.open(session).messages() if message.key == out.key}
        assert set(range(1, 301)) <= before
        found = fleet(endpoint, "record", "status")
        assert found.returncode == 0
        assert found.stdout.startswith("full:")
        assert "nothing is written until there is room" in found.stdout
        for _ in range(100):
            publish()
        there.free()
        publish_until("recording")
        process.send_signal(signal.SIGTERM)
        text, errors = process.communicate(timeout=60)
        end = json.loads(text)
        numbers = [message.sequence for message in Session.open(session).messages() if message.key == out.key]
        # What came meanwhile was held, and is here, too.
        assert numbers == list(range(1, sent + 1))
        assert (process.returncode, end["drops"], end["missed"]) == (0, {}, {})
        assert "nothing is written until there is room" in errors
        assert "there is room again" in errors
        verdict = verify(Session.open(session))
        assert (verdict.missing, verdict.twice, verdict.closed) == ([], [], True)
        # Nearly full, a file is closed in time; where there is no room at all, not even its index can be written.
        assert list(verdict.damage) == ([] if kind == "keep free" else ["0001.mcap"])


def test_a_directory_that_vanishes_is_said_and_ends_the_recorder(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    states: list[str] = []
    bus.subscribe("fleet/@recorder/status", lambda sample: states.append(sample.message().state))  # type: ignore[attr-defined]
    process = record(endpoint, tmp_path / "sessions")
    session = ready(process)
    shutil.rmtree(tmp_path / "sessions")
    text, errors = process.communicate(timeout=60)
    assert (process.returncode, text) == (1, "")
    (line,) = errors.splitlines()
    assert f"recording to {session} failed: " in line
    assert "No such file or directory" in line
    wait_for(lambda: "failed" in states, "that on the bus")


def test_a_file_in_the_way_is_one_line(endpoint: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    process = record(endpoint, tmp_path / "file" / "sessions")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert len(errors.splitlines()) == 1
    assert "name another with --out" in errors


def test_it_is_stopped_started_and_marked_over_the_bus(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = record(endpoint, tmp_path)
    first = ready(process)
    marked = fleet(endpoint, "mark", "the cat came", "--by", "me")
    assert (marked.returncode, marked.stdout) == (0, f"marked in {first}\n")
    assert fleet(endpoint, "record", "start").stderr.startswith("fleet: the recorder says: fleet 'fleet' is being")
    stopped = fleet(endpoint, "record", "stop")
    assert stopped.stdout.startswith(f"stopped: {first}")
    assert verify(Session.open(first)).whole
    refused = fleet(endpoint, "mark", "nobody hears it")
    assert refused.returncode == 1
    assert "nothing is being recorded" in refused.stderr
    started = json.loads(fleet(endpoint, "record", "start", "--json").stdout)
    assert started["state"] == "recording"
    second = Path(started["session"])
    assert second != first
    process.send_signal(signal.SIGTERM)
    text, _ = process.communicate(timeout=60)
    assert json.loads(text)["session"] == str(second)
    description = Session.open(first).description
    assert description is not None
    assert description.kept
    assert [(mark["text"], mark["by"]) for mark in description.marks] == [("the cat came", "me")]
    marks = [message for message in Session.open(first).messages() if message.key == "fleet/@recorder/mark"]
    assert len(marks) == 1
    assert marks[0].message == "foxglove.Log"


def test_a_mark_that_cannot_be_is_refused(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    process = record(endpoint, tmp_path)
    ready(process)
    for payload in (b"", b"{", b"[]", b'{"text": 3}', b'{"text": ""}', b'{"text": "x", "by": 1}', b"\xff"):
        (answer,) = bus.query("fleet/@recorder/@cmd/mark", payload=payload, timeout_s=10.0)
        assert isinstance(answer, Failure), payload
    (answer,) = bus.query("fleet/@recorder/@cmd/explode", timeout_s=10.0)
    assert isinstance(answer, Failure)
    assert "allowed are start, stop, status, mark" in answer.words
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=60)[1] == ""
    assert fleet(endpoint, "mark", " ").returncode == 2
    assert "no recorder of fleet" in fleet(endpoint, "record", "status").stderr


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--segment-size", "3"), "1 MB to 1000 TB"),
        (("--quota", "much"), "1 MB to 1000 TB"),
        (("--keep-free=-1",), "0 to 1000 TB"),
        (("--segment-time", "0s"), "more than 0"),
        (("--quota", "5GB", "status"), "--quota goes behind 'status'"),
    ],
)
def test_options_that_cannot_be_are_one_line(option: tuple[str, ...], words: str) -> None:
    command = [sys.executable, "-m", "fleet.cli", "record", *option]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert found.returncode == 2
    assert words in found.stderr
    assert len(found.stderr.splitlines()) == 1

"""`gateway sim --replay`: a file of raw bytes plays as a car over real links, in a process of its own."""

import argparse
import itertools
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from gateway import capture
from gateway.sim.cli import add_arguments, run

PATIENCE = 20.0
PIECES = [
    capture.CapturedBytes(0.0, b"$4WD,CSB57.24,PV7.91,"),
    capture.CapturedBytes(0.4, b"GS214,LF0000,HW00,GM00#"),
    capture.CapturedBytes(0.8, bytes(range(256))),
]
BYTES = b"".join(piece.data for piece in PIECES)


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    writer = capture.CaptureWriter(tmp_path / "red.raw", "/dev/ttyUSB0", "2026-01-01T00:00:00Z")
    for piece in PIECES:
        writer.add(piece)
    writer.close()
    return writer.path


class Sim:
    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "gateway.sim", "--no-truth", *arguments]
        self.popen = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
        )

    def line(self) -> dict[str, Any]:
        assert self.popen.stdout is not None
        return json.loads(self.popen.stdout.readline())

    def ask(self, **fields: object) -> dict[str, Any]:
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps(fields) + "\n")
        answer = self.line()
        while "ok" not in answer:
            answer = self.line()
        return answer


@pytest.fixture
def start() -> Iterator[Any]:
    started: list[Sim] = []

    def begin(*arguments: str) -> Sim:
        started.append(Sim(*arguments))
        return started[-1]

    yield begin
    for sim in started:
        sim.popen.terminate()
        assert sim.popen.wait(PATIENCE) == 0
        assert sim.popen.stderr is not None
        assert sim.popen.stderr.read() == ""
        for stream in (sim.popen.stdin, sim.popen.stdout, sim.popen.stderr):
            assert stream is not None
            stream.close()


def connect(link: str) -> socket.socket:
    host, _, port = link.removeprefix("tcp://").rpartition(":")
    return socket.create_connection((host, int(port)), timeout=PATIENCE)


def read(connection: socket.socket, count: int) -> list[tuple[float, bytes]]:
    got: list[tuple[float, bytes]] = []
    while sum(len(data) for _, data in got) < count:
        data = connection.recv(4096)
        assert data
        got.append((time.monotonic(), data))
    return got


def test_tcp_capture_starts_with_host_and_keeps_times(start: Any, kept: Path) -> None:
    sim = start("--replay", f"{kept}:old:tcp")
    line = sim.line()
    assert (line["car"], line["replay"]) == ("old", str(kept))
    before = time.monotonic()
    with connect(line["link"]) as connection:
        got = read(connection, len(BYTES))
        assert b"".join(data for _, data in got) == BYTES
        assert got[-1][0] - before >= 0.79, "0.8 s in the file, from when the host came; the first may be read late"
        assert sim.line() == {"car": "old", "replay": "ended"}
        connection.sendall(b"$1,0,0,0,0,0,0,0,0#")
        end = time.monotonic() + PATIENCE
        while (answer := sim.ask(car="old", ask="truth"))["ignored_bytes"] < 19:
            assert time.monotonic() < end
    assert answer["sent_bytes"] == len(BYTES)
    assert answer["rounds"] == 1
    assert "brownout needs a simulated car" in sim.ask(car="old", fault="brownout")["error"]
    assert "ir needs a simulated car" in sim.ask(car="old", ir="stop")["error"]


def test_over_a_pty_beside_a_car_with_a_fault(start: Any, kept: Path, tmp_path: Path) -> None:
    sim = start("--car", "red:arduino:pty", "--replay", f"{kept}:old:pty:{tmp_path / 'old'}", "--loop", "--rate", "4")
    assert sim.line()["platform"] == "arduino"
    assert sim.line()["link"] == f"serial://{tmp_path / 'old'}"
    with serial.Serial(str(tmp_path / "old"), timeout=PATIENCE) as port:
        # Control characters of terminals pass unchanged, in each round.
        assert len(port.read_until(BYTES)) < 10 * len(BYTES)
        assert port.read(len(BYTES)) == BYTES
        assert sim.ask(car="old", fault="mute")["ok"]
        end = time.monotonic() + PATIENCE
        while sim.ask(car="old", ask="truth")["lost_bytes"]["host"] == 0:
            assert time.monotonic() < end
    assert sim.ask(car="red", ask="truth")["mode"] == "manual"


BAD = [
    (["--replay", "DIR/none.raw"], "No such file"),
    (["--replay", "DIR"], "this is a directory"),
    (["--replay", "DIR/empty"], "the file is empty"),
    (["--replay", "DIR/other"], "its first line is not"),
    (["--replay", "DIR/nothing"], "no bytes to play"),
    (["--replay", "DIR/broken"], "broken:2: "),
    (["--replay", "DIR/backwards"], "backwards:3: t is 1"),
    (["--replay", "a\0b"], "embedded null"),
    (["--replay", "GOOD:red:usb"], "No such file"),
    (["--replay", "GOOD:-x"], "a-z"),
    (["--replay", "GOOD", "--rate", "0"], "0.01 to 100"),
    (["--replay", "GOOD", "--rate", "nan"], "0.01 to 100"),
    (["--replay", "GOOD", "--replay", "GOOD"], "two cars have the name replay"),
    (["--car", "red:arduino:tcp", "--loop"], "give --replay FILE as well"),
    (["--car", "red:arduino:tcp", "--replay", "GOOD:red"], "two cars have the name red"),
    (["--replay", "GOOD", "--fault", "replay:brownout@1"], "brownout needs a simulated car"),
    (["--replay", "GOOD", "--ir", "stop@1"], "ir needs a simulated car"),
    ([], "--car NAME:PLATFORM:LINK or --replay FILE"),
]


def test_sim_replay_errors_are_one_line(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = kept.read_text().splitlines(keepends=True)[0]
    for name, text in {
        "empty": "",
        "other": "{}\n",
        "nothing": first,
        "broken": first + "{\n",
        "backwards": first + '{"t": 2, "rx": "a"}\n{"t": 1, "rx": "b"}\n',
    }.items():
        (tmp_path / name).write_text(text)
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for arguments, words in BAD:
        filled = [word.replace("DIR", str(tmp_path)).replace("GOOD", str(kept)) for word in arguments]
        assert run(parser.parse_args([*filled, "--no-truth"])) == 2, arguments
        said = capsys.readouterr().err
        assert words in said, arguments
        assert said.count("\n") == 1
        assert said.startswith("gateway sim: ")


def test_capture_of_a_car_plays_as_that_car(start: Any, tmp_path: Path) -> None:
    """A host's capture of a simulated car plays again, byte for byte."""
    sim = start("--car", "red:arduino:tcp", "--fault", "red:garbage@0.2+50")
    with connect(sim.line()["link"]) as connection:
        got = read(connection, 100)
    begun = got[0][0]
    writer = capture.CaptureWriter(tmp_path / "kept.raw", "tcp", "2026-01-01T00:00:00Z")
    for at, data in got:
        writer.add(capture.CapturedBytes(at - begun, data))
    writer.close()
    again = start("--replay", f"{tmp_path / 'kept.raw'}:red:tcp", "--rate", "10")
    with connect(again.line()["link"]) as connection:
        played = read(connection, sum(len(data) for _, data in got))
    assert b"".join(data for _, data in played) == b"".join(data for _, data in got)
    assert all(a <= b for (a, _), (b, _) in itertools.pairwise(played))

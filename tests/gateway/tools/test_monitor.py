"""`gateway monitor` as a process: its output for a car and for a file, its capture, its end."""

import json
import os
import pty
import signal
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gateway.capture import CapturedBytes, CaptureWriter, read
from tests.gateway.conftest import PATIENCE_S, Command, Started
from tests.support.processes import GatewayProcess, TcpCar, wait_for
from tests.support.text_parts import has_parts

MANUAL = b"$4WD,CSB57.24,PV7.91,GS214,LF0110,HW01,GM10#"
NO_ECHO = b"$4WD,CSB0.00,PV7.9,GS5140,LF0110,HW01,GM10#"
PIECES = [
    CapturedBytes(0.2, b"BT04 ready\x1b[2J\r\n"),
    CapturedBytes(1.0, MANUAL[:10]),
    CapturedBytes(1.01, MANUAL[10:] + b"\r\n"),
    CapturedBytes(2.0, NO_ECHO),
    CapturedBytes(3.0, b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"),
    CapturedBytes(3.1, b"$4WD,CSB120,PV8.3,GS000,LF0000,HW01,GM00"),
    CapturedBytes(3.2, b"$4WD,J190,J280,J370,J460,J50,J6180#"),
    CapturedBytes(3.3, b"$4WD,MPUgx-1,MPUgy2,MPUgz3.5,MPUax4,MPUay5,MPUaz-16384#"),
    CapturedBytes(4.0, b"$4WD,CSB1"),
]


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    path = tmp_path / "kept.jsonl"
    writer = CaptureWriter(path, "serial:///dev/ttyUSB0", "now")
    for piece in PIECES:
        writer.add(piece)
    writer.close()
    return path


def test_monitor_decodes_capture_file(command: Command, kept: Path) -> None:
    done = command("monitor", "--from", kept)
    assert done.returncode == 0
    shown = [
        (0.2, "BT04 ready\\x1b[2J", "rejected, no_start:  14 bytes outside a frame"),
        (1.01, MANUAL.decode(), "0.57 m  7.91 V  grayscale 214  line 0110  obstacle 01  light 10  (manual)"),
        (2.0, NO_ECHO.decode(), "no echo  7.90 V  line 0110  obstacle 01  light 10  (manual)  rejected: GS5140"),
        (3.0, PIECES[4].data.decode(), "line 1001  (tracking)"),
        (3.1, PIECES[5].data.decode(), "obstacle 10  (following)"),
        (3.2, PIECES[6].data.decode(), "arm  joint_deg 90 80 70 60 0 180"),
        (3.3, PIECES[7].data.decode() + "\n" + " " * 57, "imu  gyro_raw -1 2 3.5  accel_raw 4 5 -16384"),
        (4.0, "$4WD,CSB1", "rejected, truncated:  another frame began, nothing came for 0.5 s, or the link ended"),
    ]
    assert done.stdout == "".join(f"{at:9.3f}  {raw:<46}  {words}\n" for at, raw, words in shown)
    assert done.stderr.startswith("6 frames in 4.0 s (1.5/s), 3 rejected (no_start 1, out_of_range 1, truncated 1); ")
    assert ": manual 2, tracking 1, following 1; platform: " in done.stderr


def test_json_has_every_event_and_the_whole(command: Command, kept: Path) -> None:
    done = command("monitor", "--from", kept, "--json")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["kind"] for line in lines] == [
        *("rejected", "sensors", "sensors", "sensors", "sensors", "arm", "imu", "rejected", "summary")
    ]
    assert lines[1] == {
        "t": 1.01,
        "kind": "sensors",
        "range_m": 0.5724,
        "voltage_v": 7.91,
        "grayscale": 214,
        "line": "0110",
        "obstacle": "01",
        "light": "10",
        "modes": ["manual"],
        "raw": MANUAL.decode(),
    }
    assert lines[2]["no_echo"]
    assert lines[2]["rejected"] == {"GS": "5140"}
    assert lines[-1]["rejects"] == {"no_start": 1, "out_of_range": 1, "truncated": 1}
    assert lines[-1]["frames"] == {"sensors": 4, "arm": 1, "imu": 1}
    assert done.stderr == ""


def test_monitor_reports_platform_contradiction_once(command: Command, kept: Path) -> None:
    done = command("monitor", "--from", kept, "--platform", "raspberry_pi")
    assert "platform" in done.stdout.splitlines()[1]
    assert "platform 2 times: " in done.stderr
    assert "CSB; a raspberry_pi car " in done.stderr


def _live(start: Started, link: str, *more: str | Path) -> GatewayProcess:
    return start("monitor", "--link", link, "--json", *more)


def _until(monitor: GatewayProcess, kind: str) -> list[dict[str, Any]]:
    lines = [monitor.line()]
    while lines[-1]["kind"] != kind:
        lines.append(monitor.line())
    return lines


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130)])
def test_live_then_the_file_of_it_again(
    number: int, code: int, start: Started, simulate: Callable[..., Any], command: Command, tmp_path: Path
) -> None:
    _, [link] = simulate("red:arduino+imu:pty")
    kept = tmp_path / "kept"
    monitor = _live(start, link, "--raw", kept)
    _until(monitor, "imu")
    _until(monitor, "sensors")
    assert monitor.end(number) == code
    assert monitor.stderr.endswith(f" in {kept}\n")
    again = command("monitor", "--from", kept, "--json")
    events = [line for line in map(json.loads, again.stdout.splitlines()) if line["kind"] != "summary"]
    assert [event["kind"] for event in events].count("sensors") >= 1
    shown = command("monitor", "--from", kept)
    assert len(shown.stdout.splitlines()) >= len(events)


def test_live_and_file_show_the_same(start: Started, command: Command, tmp_path: Path) -> None:
    controller, device = pty.openpty()
    os.set_blocking(controller, True)
    kept = tmp_path / "kept"
    monitor = _live(start, os.ttyname(device), "--raw", kept)
    wait_for(lambda: kept.exists() and kept.read_text(), "the monitor is there")
    wait_for(lambda: _is_raw(device), "the port is opened")
    # The system discards bytes during the opening of the port. Send newlines, which have no effect, until one arrives.
    wait_for(lambda: os.write(controller, b"\n") and list(read(kept)), "it reads")
    for piece in PIECES:
        os.write(controller, piece.data)
    live = _until(monitor, "imu")
    whole = b"".join(piece.data for piece in PIECES)
    # Undelivered bytes of an unplugged device are lost, here as with a real one.
    wait_for(lambda: b"".join(piece.data for piece in read(kept)).lstrip(b"\n") == whole, "it has read all of it")
    os.close(device)
    os.close(controller)  # as with an unplugged device
    assert monitor.wait() == 1
    live += _until(monitor, "summary")
    assert "unplugged" in monitor.stderr.splitlines()[-1]
    again = [json.loads(line) for line in command("monitor", "--from", kept, "--json").stdout.splitlines()]
    assert live[:-1] == again[:-1]
    assert live[-1]["rejects"] == again[-1]["rejects"]


def _is_raw(device: int) -> bool:
    return not termios.tcgetattr(device)[3] & termios.ICANON


def test_monitor_ends_quietly_on_closed_pipe(simulate: Callable[..., Any], tmp_path: Path) -> None:
    _, [link] = simulate("red:arduino+imu:pty")
    long = tmp_path / "long"  # its lines do not fit into a pipe
    writer = CaptureWriter(long, "link", "now")
    for second in range(2000):
        writer.add(CapturedBytes(float(second), MANUAL))
    writer.close()
    for source in (["--link", link], ["--from", str(long)]):
        with subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", "monitor", *source],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as monitor:
            assert monitor.stdout is not None
            assert monitor.stderr is not None
            monitor.stdout.readline()
            monitor.stdout.close()
            assert monitor.stderr.read() == ""
            assert monitor.wait(PATIENCE_S) == 1


def test_monitor_on_full_disk_is_one_line(command: Command, kept: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gateway.cli", "monitor", "--from", kept],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
    assert done.returncode == 1
    assert done.stderr.startswith("gateway monitor: ")
    assert done.stderr.endswith(": No space left on device\n")


@pytest.mark.parametrize("arguments", [["monitor", "--from", "KEPT"], ["scan", "--link", "/dev/nope"]])
def test_closed_stdout_is_one_line(arguments: list[str], kept: Path) -> None:
    words = [word.replace("KEPT", str(kept)) for word in arguments]
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "gateway.cli", *words],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"gateway {words[0]}: ")
    assert done.stderr.endswith(": Bad file descriptor\n")


def test_monitor_warns_before_tcp_connect(start: Started) -> None:
    car = TcpCar()
    try:
        monitor = _live(start, car.link)
        wait_for(lambda: car.connections, "the monitor connects")
        assert "program dies" in monitor.stderr
        car.send(MANUAL)
        _until(monitor, "sensors")
    finally:
        car.close()
    assert monitor.wait() == 1
    assert car.received == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--link --from is required"),
        (["--link", "/dev/ttyUSB0", "--from", "x"], "not allowed"),
        (["--link", "usb:1"], "not a link"),
        (["--link", "/dev/ttyUSB0", "--platform", "pi"], 'Unknown platform "pi"'),
        (["--link", "/dev/ttyUSB0", "--platform", "UGV_Rover"], "ugv_rover cars speak another protocol"),
        (["--from", "nothing"], "nothing: … : No such file"),
        (["--from", "/"], "directory"),
        (["--from", "/dev/zero"], "/dev/zero: … device"),
        (["--from", sys.executable], "1: … JSON object"),
        (["--from", "x", "--raw", "y"], "--raw … --link"),
        (["--link", "/dev/nope", "--raw", "/nowhere/x"], "/nowhere/x: … : No such file"),
    ],
)
def test_wrong_use_is_one_line(command: Command, arguments: list[str], words: str) -> None:
    done = command("monitor", *arguments)
    assert done.returncode == 2
    assert has_parts(done.stderr.splitlines()[-1], words)
    assert done.stdout == ""


def test_monitor_of_missing_link_leaves_no_file(command: Command, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    done = command("monitor", "--link", "/dev/nope", "--raw", kept)
    assert done.returncode == 1
    assert done.stderr.startswith("gateway monitor: serial:///dev/nope: no such port")
    assert len(done.stderr.splitlines()) == 1
    assert not kept.exists()


def test_monitor_overwrites_no_file(command: Command, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text("mine")
    done = command("monitor", "--link", "/dev/nope", "--raw", kept)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert kept.read_text() == "mine"


def test_colour_is_for_a_terminal(kept: Path) -> None:
    controller, device = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"} | {"TERM": "xterm"}
    with subprocess.Popen(
        [sys.executable, "-m", "gateway.cli", "monitor", "--from", kept], stdout=device, env=environment
    ):
        shown = b""
        while b"link ended" not in shown:
            shown += os.read(controller, 4096)
    os.close(device)
    os.close(controller)
    assert b"\x1b[31mrejected, no_start:" in shown
    assert b"\x1b[2J" not in shown

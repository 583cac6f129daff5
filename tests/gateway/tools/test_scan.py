"""`gateway scan` as a process: cars, silence and other devices. Without --probe, the scan sends nothing."""

import contextlib
import json
import os
import pty
import re
import select
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from serial.tools.list_ports_common import ListPortInfo

from gateway.link.serial_port_list import by_id, described
from tests.gateway.conftest import PATIENCE_S, Command, Started
from tests.support.processes import TcpCar, driving, wait_for
from tests.support.text_parts import has_parts

UNKNOWN_STOP = [b"$0,0,0,0,0,0,0,0,0#"] * 3
"""Stop frames for a car of an unknown platform (docs/reference/protocol.md#stops)."""


class SpeakingStranger:
    """A serial port whose device sends given bytes, and stores received ones."""

    def __init__(self) -> None:
        self._controller, self._device = pty.openpty()
        tty.setraw(self._controller)
        self.link = f"serial://{os.ttyname(self._device)}"
        self.received = b""
        self.says = b""
        self.echoes = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._live)
        os.set_blocking(self._controller, False)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        os.close(self._device)
        os.close(self._controller)

    def _live(self) -> None:
        while not self._ended.wait(0.1):
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._controller, 4096)
                self.received += data
                if self.echoes:
                    os.write(self._controller, data)
            with contextlib.suppress(BlockingIOError):  # no reader yet
                os.write(self._controller, self.says)


@pytest.fixture
def stranger() -> Iterator[Callable[[], SpeakingStranger]]:
    made: list[SpeakingStranger] = []

    def make() -> SpeakingStranger:
        made.append(SpeakingStranger())
        return made[-1]

    yield make
    for each in made:
        each.close()


def _scan(command: Command, *links: str, more: tuple[str, ...] = ()) -> tuple[dict[str, Any], Any]:
    done = command("scan", "--json", *(word for link in links for word in ("--link", link)), *more)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    return {each["url"]: each for each in found}, done


def test_scan_result_of_each_kind_of_link(
    simulate: Callable[..., Any], start: Started, command: Command, stranger: Callable[[], SpeakingStranger]
) -> None:
    _, links = simulate("red:arduino:pty", "blue:raspberry_pi:pty", "green:arduino:pty")
    red, blue, green = links
    silent, other = stranger(), stranger()
    other.says = b"$GPGGA,123519,4807.038,N*47\r\n"
    monitor = start("monitor", "--link", green, "--json")
    monitor.line()  # the monitor has the port
    found, done = _scan(command, *links, silent.link, other.link, more=("--for", "8"))
    assert (done.returncode, done.stderr) == (0, "")
    assert {link: each["verdict"] for link, each in found.items()} == {
        red: "car",
        blue: "car",
        green: "busy",
        silent.link: "silent",
        other.link: "other",
    }
    assert (found[red]["platform"], found[blue]["platform"]) == ("arduino", "raspberry_pi")
    assert found[red]["platform_evidence"].startswith("arduino (or stm32: ")
    assert found[red]["modes"].keys() == {"manual"}
    assert found[other.link]["rejects"]["truncated"]
    assert "in use" in found[green]["words"]
    assert silent.received == b""
    assert other.received == b""


def test_probe_asks_silent_and_stops_mode_0_car(
    simulate: Callable[..., Any], command: Command, stranger: Callable[[], SpeakingStranger]
) -> None:
    sim, links = simulate("red:arduino:pty", "blue:arduino:pty")
    red, blue = links
    silent, other, loop = stranger(), stranger(), stranger()
    other.says = b"G28 ok\n"
    loop.echoes = True
    done = command("send", "--link", blue, "--platform", "arduino", "--wait", "1", "$4WD,MODE31#")
    assert done.returncode == 0
    assert command("send", "--link", red, "--wait", "1", "$1,0,0,0,0,0,0,0,0#").returncode == 0
    wait_for(lambda: driving(sim, "red"), "it drives, in mode 0")
    wait_for(lambda: sim.say({"car": "blue", "ask": "truth"})["mode"] == "obstacle_avoidance", "it avoids obstacles")
    found, done = _scan(command, *links, silent.link, other.link, loop.link, more=("--for", "5", "--probe"))
    assert done.returncode == 0
    assert {link: each["probed"] for link, each in found.items()} == {
        red: True,
        blue: True,
        silent.link: True,
        other.link: False,
        loop.link: True,
    }
    assert f"1.16 s to {red}, {blue}, {silent.link}, {loop.link}: " in done.stderr
    assert "in mode 0" in found[red]["words"]
    assert found[blue]["verdict"] == "silent", "in a silent mode a car obeys no general frame"
    assert found[silent.link]["verdict"] == "silent"
    assert (found[loop.link]["verdict"], found[loop.link]["frames"]) == ("other", {"echo": len(UNKNOWN_STOP)})
    assert "echoes" in found[loop.link]["words"]
    wait_for(lambda: silent.received.count(b"#") >= len(UNKNOWN_STOP), "all of it has come")
    assert re.findall(rb"\$[^#]*#", silent.received) == UNKNOWN_STOP
    assert other.received == b""
    assert sim.say({"car": "blue", "ask": "truth"})["mode"] == "obstacle_avoidance", "a probe changes no mode"
    assert not driving(sim, "red")


def test_for_a_person(simulate: Callable[..., Any], command: Command, stranger: Callable[[], SpeakingStranger]) -> None:
    _, [link] = simulate("red:arduino:pty")
    silent = stranger()
    done = command("scan", "--link", link, "--link", silent.link, "--for", "8")
    first, what, second, nothing = done.stdout.splitlines()
    assert (first, second) == (link, silent.link)
    assert what.startswith("  a car: ")
    assert "frames: manual; platform: arduino (or stm32" in what
    assert nothing.startswith("  silent: ")


def test_missing_link_fails_and_others_are_shown(command: Command, simulate: Callable[..., Any]) -> None:
    _, [link] = simulate("red:arduino:pty")
    found, done = _scan(command, "/dev/nope", link, more=("--for", "4"))
    assert done.returncode == 1
    assert found["serial:///dev/nope"]["verdict"] == "failed"
    assert "no such port" in found["serial:///dev/nope"]["words"]
    assert found[link]["verdict"] == "car"
    assert done.stderr.endswith(" serial:///dev/nope\n")


def test_device_that_goes_away_while_it_is_listened_to(start: Started) -> None:
    controller, device = pty.openpty()
    scan = start("scan", "--json", "--link", os.ttyname(device), "--for", "100")
    wait_for(lambda: not termios.tcgetattr(device)[3] & termios.ICANON, "the port is being opened")
    for _ in range(2):  # the opening discards the bytes of the first round
        os.write(controller, b"\n")
        wait_for(lambda: not select.select([device], [], [], 0)[0], "it is taken")
    os.close(device)
    os.close(controller)
    told = scan.line()
    assert told["seconds"] < 99
    assert (told["verdict"], "unplugged" in told["words"]) == ("failed", True)
    assert scan.wait() == 1


def test_tcp_car_is_named_and_warned_of(command: Command) -> None:
    car = TcpCar()
    try:
        found, done = _scan(command, car.link, more=("--for", "1"))
        assert done.stderr.startswith(f"note: {car.link}: ")
        assert "program dies" in done.stderr
        assert found[car.link]["verdict"] == "silent"
        assert car.received == []
    finally:
        car.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--for", "0"], "--for: 0 … 500ms"),
        (["--for", "nan"], '--for: "nan" … duration'),
        (["--link", "usb"], "not a link"),
    ],
)
def test_wrong_use_is_one_line(command: Command, arguments: list[str], words: str) -> None:
    done = command("scan", *arguments)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert has_parts(done.stderr, words)


def test_progress_is_for_a_terminal(stranger: Callable[[], SpeakingStranger]) -> None:
    silent = stranger()
    controller, device = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "gateway.cli", "scan", "--link", silent.link, "--for", "5"],
        stderr=device,
        stdout=subprocess.PIPE,
        text=True,
    ) as scan:
        shown = b""
        while not shown.endswith(b"\r\x1b[K") or shown.count(b"left") < 2:
            shown += os.read(controller, 4096)
        out, _ = scan.communicate(timeout=PATIENCE_S)
    os.close(device)
    os.close(controller)
    assert re.search(rb"opening and listening: 1 link, \d s left", shown)
    assert out.startswith(silent.link)


def _port(device: str, **known: Any) -> ListPortInfo:
    port = ListPortInfo(device)
    for name, value in known.items():
        setattr(port, name, value)
    return port


def test_url_of_a_port_is_the_one_that_lasts() -> None:
    uno = {"vid": 0x2341, "pid": 0x0043, "serial_number": "75 3/5", "description": "Arduino Uno"}
    clone = {"vid": 0x1A86, "pid": 0x7523, "serial_number": None}
    twins = {"vid": 0x10C4, "pid": 0xEA60, "serial_number": "0001"}
    ports = described(
        [
            _port("/dev/ttyUSB10", **twins),
            _port("/dev/ttyUSB9", **twins),
            _port("/dev/ttyUSB1", **clone),
            _port("/dev/ttyACM0", **uno),
            _port("/dev/ttyS0"),
        ],
        {"/dev/ttyUSB1": "/dev/serial/by-id/usb-1a86_USB_Serial-if00-port0", "/dev/ttyACM0": "/dev/serial/by-id/uno"},
    )
    assert [(port.device, port.url) for port in ports] == [
        ("/dev/ttyACM0", "serial://?vid=2341&serial=75%203%2F5"),
        ("/dev/ttyS0", "serial:///dev/ttyS0"),
        ("/dev/ttyUSB1", "serial:///dev/serial/by-id/usb-1a86_USB_Serial-if00-port0"),
        ("/dev/ttyUSB9", "serial:///dev/ttyUSB9"),
        ("/dev/ttyUSB10", "serial:///dev/ttyUSB10"),
    ]
    assert (ports[0].vid, ports[0].pid, ports[0].description) == ("2341", "0043", "Arduino Uno")
    assert (ports[1].vid, ports[1].description, ports[1].by_id) == (None, "", None)


def test_lasting_names_are_found_by_their_device(tmp_path: Path) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    names = tmp_path / "by-id"
    assert by_id(names) == {}
    names.mkdir()
    (names / "usb-car").symlink_to(device)
    assert by_id(names) == {str(device): str(names / "usb-car")}


@pytest.mark.skipif(sys.platform != "linux", reason="BlueZ is Linux's")
def test_bluetooth_devices_are_listed_likely_cars_first(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    from tests.support.bluez import BATTERY, FFF0, NORDIC, Adapter, FakeBluez, Module, free_address

    other = Module(free_address(), "Head\x1b[2Jset", BATTERY)
    car, nordic = Module(free_address(), "BT04"), Module(free_address(), "UART", NORDIC, found_after_list=True)
    clone = Module(free_address(), "Ebyte", FFF0, seen_by=frozenset({"hci1"}))
    bluez = FakeBluez(other, car, nordic, clone, adapters=[Adapter("hci0"), Adapter("hci1")])
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", bluez.address)
    try:
        shown = command("scan", "--for", "3")
        told = command("scan", "--for", "3", "--json")
    finally:
        bluez.close()
    assert shown.returncode == 0
    lines = shown.stdout.splitlines()
    at = lines.index(f"{car.address}  BT04, -50 dBm")
    assert "FFE0; not connected" in lines[at + 1]
    assert lines[at + 2] == f"  --link 'ble://{car.address}'"
    assert f"{nordic.address}  UART, -50 dBm" in lines
    assert lines[-1] == "1 other Bluetooth device (--json lists them)"
    devices = [each for each in map(json.loads, told.stdout.splitlines()) if each["kind"] == "ble"]
    assert [each["url"] for each in devices][3] == f"ble://{other.address}"
    assert {each["uart"] for each in devices} == {"FFE0", "FFF0", "6e400001-b5a3-f393-e0a9-e50e24dcca9e", None}


def test_without_bluetooth_the_ports_are_still_shown(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", "unix:path=/nowhere/bus")
    done = command("scan", "--for", "0.5")
    assert done.returncode == 0
    assert done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert "Bluetooth " in done.stderr

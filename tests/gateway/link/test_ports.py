"""Serial ports as people meet them: a second reader, a program that takes the adapter, a car that is off."""

import asyncio
import errno
import os
import re
import shutil
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from fleet.fleetfile.link_check import check_device
from gateway.link import CannotOpen, Link, LinkLost, open_link
from gateway.link.serial import why_not_open
from schemas.links import SerialUrl, UsbUrl
from schemas.process import serial_port_users, usb_bus
from tests.gateway.link.peers import PtyPeer
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/proc and /sys are Linux's")

FRAME = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"
STOP = b"$0,0,0,0,0,0,0,0,0#"
PATIENCE_S = 20.0


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[PtyPeer]:
    made = PtyPeer(tmp_path)
    yield made
    made.close()


# As a serial monitor does. `cat` would end at once at a port that a gateway has set up.
READ = """
import select, sys, os
port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
while True:
    select.select([port], [], [])
    try:
        os.read(port, 4096)
    except BlockingIOError:
        pass
"""


class Reader:
    """A program that reads at a port."""

    def __init__(self, port: Path) -> None:
        self.port = str(port.resolve())
        monitor = port.parent / "monitor.py"
        monitor.write_text(READ)
        self.process = subprocess.Popen([sys.executable, monitor, self.port])
        self.words = f"process {self.process.pid} ({' '.join([sys.executable, str(monitor), self.port])[:80]})"
        wait_for(lambda: self.words in serial_port_users.find_users(self.port), "it has the port open")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


async def until_trouble(link: Link, peer: PtyPeer) -> str:
    """Send until both have been woken for the same byte. Return what the link says."""

    async def read() -> None:
        while True:
            await link.read()

    reading = asyncio.create_task(read())
    async with asyncio.timeout(PATIENCE_S):
        while not link.trouble:
            await asyncio.to_thread(peer.send, FRAME)
    reading.cancel()
    await asyncio.gather(reading, return_exceptions=True)
    return link.trouble


async def test_second_program_at_port_is_named_and_stops_pass(peer: PtyPeer, tmp_path: Path) -> None:
    link = await open_link(peer.url)
    reader = Reader(tmp_path / "tty")
    try:
        words = await until_trouble(link, peer)
        assert words.startswith(f"another program reads {peer.url}, ")
        assert reader.words in words
        await link.write(STOP)
        assert peer.receive(len(STOP)) == STOP
    finally:
        reader.close()
    peer.send(FRAME)
    async with asyncio.timeout(PATIENCE_S):
        while b"GM10#" not in await link.read():
            pass
    await link.close()


async def test_hidden_second_program_is_found_with_a_command(
    peer: PtyPeer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programs of other users show their descriptors to root only."""
    link = await open_link(peer.url)
    reader = Reader(tmp_path / "tty")
    monkeypatch.setattr(serial_port_users, "find_users", lambda _path: [])
    try:
        words = await until_trouble(link, peer)
    finally:
        reader.close()
    assert f"`sudo fuser -v {tmp_path / 'tty'}`" in words
    await link.close()


async def test_unplugged_port_is_no_second_program(peer: PtyPeer) -> None:
    link = await open_link(peer.url)
    peer.die()
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(LinkLost, match="is gone: unplugged"):
            await link.read()
    assert link.trouble == ""
    await link.close()


async def test_program_with_open_port_is_found_on_request(peer: PtyPeer, tmp_path: Path) -> None:
    """A reader that is always faster leaves no empty read: the bytes are gone before the link wakes."""
    link = await open_link(peer.url)
    link.look_for_trouble()
    reader = Reader(tmp_path / "tty")
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not link.trouble:
                link.look_for_trouble()
                await asyncio.sleep(0)
    finally:
        reader.close()
    assert f"{peer.url} open" in link.trouble
    assert reader.words in link.trouble
    await link.close()


def test_gateway_says_which_program_takes_the_bytes(tmp_path: Path) -> None:
    started = FleetProcesses(free_endpoint(), tmp_path)
    try:
        _, (link,) = started.simulate("red:arduino:pty")
        gateway = started.gateway(link)
        started.ready()
        assert "port_shared" not in gateway.stderr, "the simulator is the other end, and no second program"
        (tmp_path / "tty").symlink_to(link.removeprefix("serial://"))
        reader = Reader(tmp_path / "tty")
        try:
            wait_for(lambda: started.state("link").rejects["port_shared"] == 1, "it is said")
            wait_for(lambda: reader.words in gateway.stderr, "it is named")
        finally:
            reader.close()
    finally:
        started.close()


def test_check_tells_port_opened_by_another(peer: PtyPeer, tmp_path: Path) -> None:
    reader = Reader(tmp_path / "tty")
    try:
        assert isinstance(peer.url, SerialUrl)
        ok, words = check_device(peer.url.path)
    finally:
        reader.close()
    assert ok
    assert reader.words in words
    assert words.startswith("there, permitted, free, but ")


@pytest.mark.parametrize("number", [112, 111, 113, 110, 5])
@pytest.mark.parametrize("path", ["/dev/rfcomm0", "link to it"])
def test_silent_classic_bluetooth_module_is_no_missing_port(number: int, path: str, tmp_path: Path) -> None:
    """Opening /dev/rfcomm0 connects. No test can have such a port: it needs a radio."""
    if path != "/dev/rfcomm0":
        (tmp_path / "red").symlink_to("/dev/rfcomm0")
        path = str(tmp_path / "red")
    url = SerialUrl(path)
    words = why_not_open(url, path, serial.SerialException(number, f"could not open port {path}"))
    assert f"{url}: the car is off, " in words
    assert f"({os.strerror(number).lower()})" in words
    assert "`bluetoothctl pair ADDRESS`" in words
    assert "car is off" in why_not_open(url, path, termios.error(5, "Input/output error"))
    assert "no such port" in why_not_open(url, path, OSError(errno.ENOENT, "no"))
    other = SerialUrl("/dev/ttyUSB0")
    assert "car is off" not in why_not_open(other, other.path, OSError(number, "no"))


@pytest.fixture
def adapter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a directory of USB devices as the kernel has it, with a hub and a CH340 that has its port."""
    devices = tmp_path / "usb"
    for name, vendor, product in (("usb1", "1d6b", "0002"), ("1-2", "1a86", "7523")):
        (devices / name).mkdir(parents=True)
        (devices / name / "idVendor").write_text(f"{vendor}\n")
        (devices / name / "idProduct").write_text(f"{product}\n")
    (devices / "1-2:1.0").mkdir()
    (devices / "1-2" / "1-2:1.0" / "ttyUSB0").mkdir(parents=True)
    monkeypatch.setattr(usb_bus, "DEVICES", devices)
    return devices / "1-2" / "1-2:1.0" / "ttyUSB0"


async def refused(url: SerialUrl | UsbUrl) -> str:
    with pytest.raises(CannotOpen) as caught:
        await open_link(url, timeout_s=PATIENCE_S)
    return str(caught.value)


async def test_ch340_without_a_port_is_said_and_brltty_named(adapter: Path, tmp_path: Path) -> None:
    missing = SerialUrl(str(tmp_path / "ttyUSB0"))
    assert "brltty" not in await refused(missing), "the adapter has its port"
    adapter.rmdir()  # noqa: ASYNC240 - nothing else runs in this loop
    plugged = "A CH340 adapter (1a86:7523) is plugged in and has no serial port: brltty, "
    maybe = f"{plugged}a program for Braille displays, may have taken it. Type `sudo apt remove brltty`"
    assert maybe in await refused(missing)
    assert "`sudo modprobe ch341`" in await refused(missing)
    shutil.copy("/bin/sleep", tmp_path / "brltty")
    with subprocess.Popen([tmp_path / "brltty", "60"]) as brltty:  # noqa: ASYNC220 - likewise
        try:
            wait_for(lambda: serial_port_users.is_running("brltty"), "it runs")
            has = f"{plugged}the program for Braille displays, has taken it. Type `sudo apt remove brltty`, then plug"
            assert (await refused(missing)).startswith(f"{missing}: no such port ")
            assert has in await refused(missing)
            assert f"serial port. {has}" in await refused(UsbUrl(vid=0x1A86))
            assert "brltty" not in await refused(UsbUrl(vid=0x2341)), "another kind of adapter"
            there, why = check_device(missing.path)
            assert not there
            assert why.endswith(usb_bus.explain_missing_port())
        finally:
            brltty.kill()
    assert re.search(r"Braille displays, has", usb_bus.explain_missing_port()) is None

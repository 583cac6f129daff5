"""URLs, and links that cannot be opened: the message has one line with fault, place and remedy."""

import asyncio
import grp
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import serial

from gateway.link import BadUrl, CannotOpen, open_link, parse_url
from gateway.link.tcp import connect_first
from schemas.links import BleUrl, LinkUrl, SerialUrl, TcpUrl, UsbUrl
from schemas.process.serial_port_permission import permission_hint
from tests.gateway.link.peers import PtyPeer, no_threads
from tests.support.text_parts import has_parts

NULL_BYTE = "(embedded null byte)" if sys.version_info < (3, 14) else "(open: embedded null character in path)"
"""Python's own words."""


@pytest.mark.parametrize(
    ("text", "url", "written"),
    [
        ("/dev/ttyUSB0", SerialUrl("/dev/ttyUSB0"), "serial:///dev/ttyUSB0"),
        ("/dev/serial/by-id/usb-1a86_USB", SerialUrl("/dev/serial/by-id/usb-1a86_USB"), None),
        ("serial:///dev/ttyUSB0", SerialUrl("/dev/ttyUSB0"), "serial:///dev/ttyUSB0"),
        ("serial:///dev/ttyUSB0?baud=115200", SerialUrl("/dev/ttyUSB0", 115200), "serial:///dev/ttyUSB0?baud=115200"),
        ("serial:///dev/ttyUSB0?baud=9600", SerialUrl("/dev/ttyUSB0"), "serial:///dev/ttyUSB0"),
        ("COM3", SerialUrl("COM3"), "serial://COM3"),
        ("serial://COM12", SerialUrl("COM12"), "serial://COM12"),
        ("serial://?vid=1a86", UsbUrl(0x1A86), "serial://?vid=1a86"),
        (
            "serial://?vid=0x1A86&pid=0x7523&serial=A%20%231+",
            UsbUrl(0x1A86, 0x7523, "A #1+"),
            "serial://?vid=1a86&pid=7523&serial=A%20%231%2B",
        ),
        ("serial:///?serial=ABC&baud=115200", UsbUrl(serial="ABC", baud=115200), "serial://?serial=ABC&baud=115200"),
        ("serial://?vid=2341", UsbUrl(0x2341), "serial://?vid=2341"),
        ("ble://aa:bb:cc:dd:ee:0f", BleUrl("AA:BB:CC:DD:EE:0F"), "ble://AA:BB:CC:DD:EE:0F"),
        (
            "ble://6e400001-b5a3-f393-e0a9-e50e24dcca9e",
            BleUrl("6E400001-B5A3-F393-E0A9-E50E24DCCA9E"),
            "ble://6E400001-B5A3-F393-E0A9-E50E24DCCA9E",
        ),
        ("ble://name=BT04", BleUrl(name="BT04"), "ble://name=BT04"),
        ("ble://name=a?b?adapter=auto", BleUrl(name="a?b", adapter="auto"), "ble://name=a%3Fb?adapter=auto"),
        (
            "ble://aa:bb:cc:dd:ee:0f?adapter=hci1",
            BleUrl("AA:BB:CC:DD:EE:0F", adapter="hci1"),
            "ble://AA:BB:CC:DD:EE:0F?adapter=hci1",
        ),
        ("BLE://name=My%20Car%2F1?", BleUrl(name="My Car/1?"), "ble://name=My%20Car%2F1%3F"),
        ("tcp://192.168.1.7:8888", TcpUrl("192.168.1.7", 8888), "tcp://192.168.1.7:8888"),
        ("tcp://car.local:1", TcpUrl("car.local", 1), "tcp://car.local:1"),
        ("tcp://[::1]:65535", TcpUrl("::1", 65535), "tcp://[::1]:65535"),
    ],
)
def test_link_url_round_trip(text: str, url: LinkUrl, written: str | None) -> None:
    assert parse_url(text) == url
    assert parse_url(str(url)) == url
    assert written is None or str(url) == written


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not a link"),
        ("ttyUSB0", "not a link. … mean /dev/ttyUSB0? `fleet scan`"),
        ("COM", "not a link"),
        ("bel://A4:C1:38:00:00:01", "not a link. … mean ble://A4:C1:38:00:00:01? `fleet scan`"),
        ("serial://", "no device"),
        ("serial:///", "no device"),
        ("serial://dev/ttyUSB0", "three slashes"),
        ("serial:///dev/ttyUSB0#x", "write # as %23"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud=fast is not from 300 to 4000000"),
        ("serial:///dev/ttyUSB0?baud=", "baud= is not from"),
        ("serial:///dev/ttyUSB0?baud=0", "baud=0 is not from"),
        ("serial:///dev/ttyUSB0?baud=9600.0", "baud=9600.0 is not from"),
        ("serial:///dev/ttyUSB0?baud=" + "9" * 5000, "is not from 300 to 4000000"),
        ("serial:///dev/ttyUSB0?parity=odd", "parity"),
        ("serial:///dev/ttyUSB0?vid=1a86", "both a device path and vid"),
        ("serial://?baud=9600", "no device"),
        ("serial://?vid=6790&vid=1a86", "vid … twice"),
        ("serial://?vid=", "vid= … hexadecimal digits"),
        ("serial://?vid=0x1a8", "vid=0x1a8 … hexadecimal digits"),
        ("serial://?pid=29987", "pid=29987 … hexadecimal digits"),
        ("serial://?pid=-001", "pid=-001 is not four"),
        ("serial://?serial=", "serial= is empty"),
        ("ble://", "neither a Bluetooth address … name="),
        ("ble://BT04", "neither a Bluetooth address … name="),
        ("ble://AA:BB:CC:DD:EE", "neither a Bluetooth address"),
        ("ble://AA:BB:CC:DD:EE:FF/x", "neither a Bluetooth address"),
        ("ble://AA:BB:CC:DD:EE:FF?adapter=", "adapter=auto"),
        ("ble://AA:BB:CC:DD:EE:FF?adapter=eth0", "adapter=eth0"),
        ("ble://?adapter=hci1", "neither a Bluetooth address"),
        ("ble://name=", "1 to 248 bytes, … printable"),
        ("ble://name=a%0Ab", "1 to 248 bytes, … printable"),
        ("ble://name=" + "x" * 249, "a name must have 1 to 248 bytes"),
        ("tcp://", "a host … port from 1 to 65535"),
        ("tcp://host", "port is missing. … tcp://host:8888"),
        ("tcp://:8888", "a host … port"),
        ("tcp://host:0", "a host … port"),
        ("tcp://host:65536", "Port out … range"),
        ("tcp://host:x", "Port … cast"),
        ("tcp://host:8888/path", "nothing … the port"),
        ("tcp://host:8888?x=1", "nothing … the port"),
        ("tcp://me@host:8888", "nothing … the port"),
        ("tcp://[::1:8888", "Invalid IPv6 URL"),
        ("http://host:80", "not a link. `fleet scan`"),
        ("/dev/tty\nUSB0", "cannot be printed"),
        ("/dev/tty\x00USB0", "cannot be printed"),
        ("tcp://ho\nst:80", "cannot be printed"),
    ],
)
def test_bad_url_error_in_one_line(text: str, why: str) -> None:
    with pytest.raises(BadUrl) as caught:
        parse_url(text)
    words = str(caught.value)
    assert has_parts(words, why)
    assert len(words) < 200
    assert "\n" not in words


async def refused(url: LinkUrl, timeout_s: float = 20.0) -> str:
    with pytest.raises(CannotOpen) as caught:
        await open_link(url, timeout_s=timeout_s)
    words = str(caught.value)
    assert words.startswith(f"{url}: ")
    assert "\n" not in words
    return words


async def test_unopenable_serial_port_is_refused(tmp_path: Path) -> None:
    assert "no such port" in await refused(SerialUrl(str(tmp_path / "ttyUSB9")))
    assert "no such port" in await refused(SerialUrl(str(tmp_path / "no" / "ttyUSB9")))
    assert "is a directory" in await refused(SerialUrl(str(tmp_path)))
    regular = tmp_path / "file"
    regular.write_text("not a port")
    assert "not a serial port (" in await refused(SerialUrl(str(regular)))
    assert "not a serial port (" in await refused(SerialUrl("/dev/null"))
    assert "no such port" in await refused(SerialUrl("COM99"))
    assert NULL_BYTE in await refused(SerialUrl("/dev/tty\0"))
    await no_threads()


async def test_serial_port_in_use_names_process(tmp_path: Path) -> None:
    peer = PtyPeer(tmp_path)
    with serial.Serial(str(tmp_path / "tty"), exclusive=True):
        assert f"by process {os.getpid()} (" in await refused(peer.url)
    link = await open_link(peer.url)
    await link.close()
    peer.close()


WITHOUT_PERMISSION = """
import asyncio, grp, os, sys  # all of it now: nobody may not even read the library
from gateway.link import CannotOpen, open_link
from gateway.link.tcp import connect_first
from schemas.links import SerialUrl
import gateway.link.serial, serial.tools.list_ports
os.setgroups([]); os.setgid(65534); os.setuid(65534)
try:
    asyncio.run(open_link(SerialUrl(sys.argv[1])))
except CannotOpen as error:
    print(error)
"""


@pytest.mark.parametrize("may_use", [True, False])
def test_serial_port_without_permission_names_group_that_may_use_it(tmp_path: Path, *, may_use: bool) -> None:
    """Root may open any port, so a process of the user nobody tries. Other users try in this process."""
    peer = PtyPeer(tmp_path)
    port = (tmp_path / "tty").resolve()
    port.chmod(0o060 if may_use else 0)
    script = WITHOUT_PERMISSION
    if os.getuid() == 0:
        os.chown(port, -1, grp.getgrnam("tty").gr_gid)
    else:
        script = script.replace("os.setgroups([]); os.setgid(65534); os.setuid(65534)", "")
    group = grp.getgrgid(port.stat().st_gid).gr_name
    done = subprocess.run(
        [sys.executable, "-c", script, str(port)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr == ""
    assert done.stdout.startswith(f"serial://{port}: no permission. ")
    assert (f"`sudo usermod -aG {group} $USER`" in done.stdout) is may_use
    peer.close()


def test_nobody_is_told_to_join_group_root(tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.touch(0o660)
    if os.getuid() == 0:
        os.chown(port, 0, 0)
        assert "usermod" not in permission_hint(str(port))
    assert "usermod" not in permission_hint(str(tmp_path / "none"))


async def test_unreachable_tcp_car_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: refuses, and no other process gets the port
        words = await refused(TcpUrl("127.0.0.1", taken.getsockname()[1]))
        assert "nothing listens" in words
        assert "may be driving" in words
    assert "no host 'no.such.car.invalid'" in await refused(TcpUrl("no.such.car.invalid", 1))
    assert "no host" in await refused(TcpUrl("a" * 64, 8888))
    assert "no host" in await refused(TcpUrl("a..b", 8888))


async def test_host_with_several_addresses_is_tried_on_each() -> None:
    """The text of asyncio itself would be "Multiple exceptions", without the number that identifies a refusal."""
    with socket.socket() as taken, socket.create_server(("127.0.0.1", 0)) as server:
        taken.bind(("127.0.0.1", 0))
        nobody = (socket.AF_INET, taken.getsockname())
        url = TcpUrl("several", server.getsockname()[1])
        with pytest.raises(ConnectionRefusedError):
            await connect_first(url, [nobody, nobody])
        link = await connect_first(url, [nobody, (socket.AF_INET, server.getsockname())])
        await link.close()


ONLY_WHAT_IS_NEEDED = """
import asyncio, sys
from gateway.link import open_link, parse_url
link = asyncio.run(open_link(parse_url(sys.argv[1])))
print(*(name in sys.modules for name in ("serial", "serial.tools", "bleak")))
"""


def test_link_kind_imports_only_its_library(tmp_path: Path) -> None:
    """A fleet starts up to a hundred gateways, and each would pay for an unused import."""
    peer = PtyPeer(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        for url, said in (
            (TcpUrl("127.0.0.1", server.getsockname()[1]), "False False False\n"),
            (SerialUrl(str((tmp_path / "tty").resolve())), "True False False\n"),
        ):
            done = subprocess.run(
                [sys.executable, "-c", ONLY_WHAT_IS_NEEDED, str(url)],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert (done.stdout, done.stderr) == (said, "")
    peer.close()


WITHOUT_BLEAK = """
import sys
sys.modules["bleak"] = None  # as if it were not installed
from gateway.cli import main
sys.argv[1:] = ["run", "--car", "red", "--link", "ble://AA:BB:CC:DD:EE:FF", "--retry"]
main()
"""


def test_missing_bluetooth_is_one_line_and_starts_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_BLEAK], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("gateway: link 'ble://AA:BB:CC:DD:EE:FF' ")
    assert done.stderr.endswith("pip install 'zenoh-car-fleet[ble]' (from a clone: pip install '.[ble]')\n")


WITH_A_SILENT_NAME_SERVER = """
import asyncio, socket, sys, threading
from gateway.link import CannotOpen, open_link
from schemas.links import TcpUrl
socket.getaddrinfo = lambda *_, **__: threading.Event().wait()  # nothing can end it
async def main():
    for _ in range(3):
        try:
            await open_link(TcpUrl("car.local", 8888), timeout_s=0.1)
        except CannotOpen as error:
            print(error)
    print(sum(thread is not threading.main_thread() for thread in threading.enumerate()))
asyncio.run(main())
"""


def test_hung_name_server_holds_one_thread_not_process_end() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITH_A_SILENT_NAME_SERVER], capture_output=True, text=True, timeout=60, check=False
    )
    words = "tcp://car.local:8888: no answer within 0.1 s. Is the car on, and in this network?\n"
    assert (done.stdout, done.stderr) == (3 * words + "1\n", "")


async def test_late_name_server_answer_serves_next_try(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = threading.Event()
    ask = socket.getaddrinfo

    def late(*arguments: Any, **more: Any) -> Any:
        assert answered.wait(20.0)
        return ask(*arguments, **more)

    monkeypatch.setattr(socket, "getaddrinfo", late)
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = TcpUrl("127.0.0.1", server.getsockname()[1])
        await refused(url, timeout_s=0.1)
        answered.set()
        for _ in range(2):
            link = await open_link(url, timeout_s=20.0)
            await link.close()


async def test_tcp_connect_has_timeout() -> None:
    """A listener with a full queue drops new connections, and is as silent as a car that is off."""
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        where = full.getsockname()
        waiting = []
        for _ in range(4):
            each = socket.socket()
            each.setblocking(False)
            each.connect_ex(where)
            waiting.append(each)
        words = await refused(TcpUrl(*where), timeout_s=0.5)
        assert "within 0.5 s" in words
        for each in waiting:
            each.close()


async def test_opening_that_is_given_up_leaves_no_port_open(tmp_path: Path) -> None:
    peer = PtyPeer(tmp_path)
    opening = asyncio.create_task(open_link(peer.url))
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await no_threads()
    again = await open_link(peer.url)
    await again.close()
    peer.close()

"""Each opening finds a USB device by its description: none, one, several, and after a replug."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from gateway.link import CannotOpen, LinkLost, open_link, parse_url
from gateway.link.usb import ListedPort, choose
from schemas.links import SerialUrl, UsbUrl
from tests.gateway.link.peers import PtyPeer

CH340 = ListedPort("/dev/ttyUSB0", 0x1A86, 0x7523)
UNO_1 = ListedPort("/dev/ttyACM0", 0x2341, 0x0043, "7573")
UNO_2 = ListedPort("/dev/ttyACM1", 0x2341, 0x0043, "9912")
BOARD = ListedPort("/dev/ttyS0")
THERE = [UNO_2, CH340, BOARD, UNO_1]
PATIENCE_S = 20.0
FRAME = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"

Usb = Callable[..., None]


@pytest.mark.parametrize(
    ("url", "device"),
    [
        (UsbUrl(vid=0x1A86), "/dev/ttyUSB0"),
        (UsbUrl(pid=0x7523), "/dev/ttyUSB0"),
        (UsbUrl(serial="9912"), "/dev/ttyACM1"),
        (UsbUrl(0x2341, 0x0043, "7573"), "/dev/ttyACM0"),
    ],
)
def test_one_fits(url: UsbUrl, device: str) -> None:
    assert choose(url, THERE).device == device


@pytest.mark.parametrize(
    ("url", "there", "words"),
    [
        (
            UsbUrl(0x1A86, serial="1"),
            THERE[:3],
            (
                "serial://?vid=1a86&serial=1: no such USB device is plugged in; there are: /dev/ttyACM1 (2341:0043 "
                "serial number 9912), /dev/ttyS0 (no USB device), /dev/ttyUSB0 (1a86:7523)"
            ),
        ),
        (UsbUrl(0x1A86), [], "serial://?vid=1a86: no such USB device is plugged in; no serial port is plugged in"),
        (
            UsbUrl(0x2341, 0x0043),
            THERE,
            (
                "serial://?vid=2341&pid=0043: 2 devices fit, /dev/ttyACM0 (2341:0043 serial number 7573), /dev/ttyACM1 "
                "(2341:0043 serial number 9912): add the serial= of one of them"
            ),
        ),
        (
            UsbUrl(1),
            [ListedPort("/dev/x", 2, 3, "a\n\x1b[1m")],
            "there are: /dev/x (0002:0003 serial number a??[1m)",
        ),
    ],
)
def test_none_or_several_is_one_line(url: UsbUrl, there: list[ListedPort], words: str) -> None:
    with pytest.raises(CannotOpen) as caught:
        choose(url, there)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that sets the system's list of ports, in pyserial's own type. A real list has no PTY."""

    def listed(*ports: ListedPort) -> None:
        found = []
        for port in ports:
            info = ListPortInfo(port.device)
            info.vid, info.pid, info.serial_number = port.vid, port.pid, port.serial
            found.append(info)
        monkeypatch.setattr(list_ports, "comports", lambda: found)

    return listed


async def test_device_that_comes_back_under_another_number_is_found(tmp_path: Path, plug: Usb) -> None:
    (tmp_path / "ACM0").mkdir()
    (tmp_path / "ACM1").mkdir()
    first, second = PtyPeer(tmp_path / "ACM0"), PtyPeer(tmp_path / "ACM1")
    url = parse_url("serial://?vid=2341&serial=7573")
    plug(CH340, ListedPort(path(first), 0x2341, 0x0043, "7573"))
    link = await open_link(url)
    first.die()
    plug(CH340)
    with pytest.raises(LinkLost, match="is gone: unplugged"):
        await link.read()
    with pytest.raises(CannotOpen, match=r"no such USB device .*: /dev/ttyUSB0"):
        await open_link(url)
    await link.close()
    plug(ListedPort(path(second), 0x2341, 0x0043, "7573"), CH340)
    link = await open_link(url)
    second.send(FRAME)
    assert await link.read() == FRAME
    await link.close()
    second.close()


@pytest.mark.parametrize("asked", ["serial://?vid=2341", "serial:///no/such/ttyACM0"])
@pytest.mark.parametrize("failure", [TypeError("int() can't convert None"), OSError(19, "No such device"), KeyError()])
async def test_device_vanishing_during_listing_costs_one_try(
    asked: str, failure: Exception, tmp_path: Path, plug: Usb, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The numbers of a device are in files that disappear with it. After a failed read, the next try must not hang."""

    def half_gone() -> list[ListPortInfo]:
        raise failure

    monkeypatch.setattr(list_ports, "comports", half_gone)
    for _ in range(2):
        with pytest.raises(CannotOpen, match=r"cannot be listed|cannot be opened"):
            await open_link(parse_url(asked), timeout_s=PATIENCE_S)
    peer = PtyPeer(tmp_path)
    plug(ListedPort(path(peer), 0x2341, 0x0043, "7573"))
    link = await open_link(UsbUrl(vid=0x2341))
    await link.close()
    peer.close()


async def test_listing_that_fails_once_is_asked_for_again(
    tmp_path: Path, plug: Usb, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = PtyPeer(tmp_path)
    plug(ListedPort(path(peer), 0x2341, 0x0043, "7573"))
    whole, failures = list_ports.comports, [TypeError("half gone")]
    monkeypatch.setattr(list_ports, "comports", lambda: _raise(failures.pop()) if failures else whole())
    link = await open_link(UsbUrl(pid=0x0043))
    await link.close()
    peer.close()


def _raise(error: Exception) -> list[ListPortInfo]:
    raise error


@pytest.mark.parametrize("named", ["serial://?vid=2341&pid=0a0a", "PATH"])
async def test_other_usb_device_in_same_place_is_not_opened(named: str, tmp_path: Path, plug: Usb) -> None:
    peer = PtyPeer(tmp_path)
    url = parse_url(named.replace("PATH", path(peer)))
    device = str((tmp_path / "tty").resolve())
    first, second = (ListedPort(device, 0x2341, 0x0A0A, number) for number in ("7573", "99\n12"))
    plug(CH340, first)
    await (await open_link(url)).close()
    plug(CH340, second)
    with pytest.raises(CannotOpen) as caught:
        await open_link(url)
    assert str(caught.value).startswith(
        f"{url}: {device} (2341:0a0a serial number 99?12) is another device than before, "
    )
    assert f"{device} (2341:0a0a serial number 7573)" in str(caught.value)
    plug(first)
    await (await open_link(url)).close()
    peer.close()


async def test_path_whose_device_is_not_listed_any_more(tmp_path: Path, plug: Usb) -> None:
    """The path is gone, or leads to a device that the system does not describe."""
    peer = PtyPeer(tmp_path)
    plug(ListedPort(str((tmp_path / "tty").resolve()), 0x2341, 0x0043, "1"))
    await (await open_link(peer.url)).close()
    plug(CH340)
    with pytest.raises(CannotOpen, match=f"{path(peer)}, which the system does not list, may be another device"):
        await open_link(peer.url)
    peer.close()
    with pytest.raises(CannotOpen, match="no such port"):
        await open_link(peer.url)


async def test_ports_that_say_nothing_of_themselves_are_all_the_same(tmp_path: Path, plug: Usb) -> None:
    peer = PtyPeer(tmp_path)
    plug(ListedPort(str((tmp_path / "tty").resolve())))
    await (await open_link(peer.url)).close()
    plug(CH340)
    await (await open_link(peer.url)).close()
    peer.close()


async def test_usb_error_names_url_and_port(tmp_path: Path, plug: Usb) -> None:
    gone = str(tmp_path / "ttyACM0")
    plug(ListedPort(gone, 1, 2, "3"))
    with pytest.raises(CannotOpen) as caught:
        await open_link(UsbUrl(serial="3"))
    assert str(caught.value).startswith(f"serial://?serial=3: {gone}: no such port ")
    assert f": {gone}. " in str(caught.value)


async def test_path_by_id_resolves_to_current_port(tmp_path: Path) -> None:
    """As with /dev/serial/by-id, the symlink points to another port. The first port still exists, but is dead."""
    peer = PtyPeer(tmp_path)
    link = await open_link(peer.url)
    peer.die()
    with pytest.raises(LinkLost):
        await link.read()
    peer.revive()  # the old port is still open, so the system assigns another one
    await link.close()
    link = await open_link(peer.url)
    peer.send(FRAME)
    async with asyncio.timeout(20):
        assert await link.read() == FRAME
    await link.close()
    peer.close()


def path(peer: PtyPeer) -> str:
    assert isinstance(peer.url, SerialUrl)
    return peer.url.path

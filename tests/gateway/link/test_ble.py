"""Behavior of Bluetooth LE only: kinds of modules, pieces, names, and a service that hangs, dies or remembers."""

import asyncio
import gc
import os
import subprocess
import sys
from collections.abc import AsyncIterator

import pytest

from gateway.link import Busy, CannotOpen, Link, LinkLost, ble, open_link
from gateway.link.buffered_link import MAX_BUFFERED_BYTES
from schemas.links import BleUrl
from tests.gateway.link.peers import BlePeer, open_descriptors, settled

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="BlueZ is Linux's; elsewhere bleak asks the system")

KINDS = {}
if sys.platform == "linux":
    from tests.support.bluez import BATTERY, FFE0, FFF0, NORDIC, SEPARATE, TWO_SERVICES, Module, free_address

    KINDS = {
        "FFE1": FFE0,
        "FFE1 and FFE2, written with response": SEPARATE,
        "FFE4, and FFE9 in another service": TWO_SERVICES,
        "FFF1, and FFF2": FFF0,
        "Nordic": NORDIC,
        "behind another that notifies": BATTERY + FFE0,
    }

LED = b"$4WD,CLR255,CLG128,CLB100#"
READING = b"$4WD,CSB125,PV8.3,GS214,LF1011,HW01,GM10#"
PATIENCE_S = 20.0


@pytest.fixture
async def peer() -> AsyncIterator[BlePeer]:
    made = BlePeer()
    yield made
    made.close()
    await settled()


@pytest.fixture
async def link(peer: BlePeer) -> AsyncIterator[Link]:
    opened = await open_link(peer.url)
    yield opened
    await opened.close()


async def read(link: Link, size: int) -> bytes:
    data = b""
    async with asyncio.timeout(PATIENCE_S):
        while len(data) < size:
            data += await link.read()
    return data


async def refused(peer: BlePeer, url: BleUrl | None = None, timeout_s: float = PATIENCE_S) -> str:
    url = url or BleUrl(peer.module.address)
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(CannotOpen) as caught:
            await open_link(url, timeout_s=timeout_s)
    words = str(caught.value)
    assert words.startswith(f"{url}")
    assert "\n" not in words
    return words


@pytest.mark.parametrize("gatt", KINDS.values(), ids=KINDS)
async def test_ble_module_kinds_read_and_write(peer: BlePeer, gatt: tuple[object, ...]) -> None:
    peer.module.gatt = gatt  # type: ignore[assignment]  # as the constants are
    link = await open_link(peer.url)
    await link.write(LED)
    assert peer.module.pieces == [LED[:20], LED[20:]]
    peer.send(READING)
    assert await read(link, len(READING)) == READING
    await link.close()


async def test_ble_clone_is_written_at_fff2(peer: BlePeer) -> None:
    """Ebyte's modules and their clones: FFF1 notifies, FFF2 is written, even if FFF1 takes bytes as well."""
    peer.module.gatt = FFF0
    link = await open_link(peer.url)
    await link.write(LED)
    assert peer.module.written_to == {FFF0[0][1][1][0]}
    await link.close()


async def test_ble_frame_is_split_by_mtu(peer: BlePeer) -> None:
    """The fake rejects a longer piece, as BlueZ does."""
    for mtu, pieces in ((23, [LED[:20], LED[20:]]), (28, [LED[:25], LED[25:]]), (185, [LED])):
        peer.module.mtu = mtu
        link = await open_link(peer.url)
        await link.write(LED)
        assert peer.module.pieces == pieces
        peer.module.pieces.clear()
        await link.close()


@pytest.mark.parametrize("fault", ["refuses", "takes"])
async def test_ble_write_failure_loses_link_and_nothing_follows(link: Link, peer: BlePeer, fault: str) -> None:
    if fault == "takes":
        peer.stall_after(1)
    else:
        peer.module.refuses = 1
    waiting = [asyncio.create_task(link.write(LED)) for _ in range(3)]
    errors = await asyncio.gather(*waiting, return_exceptions=True)
    assert all(isinstance(error, LinkLost) for error in errors), errors
    peer.module.takes = peer.module.refuses = None
    assert len({str(error) for error in errors}) == 1, "the first cause is kept"
    with pytest.raises(LinkLost):
        await link.write(LED)
    with pytest.raises(LinkLost):
        await link.read()
    assert peer.module.pieces == [LED[:20]]


async def test_cancelled_ble_write_loses_link(link: Link, peer: BlePeer) -> None:
    peer.module.takes = 1
    writing = asyncio.create_task(link.write(LED))
    await asyncio.to_thread(peer.receive, 20)
    writing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await writing
    with pytest.raises(LinkLost, match="accepts no bytes"):
        await link.write(LED)


async def test_by_name(peer: BlePeer) -> None:
    peer.bluez.modules += [Module(free_address(), "BT05"), Module(free_address(), "Watch", BATTERY)]
    link = await open_link(BleUrl(name="BT04"))
    peer.send(READING)
    assert await read(link, len(READING)) == READING
    await link.close()
    words = await refused(peer, BleUrl(name="BT4"), timeout_s=3.0)
    assert "no such device" in words
    assert "Found: " in words
    assert f"{peer.module.address} (BT04), {peer.bluez.modules[1].address} (BT05). (waited 3 s)" in words


@pytest.mark.parametrize("named", [False, True])
async def test_module_found_while_bleak_starts_is_not_missed(peer: BlePeer, *, named: bool) -> None:
    peer.module.found_after_list = True
    link = await open_link(BleUrl(name="BT04") if named else peer.url, timeout_s=PATIENCE_S)
    peer.send(READING)
    assert await read(link, len(READING)) == READING
    await link.close()


async def test_of_several_with_one_name_none_is_taken(peer: BlePeer) -> None:
    """Another gateway is connected to one of them. The connected module does not advertise, but counts."""
    first = await open_link(peer.url)
    other = Module(free_address(), "BT04")
    peer.bluez.modules.append(other)
    words = await refused(peer, BleUrl(name="BT04"))
    assert "2 devices" in words
    assert words.endswith(f"ble://{peer.module.address}, ble://{other.address}")
    await first.close()


async def test_ble_module_that_does_not_connect_is_refused(peer: BlePeer) -> None:
    peer.module.connects = False
    words = await refused(peer, timeout_s=3.0)
    assert f"{peer.module.address} is there" in words
    assert not peer.module.waiting, "the try was ended"
    peer.module.connects = True
    await (await open_link(peer.url)).close()


async def test_ble_disconnect_has_timeout(peer: BlePeer, monkeypatch: pytest.MonkeyPatch) -> None:
    """BlueZ answers neither Connect nor Disconnect. bleak alone would wait forever."""
    monkeypatch.setattr(ble, "DISCONNECT_TIMEOUT_S", 0.2)
    peer.module.connects = peer.module.leaves = False
    await refused(peer, timeout_s=0.5)
    assert not [task for task in asyncio.all_tasks() if "BleLink" in repr(task)], "nothing goes on in secret"
    peer.module.connects = True
    link = await open_link(peer.url)
    async with asyncio.timeout(PATIENCE_S):
        await link.close()
    with pytest.raises(LinkLost, match="was closed"):
        await link.read()


async def test_ble_module_without_notifications_is_refused(peer: BlePeer) -> None:
    peer.module.notifies = False
    assert "sends nothing" in await refused(peer, timeout_s=3.0)
    assert not peer.module.connected, "it can be found again"


async def test_ble_device_without_uart_is_refused(peer: BlePeer) -> None:
    peer.module.gatt = BATTERY
    assert f"(FFE0, FFF0, Nordic's). It has: {BATTERY[0][0]}" in await refused(peer)
    assert not peer.module.connected


async def test_missing_bluetooth_service_is_reported(peer: BlePeer) -> None:
    peer.bluez.kill()
    words = await refused(peer)
    assert "[org.freedesktop.DBus.Error.ServiceUnknown]" in words
    assert "adapter" in words


async def test_powered_off_bluetooth_adapter_is_reported(peer: BlePeer) -> None:
    peer.bluez.powered = False
    assert "powered Bluetooth adapters" in await refused(peer)


async def test_missing_system_bus_is_reported(peer: BlePeer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", "unix:path=/nonexistent/bus")
    assert "Bluetooth cannot be used, [Errno 2] " in await refused(peer)


KILLED = """
import asyncio, os, signal, sys
from gateway.link import open_link, parse_url
async def main():
    await open_link(parse_url(sys.argv[1]))
    os.kill(os.getpid(), signal.SIGKILL)
asyncio.run(main())
"""


@pytest.mark.parametrize("named", [False, True])
async def test_module_of_killed_gateway_is_taken_over(peer: BlePeer, *, named: bool) -> None:
    """A connected module does not advertise, so a scan alone would never find it again."""
    done = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", KILLED, str(peer.url)], env=os.environ, timeout=60, check=False
    )
    assert done.returncode == -9
    assert peer.module.connected
    link = await open_link(BleUrl(name="BT04") if named else peer.url)
    peer.send(READING)
    assert await read(link, len(READING)) == READING
    await link.close()
    assert not peer.module.connected


async def test_dead_bluetooth_service_is_noticed_and_found_again(peer: BlePeer) -> None:
    """No callback of bleak reports the end of the service. After the restart, bleak still reports a connection."""
    link = await open_link(peer.url)
    peer.bluez.kill()
    with pytest.raises(LinkLost, match=r"is gone: .*ServiceUnknown"):
        await link.write(LED)
    await link.close()
    await refused(peer, timeout_s=5.0)
    peer.bluez.restart()
    link = await open_link(peer.url)
    peer.send(READING)
    assert await read(link, len(READING)) == READING
    await link.close()


async def test_ble_link_reopens_after_bluetooth_service_restart(peer: BlePeer) -> None:
    """The restarted service has no connection, although bleak remembers one."""
    link = await open_link(peer.url)
    peer.bluez.kill()
    peer.bluez.restart()
    await link.close()
    link = await open_link(peer.url)
    await link.write(LED)
    assert peer.receive(len(LED)) == LED
    await link.close()


async def test_more_than_is_read_ends_the_link_and_is_bounded(link: Link, peer: BlePeer) -> None:
    """Radio has no flow control. The link still returns the received bytes, then raises the cause of its end."""
    size = MAX_BUFFERED_BYTES + 20_000
    peer.module.mtu = 515
    await asyncio.to_thread(peer.send, b"x" * size)

    async def write_on() -> None:
        while True:
            await link.write(LED)

    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(LinkLost, match="65536 bytes wait"):
            await write_on()
        assert MAX_BUFFERED_BYTES < len(await link.read()) <= MAX_BUFFERED_BYTES + 512
        with pytest.raises(LinkLost, match="sends faster"):
            await link.read()


async def test_opening_that_is_given_up_leaves_nothing(peer: BlePeer) -> None:
    await (await open_link(peer.url)).close()
    before = open_descriptors()
    given_up = 0
    for turns in range(0, 60, 3):
        opening = asyncio.create_task(open_link(peer.url))
        for _ in range(turns):
            await asyncio.sleep(0)
        opening.cancel()
        try:
            await (await opening).close()  # the link had opened before the cancellation
        except asyncio.CancelledError:
            given_up += 1
        assert not peer.module.waiting
    assert given_up
    async with asyncio.timeout(PATIENCE_S):
        while len(open_descriptors()) > len(before):  # this process also has the descriptors of the other ends
            gc.collect()
            await asyncio.sleep(0.01)
    link = await open_link(peer.url)
    with pytest.raises(Busy):
        await open_link(peer.url)
    await link.close()

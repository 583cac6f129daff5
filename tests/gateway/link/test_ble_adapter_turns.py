"""Several cars on the Bluetooth adapters of one computer: turns, room, and gateways that die."""

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from gateway.link import CannotOpen, Link, LinkUrl, open_link
from gateway.link.ble_adapter_turns import Turn
from gateway.link.bluez import list_connections
from schemas.bluetooth import ADAPTER_CONNECTIONS
from schemas.links import BleUrl
from schemas.process.file_lock import FileLock
from tests.gateway.link.peers import BlePeer, settled
from tests.gateway.link.test_ble import KILLED
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, driving, wait_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="BlueZ is Linux's; elsewhere bleak asks the system")

if sys.platform == "linux":
    from tests.support.bluez import Adapter, Module, free_address

STOP = b"$0,0,0,0,0,0,0,0,0#"
PATIENCE_S = 20.0
CARS = 8


@pytest.fixture
async def peer() -> AsyncIterator[BlePeer]:
    made = BlePeer(Adapter("hci0"), Adapter("hci1"))
    yield made
    made.close()
    await settled()


def more(peer: BlePeer, count: int, adapter: Adapter | None = None) -> list[Module]:
    """Add modules. With an adapter, another program is connected to them."""
    made = [Module(free_address(), f"M{number}") for number in range(count)]
    for each in made:
        each.adapter = adapter
        each.known |= set() if adapter is None else {adapter.name}
    peer.bluez.modules += made
    return made


async def refused(url: LinkUrl) -> str:
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(CannotOpen) as caught:
            await open_link(url)
    return str(caught.value)


# ---------------------------------------------------------------------- turns


def test_ble_turn_of_moving_car_goes_first(tmp_path: Path) -> None:
    holder, ordinary, other = (Turn("hci0", first=False, directory=tmp_path) for _ in range(3))
    first, second = (Turn("hci0", first=True, directory=tmp_path) for _ in range(2))
    assert holder.try_take()
    assert not ordinary.try_take()
    assert Turn("hci1", first=False, directory=tmp_path).try_take(), "each adapter has turns of its own"
    assert not first.try_take()
    assert not second.try_take()
    holder.release()
    assert not ordinary.try_take(), "it leaves the turn to the first ones"
    assert first.try_take()
    assert not second.try_take()
    assert not other.try_take()
    first.release()
    assert not ordinary.try_take(), "the second one waits still"
    assert second.try_take()
    second.release()
    assert other.try_take()


def test_missing_lock_place_does_not_prevent_connect(tmp_path: Path) -> None:
    (tmp_path / "bluetooth").write_text("a file")
    turn = Turn("hci0", first=False, directory=tmp_path)
    assert turn.try_take()
    turn.release()


async def test_connect_waits_for_turn_and_stop_does_not(peer: BlePeer) -> None:
    hci0 = peer.bluez.adapters[0]
    late, moving = more(peer, 2)
    link = await open_link(peer.url)
    turn = Turn("hci0", first=False)
    assert turn.try_take()
    waiting = [
        asyncio.create_task(open_link(BleUrl(late.address))),
        asyncio.create_task(open_link(BleUrl(moving.address), first=True)),
    ]
    lane = FileLock(Path(os.environ["FLEET_STATE_DIR"]) / "bluetooth" / "hci0.first.lock")
    async with asyncio.timeout(PATIENCE_S):
        while lane.try_take():  # until the moving car waits in its lane
            lane.release()
            await asyncio.sleep(0.01)
        await link.write(STOP)
    assert peer.receive(len(STOP)) == STOP, "a stop never waits"
    assert hci0.accepted == [peer.module.address]
    turn.release()
    links: list[Link] = [link, *await asyncio.gather(*waiting)]
    assert hci0.accepted == [peer.module.address, moving.address, late.address]
    for each in links:
        await each.close()


async def test_connects_at_once_meet_no_refusal(peer: BlePeer) -> None:
    hci0 = peer.bluez.adapters[0]
    hci0.connect_s = 0.2
    cars = more(peer, 4)
    links = await asyncio.gather(*(open_link(BleUrl(car.address)) for car in cars))
    assert sorted(hci0.accepted) == sorted(car.address for car in cars)
    assert hci0.refused == []
    for each in links:
        await each.close()


# ---------------------------------------------------------------------- adapters and their room


async def test_ble_link_uses_named_adapter(peer: BlePeer) -> None:
    hci0, hci1 = peer.bluez.adapters
    for adapter, used in ((None, hci0), ("hci1", hci1), ("hci0", hci0)):
        link = await open_link(BleUrl(peer.module.address, adapter=adapter))
        assert peer.module.adapter is used
        assert await list_connections() == {each.name: int(each is used) for each in (hci0, hci1)}
        await link.close()
    link = await open_link(BleUrl(name="BT04", adapter="hci1"))
    assert peer.module.adapter is hci1
    await link.close()
    words = await refused(BleUrl(peer.module.address, adapter="hci7"))
    assert words.endswith("?adapter=hci7: no Bluetooth adapter hci7 that is on. There are: hci0, hci1")


async def test_auto_takes_adapter_with_room_in_range(peer: BlePeer) -> None:
    hci0, hci1 = peer.bluez.adapters
    auto = BleUrl(peer.module.address, adapter="auto")
    more(peer, 1, hci0)
    link = await open_link(auto)
    assert peer.module.adapter is hci1, "it has fewer connections"
    await link.close()
    peer.module.seen_by = frozenset({"hci0"})
    link = await open_link(auto)
    assert peer.module.adapter is hci0, "the other one does not see the car"
    await link.close()
    peer.module.seen_by = None
    more(peer, ADAPTER_CONNECTIONS - 1, hci0)
    links = [await open_link(BleUrl(each.address, adapter="auto")) for each in more(peer, ADAPTER_CONNECTIONS)]
    assert await list_connections() == {"hci0": ADAPTER_CONNECTIONS, "hci1": ADAPTER_CONNECTIONS}
    assert hci0.accepted == [peer.module.address], "nobody tried one that was known to be full"
    for each in links:
        await each.close()


async def test_auto_goes_on_to_adapter_with_fewer_connections(peer: BlePeer) -> None:
    hci0, hci1 = peer.bluez.adapters
    hci0.slots = 3
    more(peer, 3, hci0)
    more(peer, 4, hci1)
    link = await open_link(BleUrl(peer.module.address, adapter="auto"))
    assert peer.module.adapter is hci1
    await link.close()


async def test_full_ble_adapter_is_reported(peer: BlePeer) -> None:
    hci0, hci1 = peer.bluez.adapters
    hci0.slots = 3
    more(peer, 3, hci0)
    assert await refused(peer.url) == (
        f"{peer.url}: the Bluetooth adapter is full: hci0 has 3 connections, and most can hold 5, some 3. Add "
        "?adapter=hci1 or ?adapter=auto to this car's link"
    )
    more(peer, 5, hci1)
    assert "is full: hci" in await refused(BleUrl(peer.module.address, adapter="auto"))
    hci0.slots = 8
    link = await open_link(peer.url)
    assert peer.module.adapter is hci0, "an adapter that holds more than most is not refused beforehand"
    await link.close()


async def test_connection_of_killed_gateway_makes_room(peer: BlePeer) -> None:
    """The system keeps the connection of a program that was killed."""
    hci0 = peer.bluez.adapters[0]
    hci0.slots = 3
    killed, served = more(peer, 2)
    (foreign,) = more(peer, 1, hci0)
    link = await open_link(BleUrl(served.address))
    done = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-c", KILLED, f"ble://{killed.address}"],
        env=os.environ,
        timeout=60,
        check=False,
    )
    assert done.returncode == -9
    assert killed.connected
    again = await open_link(peer.url)
    assert not killed.connected
    assert served.connected
    assert foreign.connected
    await link.write(STOP)
    await again.close()
    await link.close()


# ---------------------------------------------------------------------- whole gateways


@pytest.fixture
def two_adapters() -> Iterator[BlePeer]:
    made = BlePeer(Adapter("hci0", connect_s=1.0), Adapter("hci1", connect_s=1.0))
    yield made
    made.close()


@pytest.fixture
def fleet(tmp_path: Path, two_adapters: BlePeer) -> Iterator[FleetProcesses]:
    started = FleetProcesses(free_endpoint(), tmp_path)
    yield started
    started.close()


def test_eight_gateways_connect_and_killed_one_frees_place(fleet: FleetProcesses, two_adapters: BlePeer) -> None:
    hci0, hci1 = two_adapters.bluez.adapters
    more(two_adapters, 1, hci0)
    more(two_adapters, 1, hci1)
    cars = more(two_adapters, CARS)
    gateways = [
        fleet.gateway(f"ble://{each.address}?adapter=auto", "--retry", car=f"car{number}")
        for number, each in enumerate(cars)
    ]
    wait_for(lambda: all(each.connected for each in cars), "all are connected")
    wait_for(lambda: all("[link_open]" in each.stderr for each in gateways), "and open")
    assert hci0.refused == hci1.refused == []
    assert [sum(each.adapter is adapter for each in two_adapters.bluez.modules) for adapter in (hci0, hci1)] == [5, 5]
    gateways[0].kill()
    gateways[0].wait()
    last = fleet.gateway(f"{two_adapters.url}?adapter=auto", "--retry", car="last")
    wait_for(lambda: "[link_open]" in last.stderr, "it has the place of the killed one")
    assert not cars[0].connected
    assert all(each.connected for each in cars[1:])


def test_gateway_of_possibly_moving_car_connects_first(fleet: FleetProcesses, two_adapters: BlePeer) -> None:
    hci0 = two_adapters.bluez.adapters[0]
    hci0.connect_s = 0.0
    sim, (port,) = fleet.simulate("red:arduino:pty")
    two_adapters.bluez.wire(two_adapters.module, port.removeprefix("serial://"))
    fleet.gateway(str(two_adapters.url))
    fleet.ready()
    state = Path(fleet.environment["FLEET_STATE_DIR"])
    turn = Turn("hci0", first=False, directory=state)
    lane = FileLock(state / "bluetooth" / "hci0.first.lock")

    def is_first() -> bool:
        is_free = lane.try_take()
        lane.release()
        return not is_free

    fleet.ask("drive", motion="forward", duration_s=10, sender="mia", kind="person")
    wait_for(lambda: driving(sim), "it drives")
    assert turn.try_take()
    assert not is_first()
    two_adapters.die()
    two_adapters.revive()
    wait_for(is_first, "it goes before the others")
    assert driving(sim)
    turn.release()
    wait_for(lambda: not driving(sim), "stopped")

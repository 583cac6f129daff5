"""A whole gateway over Bluetooth LE: a simulated car on the UART of a module of a private BlueZ."""

import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.gateway.link.peers import BlePeer
from tests.support.ports import free_endpoint
from tests.support.processes import TAKEN, FleetProcesses, GatewayProcess, driving, wait_for

REPEAT_S = 5.0
"""Timeout for the car to drive. After it, `drive` repeats the request."""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="BlueZ is Linux's; elsewhere bleak asks the system")


@pytest.fixture
def peer() -> Iterator[BlePeer]:
    made = BlePeer()
    yield made
    made.close()


@pytest.fixture
def fleet(tmp_path: Path, peer: BlePeer) -> Iterator[FleetProcesses]:
    """Start a fleet whose processes use the private bus, which must outlive them."""
    started = FleetProcesses(free_endpoint(), tmp_path)
    yield started
    started.close()


@pytest.fixture
def sim(fleet: FleetProcesses, peer: BlePeer) -> GatewayProcess:
    """Start a simulated car, and connect it to the module."""
    simulated, (link,) = fleet.simulate("red:arduino:pty")
    peer.bluez.wire(peer.module, link.removeprefix("serial://"))
    return simulated


def drive(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    """Request a drive until the car drives. A busy car loses frames, here the drive after a color."""

    def is_driving() -> bool:
        answer = fleet.ask("drive", motion="forward", duration_s=10, sender="mia", kind="person")
        assert answer["status"] in TAKEN, answer
        with suppress(AssertionError):
            wait_for(lambda: driving(sim), "it drives", REPEAT_S)
        return driving(sim)

    wait_for(is_driving, "it drives")


def test_gateway_over_ble_drives_and_stops(fleet: FleetProcesses, peer: BlePeer, sim: GatewayProcess) -> None:
    gateway = fleet.gateway(str(peer.url))
    fleet.ready()
    drive(fleet, sim)
    answer = fleet.ask("stop", sender="mia", kind="person")
    assert answer["status"] in TAKEN, answer
    wait_for(lambda: not driving(sim), "it stands")
    assert fleet.ask("led", r=255, g=128, b=100)["status"] in TAKEN, "26 bytes: two pieces"
    drive(fleet, sim)
    assert gateway.end() == 0, gateway.stderr
    wait_for(lambda: not driving(sim), "a gateway that ends stops its car first; nobody else does now")
    assert not peer.module.connected


def test_out_of_range_while_it_drives(fleet: FleetProcesses, peer: BlePeer, sim: GatewayProcess) -> None:
    fleet.gateway(str(peer.url))
    fleet.ready()
    drive(fleet, sim)
    peer.die()
    wait_for(lambda: fleet.state("link").state == "lost", "it is said")
    assert "the Bluetooth connection ended" in fleet.state("link").reason
    assert fleet.state("safety").motors == "unknown"
    assert driving(sim)
    peer.revive()
    wait_for(lambda: not driving(sim), "stopped when it is back")
    fleet.ready()


def test_successor_of_killed_gateway_takes_module_over_and_stops_car(
    fleet: FleetProcesses, peer: BlePeer, sim: GatewayProcess
) -> None:
    gateway = fleet.gateway(str(peer.url))
    fleet.ready()
    drive(fleet, sim)
    gateway.kill()
    gateway.wait()
    assert peer.module.connected
    assert driving(sim)
    fleet.gateway(str(peer.url))
    wait_for(lambda: not driving(sim), "stopped by the next")
    fleet.ready()

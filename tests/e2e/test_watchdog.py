"""A real gateway as a service: what it tells systemd, and what happens when its loop hangs. The test is systemd.

The simulator's truth is the judge.
"""

import os
import signal
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.process.service_notifier import FEEDS_PER_WATCHDOG, NOTIFY_SOCKET, WATCHDOG_USEC
from tests.support.processes import LONG_S, PATIENCE_S, FleetProcesses, driving, wait_for

WATCHDOG_S = 1.0
# The loop's thread hangs in a handler, as in an endless loop. Zenoh's threads go on: the process still looks alive.
HANGS_AT_A_SIGNAL = (
    "import signal, sys, time\n"
    "signal.signal(signal.SIGUSR1, lambda *_: time.sleep(1e6))\n"
    "sys.argv[0] = 'gateway'\n"
    "import gateway.cli\n"
    "gateway.cli.main()\n"
)


@pytest.fixture
def manager() -> Iterator[socket.socket]:
    # The path of a socket has at most 107 characters.
    with tempfile.TemporaryDirectory(dir="/tmp") as short, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(Path(short) / "notify"))
        bound.settimeout(PATIENCE_S)
        yield bound


def is_quiet(manager: socket.socket, seconds: float) -> bool:
    """Return True if no message comes for so long."""
    manager.settimeout(seconds)
    try:
        manager.recv(4096)
    except TimeoutError:
        return True
    finally:
        manager.settimeout(PATIENCE_S)
    return False


def test_hung_gateway_feeds_no_watchdog_and_successor_stops_car(fleet: FleetProcesses, manager: socket.socket) -> None:
    sim, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    fleet.environment |= {NOTIFY_SOCKET: manager.getsockname(), WATCHDOG_USEC: str(int(WATCHDOG_S * 1e6))}
    run = ("run", "--car", "red", "--link", link, "--platform", "arduino", "--longest-drive", f"{LONG_S:g}s")
    gateway = fleet.start("-c", HANGS_AT_A_SIGNAL, *run)
    assert manager.recv(4096) == b"READY=1\nWATCHDOG=1"
    assert fleet.state("link") is not None, "its service answers when it says that it is ready"
    fleet.ready()
    fleet.ask("drive", motion="forward", duration_s=LONG_S)
    wait_for(lambda: driving(sim), "it drives")
    for _ in range(FEEDS_PER_WATCHDOG):
        assert manager.recv(4096) == b"WATCHDOG=1"
    os.kill(gateway.pid, signal.SIGUSR1)
    wait_for(lambda: is_quiet(manager, WATCHDOG_S), "no message for the time of the watchdog")
    assert gateway.popen.poll() is None
    assert driving(sim)
    gateway.popen.send_signal(signal.SIGABRT)  # as systemd does
    gateway.wait()
    fleet.gateway(link)
    assert manager.recv(4096) == b"READY=1\nWATCHDOG=1"
    wait_for(lambda: not driving(sim), "the next gateway has stopped the car")


def test_gateway_without_car_and_hub_still_feeds_watchdog(fleet: FleetProcesses, manager: socket.socket) -> None:
    """A restart would not bring back either of them."""
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    fleet.environment |= {NOTIFY_SOCKET: manager.getsockname(), WATCHDOG_USEC: str(int(WATCHDOG_S * 1e6))}
    fleet.gateway(link, "--retry")
    assert manager.recv(4096) == b"READY=1\nWATCHDOG=1"
    sim.end()
    os.kill(fleet.hub.pid, signal.SIGSTOP)
    try:
        for _ in range(2 * FEEDS_PER_WATCHDOG):
            assert manager.recv(4096) == b"WATCHDOG=1"
    finally:
        os.kill(fleet.hub.pid, signal.SIGCONT)

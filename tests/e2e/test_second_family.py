"""Cars of other families behind real gateways: Waveshare's over a terminal, and a tank of another package over TCP."""

import contextlib
import json
import socket
import threading
from pathlib import Path
from typing import Any

import pytest

from schemas.words import Basis, Motors, Phase, Reason
from tests.support.driver_package import install_driver
from tests.support.processes import FleetProcesses, wait_for


def test_rover_drives_shows_stop_and_publishes_measurements(fleet: FleetProcesses) -> None:
    sim, links = fleet.simulate("red:ugv_rover:pty", truth=True)
    fleet.gateway(links[0], platform="ugv_rover")
    fleet.ready()
    assert fleet.ask("mode", mode="tracking")["reason"] == "unsupported"
    assert fleet.ask("drive", motion="forward", duration_s=2.0)["status"] in (Phase.SENT, Phase.QUEUED)
    wait_for(lambda: driven(fleet), "wheels that turn")
    fleet.ask("stop")
    safety = wait_for(lambda: shown(fleet), "a shown stop")
    assert (safety.motors, safety.motors_basis) == (Motors.OFF, Basis.SHOWN)
    assert 9 < fleet.get("fleet/red/sensor/battery")[-1].voltage_v < 13
    health = fleet.state("health")
    assert (health.platform, health.shows_stops) == ("ugv_rover", "yes")
    assert sim.popen.poll() is None


def driven(fleet: FleetProcesses) -> bool:
    """Return True if the last wheel speeds are of a drive, and its way is at least the centimeter that is counted."""
    wheels, odometer = fleet.get("fleet/red/sensor/wheels"), fleet.get("fleet/red/sensor/odometer")
    return bool(wheels and odometer) and wheels[-1].left_m_s > 0.1 and odometer[-1].left_m > 0


def shown(fleet: FleetProcesses) -> object:
    """Return the safety state if the car has shown its stop."""
    safety = fleet.state("safety")
    return safety if safety.motors_basis == Basis.SHOWN else None


class TankServer:
    """A tank behind a port. It obeys, and reports five times a second."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.moves: list[list[float]] = []
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        """The link to it."""
        return f"tcp://127.0.0.1:{self.server.getsockname()[1]}"

    def _serve(self) -> None:
        while not self.ended.is_set():
            try:
                peer, _ = self.server.accept()
            except OSError:  # closed
                return
            self._serve_one(peer)

    def _serve_one(self, peer: socket.socket) -> None:
        with peer:
            peer.settimeout(0.2)
            rest = b""
            while not self.ended.is_set():
                try:
                    data = peer.recv(4096)
                    if not data:
                        return
                    *lines, rest = (rest + data).split(b"\n")
                    self.moves += [json.loads(line)["move"] for line in lines if line.startswith(b"{")]
                except TimeoutError:
                    pass
                peer.sendall(b'{"v":7.9,"dist_cm":42}\n')

    def close(self) -> None:
        """End it."""
        self.ended.set()
        with contextlib.suppress(OSError):
            self.server.shutdown(socket.SHUT_RDWR)  # else `accept` waits on
        self.server.close()
        self.thread.join(timeout=5)


def install_tank(fleet: FleetProcesses, directory: Path, module: str) -> None:
    """Install the package of a driver for the processes of a fleet."""
    packages = directory / "packages"
    install_driver(packages, module)
    fleet.environment["PYTHONPATH"] = f"{packages}:{Path(__file__).parents[2]}"


def test_failing_driver_leaves_no_moving_car(fleet: FleetProcesses, tmp_path: Path) -> None:
    install_tank(fleet, tmp_path, "tests.support.failing_tank")
    tank = TankServer()
    try:
        gateway = fleet.gateway(tank.url, platform="tank")
        fleet.ready()
        fleet.ask("drive", motion="forward", duration_s=10.0)
        wait_for(lambda: tank.moves[-1:] == [[0.5, 0.5]], "it drives")
        told: list[Any] = []
        fleet.bus.subscribe("fleet/red/event/command", lambda sample: told.append(sample.message()))
        fleet.ask_all("drive", car="red", motion="spin_left", duration_s=1.0, id="spin")
        assert gateway.wait() == 1
        assert tank.moves[-2:] == [[0, 0], [0, 0]], "a new driver has stopped it"
        last = {each.id: (each.phase, each.reason) for each in told}
        assert last["spin"] == (Phase.FAILED, Reason.LINK_DOWN), "not as if the car had been stopped"
    finally:
        tank.close()


def test_car_of_another_package_is_named_driven_and_stopped(fleet: FleetProcesses, tmp_path: Path) -> None:
    install_tank(fleet, tmp_path, "tests.support.tank")
    tank = TankServer()
    try:
        fleet.gateway(tank.url, platform="tank")
        fleet.ready()
        fleet.ask("drive", motion="spin_left", duration_s=0.5)
        wait_for(lambda: [-0.5, 0.5] in tank.moves, "a spin")
        wait_for(lambda: tank.moves[-2:] == [[0, 0], [0, 0]], "the stop after it")
        assert fleet.get("fleet/red/sensor/range")[-1].range_m == pytest.approx(0.42)
        safety = wait_for(lambda: (fleet.state("safety").motors == Motors.OFF) and fleet.state("safety"), "off")
        assert safety.motors_basis == Basis.SENT, "nothing that a tank sends shows a stop"
    finally:
        tank.close()

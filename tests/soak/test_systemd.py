"""The units of deploy/ under a real systemd: in a container of systemd-nspawn, whose Debian debootstrap installs.

It needs root, the Debian packages debootstrap and systemd-container, the package indexes of Debian and Python, and the
ports of a hub and a console (7447, 7443, 7480), because the container shares the network of this machine.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from tests.deploy.test_install_car import SCRIPT
from tests.support.processes import FleetProcesses, driving, wait_for

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parents[2]
IMAGE = ROOT / ".cache/debian"
PACKAGES = "systemd,systemd-sysv,dbus,udev,libpam-systemd,procps,python3,python3-venv,ca-certificates"
CERTIFICATES = "/etc/ssl/certs"
BOOT_S = 60.0
WATCHDOG_S = 10.0
"""`WatchdogSec=` of the unit."""
SUCCESSOR_S = 20.0
"""Longest time in which systemd starts a gateway again, and this one stops its car, on a busy machine."""
STATE = Path("/var/lib/car-fleet")
HUB_UNITS = ("car-hub-certificates.service", "car-hub.service", "car-recorder.service", "car-console.service")


@dataclass
class Debian:
    """A booted Debian, which shares the network of this machine."""

    systemd: int
    """The id of its first process."""

    def run(self, *words: str, ok: bool = True) -> str:
        """Run a command there as root, and return its output."""
        clean = ("env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", f"PIP_CERT={CERTIFICATES}/ca-certificates.crt")
        done = subprocess.run(
            ["nsenter", "-t", str(self.systemd), "-a", *clean, *words], capture_output=True, text=True, check=False
        )
        assert not ok or done.returncode == 0, done.stdout + done.stderr
        return done.stdout.strip()

    def install(self, *options: str) -> str:
        """Run the script of this clone."""
        return self.run("sh", f"/clone/{SCRIPT.relative_to(ROOT)}", *options)

    def shows(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", "--property", name, "--value", unit)


@pytest.fixture(scope="module")
def debian() -> Path:
    """Return a minimal Debian. It is made if it is not there, in a minute."""
    for needed in ("debootstrap", "systemd-nspawn"):
        assert shutil.which(needed), "this soak needs debootstrap and systemd-container, of Debian"
    assert os.geteuid() == 0, "this soak needs root"
    if not (IMAGE / "usr/lib/systemd/systemd").exists():
        new = IMAGE.with_name("debian.new")
        shutil.rmtree(new, ignore_errors=True)
        subprocess.run(["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(new)], check=True)
        new.rename(IMAGE)
    return IMAGE


def first_process(container: int) -> int | None:
    """Return the id of systemd in the container. Before it, there are processes that only prepare the container."""
    with suppress(psutil.NoSuchProcess):
        started = psutil.Process(container).children(recursive=True)
        return next((each.pid for each in started if each.name() == "systemd"), None)
    return None


@pytest.fixture
def computer(debian: Path, tmp_path: Path) -> Iterator[Debian]:
    """Boot it. What it writes is in memory, and gone with it."""
    binds = [f"--bind-ro={ROOT}:/clone", f"--bind-ro={CERTIFICATES}", f"--bind={tmp_path}"]
    command = [
        "systemd-nspawn",
        f"--directory={debian}",
        "--volatile=overlay",
        "--boot",
        "--register=no",
        "--keep-unit",
    ]
    environment = {**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
    with (tmp_path / "boot.log").open("w") as log:
        container = subprocess.Popen(
            [*command, "--register=no", "--keep-unit", "--resolv-conf=copy-host", "--console=pipe", *binds],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
        )
    try:
        made = Debian(wait_for(lambda: first_process(container.pid), "systemd starts", BOOT_S))
        booted = ("running", "degraded")  # the second one if a unit of Debian's own cannot run in a container
        wait_for(lambda: made.run("systemctl", "is-system-running", ok=False) in booted, "it has booted", BOOT_S)
        yield made
    finally:
        container.terminate()
        container.wait()


def test_gateway_is_started_again_and_stops_its_car(computer: Debian, fleet: FleetProcesses) -> None:
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    unit = "car-gateway@red.service"
    said = computer.install("--clone", "--car", "red", "--link", link, "--platform", "arduino")
    assert "fleet join HOST CODE" in said
    computer.run("sh", "-c", f"echo FLEET_ENDPOINT={fleet.endpoint} >> /etc/car-fleet/red.env")
    computer.run("systemctl", "restart", unit)
    fleet.ready()

    def restarts() -> int:
        return int(computer.shows(unit, "NRestarts"))

    # It hangs while the car drives.
    fleet.ask("drive", motion="forward", duration_s=9.0)
    wait_for(lambda: driving(sim), "red drives")
    computer.run("systemctl", "kill", "--signal=STOP", "--kill-whom=main", unit)
    wait_for(lambda: restarts() == 1, "systemd has started it again", WATCHDOG_S + SUCCESSOR_S)
    wait_for(lambda: not driving(sim), "the car is stopped", SUCCESSOR_S)
    fleet.ready()

    # It is killed in a mode.
    fleet.ask("mode", mode="obstacle_avoidance")
    wait_for(lambda: driving(sim), "red drives by itself")
    computer.run("systemctl", "kill", "--signal=KILL", "--kill-whom=main", unit)
    wait_for(lambda: restarts() == 2, "systemd has started it again", SUCCESSOR_S)
    wait_for(lambda: not driving(sim), "the car is stopped", SUCCESSOR_S)
    fleet.ready()

    # It is ended while the car drives.
    fleet.ask("drive", motion="forward", duration_s=9.0)
    wait_for(lambda: driving(sim), "red drives")
    computer.run("systemctl", "stop", unit)
    assert not driving(sim)
    assert computer.shows(unit, "Result") == "success"

    # Its file has a mistake, so another start would not help.
    computer.run("sed", "-i", "s/PLATFORM=.*/PLATFORM=tank/", "/etc/car-fleet/red.env")
    computer.run("systemctl", "start", unit, ok=False)
    wait_for(lambda: computer.shows(unit, "ExecMainStatus") == "2", "it has ended")
    assert computer.shows(unit, "ActiveState") == "failed"
    assert "red.env was changed: it stays" in computer.install("--uninstall")


def test_hub_runs_and_uninstall_leaves_its_key_to_root(computer: Debian) -> None:
    computer.install("--clone", "--all")
    computer.run("systemctl", "start", "car-hub-certificates.service")
    key = computer.run("find", str(STATE), "-name", "ca.key")
    assert computer.run("stat", "--format=%U %a", key) == "car-fleet 600"
    computer.install("--uninstall")
    computer.run("useradd", "--system", "other")
    owners = computer.run("find", str(STATE), "-printf", r"%u\n")
    assert set(owners.split()) == {"root"}
    computer.install("--clone", "--all")
    owners = computer.run("find", str(STATE), "-printf", r"%u\n")
    assert set(owners.split()) == {"car-fleet"}
    computer.run("systemctl", "start", *HUB_UNITS)
    for unit in HUB_UNITS[1:]:
        wait_for(lambda unit=unit: computer.shows(unit, "ActiveState") == "active", f"{unit} runs")
        assert computer.shows(unit, "NRestarts") == "0"

"""deploy/install-car.sh as a user runs it, below a directory: twice, with a car that joins a hub, and removed again.

It needs a package index, from which it installs what a gateway needs.
"""

import shlex
import subprocess
from pathlib import Path

import pytest

from tests.deploy.test_install_car import SCRIPT
from tests.e2e.test_wheel import wheel
from tests.support.ports import free_endpoint, free_port
from tests.support.processes import FleetProcesses, GatewayProcess, wait_for
from tests.support.up import fleet_command

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]

MAX_INSTALLED_MB = 120


def install(root: Path, *options: str) -> str:
    done = subprocess.run(
        ["sh", str(SCRIPT), "--prefix", str(root), *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def paths(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_relative_to(root / "opt")}


def test_reinstall_joins_drives_and_uninstall_leaves_nothing(tmp_path: Path) -> None:
    root = tmp_path / "a root"
    root.mkdir()
    (root / "etc").mkdir()
    (root / "etc" / "hostname").write_text("pi\n")
    built = str(wheel(tmp_path))
    endpoint, port = f"tls/127.0.0.1:{free_port()}", free_port()
    home = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(tmp_path / "hub"), "FLEET_AS": "ann"}
    fleet = FleetProcesses(free_endpoint(), tmp_path)  # for its simulated car only
    try:
        _, (link,) = fleet.simulate("red:arduino:tcp")
        options = ("--wheel", built, "--car", "red", "--link", link, "--platform", "arduino")
        said = install(root, *options)
        assert "fleet join HOST CODE" in said
        before = paths(root)
        install(root, "--clone", *options[2:])
        assert paths(root) == before
        used = subprocess.run(["du", "-sm", str(root / "opt")], capture_output=True, text=True, check=True).stdout
        print(f"installed: {used.split()[0]} MB")
        assert int(used.split()[0]) < MAX_INSTALLED_MB

        bin_ = root / "opt/car-fleet/bin"
        state = root / "var/lib/car-fleet"
        # As `fleet hub init` does, which always takes the port 7447.
        make = "import sys; from fleet.hub.local_hub import ensure_hub_here; ensure_hub_here(sys.argv[1])"
        assert GatewayProcess(["-c", make, endpoint], tmp_path / "init.log", home).wait() == 0
        ask = ["-m", "fleet.cli", "hub", "invite", "--car", "red", "--json", "--as-hub", "127.0.0.1"]
        invitation = GatewayProcess([*ask, "--port", str(port)], tmp_path / "invite.log", home)
        hub = GatewayProcess(["-m", "schemas.bus.hub", "--endpoint", endpoint], tmp_path / "hub.log", home)
        code = invitation.line()["code"]
        own = {"PATH": "/usr/bin:/bin", "FLEET_STATE_DIR": str(state)}
        join = [str(bin_ / "fleet"), "join", f"127.0.0.1:{port}", code]
        done = subprocess.run(join, env=own, cwd=state, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert invitation.wait() == 0

        # As the unit does: the variables of the car's file, and its ExecStart.
        values = dict(line.split("=", 1) for line in (root / "etc/car-fleet/red.env").read_text().splitlines())
        unit = (root / "etc/systemd/system/car-gateway@.service").read_text()
        (start,) = [line.partition("=")[2] for line in unit.splitlines() if line.startswith("ExecStart=")]
        variables = {f"${{{name}}}": [value] for name, value in values.items()}
        variables["$OPTIONS"] = values["OPTIONS"].split()
        start = start.replace("/opt/car-fleet/bin", shlex.quote(str(bin_))).replace("%i", "red")
        words = [part for word in shlex.split(start) for part in variables.get(word, [word])]
        gateway = subprocess.Popen(words, env=own, cwd=state, stderr=subprocess.PIPE)
        try:
            drive = ("drive", "red", "forward", "--for", "100ms")
            wait_for(lambda: fleet_command(*drive, environment=home).returncode == 0, "ann drives red")
            stop = subprocess.run([str(bin_ / "fleet"), "stop"], env=own, capture_output=True, text=True, check=False)
            assert stop.returncode == 0, stop.stdout + stop.stderr
        finally:
            gateway.terminate()
            gateway.communicate(timeout=30)
            hub.end()
    finally:
        fleet.close()
    changed = root / "etc/udev/rules.d/70-fleet-cars.rules"
    changed.write_text(changed.read_text() + "# mine\n")
    assert f"{changed} was changed: it stays" in install(root, *options)
    for path in sorted(state.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    removed = install(root, "--uninstall")
    assert f"{changed} was changed: it stays" in removed
    assert {path for path in paths(root) if (root / path).is_file()} == {"etc/hostname", str(changed.relative_to(root))}
    assert not (root / "opt").exists()

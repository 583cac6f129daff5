"""`fleet up --secure` on one computer, and another one that joins, drives and is revoked, by the commands alone."""

import json
from functools import partial
from pathlib import Path

import pytest

from schemas.state_dir import JOINED_FILE
from tests.support.ports import free_port
from tests.support.processes import GatewayProcess, wait_for
from tests.support.up import fleet_command

FLEET_FILE = """
cars: {red: {link: sim, platform: arduino}, blue: {link: sim, platform: arduino}}
people: {ann: {rank: lead}, mia: {drives: [red]}}
plan: plan.yaml
"""


@pytest.mark.soak
@pytest.mark.timeout(240)
def test_one_computer_and_another_that_joins(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    endpoint = f"tls/127.0.0.1:{free_port()}"
    at_home = {"FLEET_ENDPOINT": endpoint, "FLEET_STATE_DIR": str(here), "FLEET_AS": "ann"}
    home = partial(fleet_command, environment=at_home)
    away = partial(fleet_command, environment={"FLEET_ENDPOINT": "", "FLEET_STATE_DIR": str(there)})
    file = tmp_path / "fleet.yaml"
    file.write_text(f"{FLEET_FILE}console: {{port: {free_port()}}}\n")
    (tmp_path / "plan.yaml").write_text("fixed: {blue: {mode: tracking}}\n")
    begun = home("up", str(file), "--secure", "--sessions", str(tmp_path / "sessions"), "--detach")
    try:
        assert begun.returncode == 0, begun
        assert (here / JOINED_FILE).read_text().strip() == endpoint
        assert home("stop", "--as", "mia").returncode == 2, "who is who says the certificate"
        connected = {
            row["identity"]: row["state"] for row in map(json.loads, home("hub", "show", "--json").stdout.splitlines())
        }
        services = {f"service.{name}" for name in ("supervisor", "coordinator", "recorder", "console", "sim")}
        assert {"car.red", "car.blue", *services} == {name for name, state in connected.items() if state == "connected"}

        sessions = str(tmp_path / "sessions")
        assert home("play", "--sessions", sessions).returncode == 1, "nobody speaks as a car"
        assert home("plan", "run", str(tmp_path / "plan.yaml")).returncode != 0, "there is a coordinator"

        port = free_port()
        arguments = ["-m", "fleet.cli", "hub", "invite", "mia", "--json", "--as-hub", "127.0.0.1", "--port", str(port)]
        invitation = GatewayProcess(arguments, tmp_path / "invite.log", at_home)
        said = invitation.line()
        assert said["identity"] == "person.mia"
        joined = away("join", said["host"], said["code"])
        assert joined.returncode == 0, joined
        assert invitation.wait() == 0, invitation.stderr
        assert away("join", said["host"], said["code"]).returncode == 1, "once"

        wait_for(lambda: away("drive", "red", "forward", "--for", "100ms").returncode == 0, "mia drives red")
        assert away("drive", "blue", "forward", "--for", "100ms").returncode == 1
        assert away("stop").returncode == 0
        assert away("reload").returncode != 0, "for leads"
        assert away("plan", "set", str(tmp_path / "plan.yaml")).returncode != 0, "for leads"
        assert away("hub", "show").returncode == 1, "for the hub's computer"

        assert home("hub", "revoke", "person.mia").returncode == 0
        wait_for(lambda: away("stop").returncode == 1, "mia gets nothing")
        for refused in (away("list"), away("drive", "red", "forward", "--for", "100ms")):
            assert refused.returncode == 1
            assert "person.mia" in refused.stderr
            assert "fleet hub invite" in refused.stderr
        assert away("leave").returncode == 0
        assert not [*there.glob("**/*.key")]
        assert away("list").returncode == 1
    finally:
        down = home("down")
    assert down.returncode == 0, down
    verified = home("sessions", "verify", "--sessions", str(tmp_path / "sessions"))
    assert verified.returncode == 0, verified
    assert home("leave").returncode == 0

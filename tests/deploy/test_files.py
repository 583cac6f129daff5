"""Tests the files of deploy/: by their content, and with the tools that read them, if this computer has them."""

import configparser
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from fleet.commands.fleet_file import SCHEMAS, schema_text
from fleet.examples import EXAMPLES
from fleet.fleetfile.fleet_file import read_fleet
from fleet.supervisor.process_state import GATEWAY_GRACE_S
from fleet.supervisor.shutdown import CAR_LINK_TIMEOUT_S, GATEWAY_START_TIMEOUT_S
from fleet.supervisor.supervisor import CAR_STOP_RETRY_S, RECORDER_EXIT_TIMEOUT_S, SERVICE_EXIT_TIMEOUT_S

DEPLOY = Path(__file__).parent.parent.parent / "deploy"
SCHEMA = "https://raw.githubusercontent.com/zenoh-car-fleet/zenoh-car-fleet/main/deploy/fleet.schema.json"
FILES = sorted((EXAMPLES / "fleets").glob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_fleet_file_is_one(path: Path) -> None:
    fleet = read_fleet(path)
    assert len(fleet.cars) >= 3
    assert path.read_text().startswith(f"# yaml-language-server: $schema={SCHEMA}\n")
    links = {name: car.link.partition(":")[0] for name, car in fleet.cars.items()}
    wanted = {
        "sim": {"sim"},
        "lesson": {"sim"},
        "bluetooth": {"ble"},
        "mixed": {"serial", "tcp", "ble", "/dev/fleet/green"},
    }
    assert set(links.values()) == wanted[path.stem]


def test_there_is_one_for_each_start() -> None:
    assert [path.name for path in FILES] == ["bluetooth.yaml", "lesson.yaml", "mixed.yaml", "sim.yaml"]


@pytest.mark.parametrize("kind", SCHEMAS)
def test_schema_is_up_to_date(kind: str) -> None:
    assert (DEPLOY / f"{kind}.schema.json").read_text(encoding="utf-8") == schema_text(kind), (
        f"fleet schema {kind} > deploy/{kind}.schema.json"
    )


@pytest.mark.parametrize("kind", SCHEMAS)
def test_every_example_names_its_schema_and_describes_fields(kind: str) -> None:
    examples = sorted((EXAMPLES / f"{kind}s").glob("*.yaml"))
    assert examples
    for path in examples:
        assert path.read_text(encoding="utf-8").splitlines()[0].endswith(f"/main/deploy/{kind}.schema.json"), path
    schema = json.loads(schema_text(kind))
    for name, part in {"": schema, **schema["$defs"]}.items():
        for field, each in part.get("properties", {}).items():
            assert "description" in each, f"{name}.{field}"


_PART = re.compile(r'(?P<key>[A-Z]+(?:\{[A-Za-z0-9_]+\})?)(?P<op>==|!=|\+=|-=|:=|=)"(?P<value>[^"]*)"')
_MATCHED = {"SUBSYSTEM", "ENV{ID_BUS}", "ENV{ID_VENDOR_ID}", "ENV{ID_SERIAL_SHORT}", "ENV{ID_PATH}"}
_SET = {"ENV{ID_MM_PORT_IGNORE}", "GROUP", "MODE", "TAG", "SYMLINK"}


def test_udev_rules_give_each_car_a_name_of_its_own() -> None:
    rules = DEPLOY / "70-fleet-cars.rules"
    names = []
    for line in rules.read_text(encoding="ascii").splitlines():
        if not line or line.startswith("#"):
            continue
        parts = [_PART.fullmatch(part) for part in line.split(", ")]
        assert all(parts), line
        found = [(part["key"], part["op"], part["value"]) for part in parts if part is not None]
        for key, operator, _ in found:
            assert key in (_MATCHED if operator == "==" else _SET), line
        assert ("SUBSYSTEM", "==", "tty") in found
        assert any(operator == "==" and key.startswith("ENV{ID_") for key, operator, _ in found), line
        names += [value for key, operator, value in found if (key, operator) == ("SYMLINK", "+=")]
    assert names == ["fleet/red", "fleet/green"]
    assert f"/dev/{names[1]}" in (EXAMPLES / "fleets" / "mixed.yaml").read_text()
    # 60-serial.rules sets the ids, so it must come before. 73-seat-late.rules acts on the tag, so it must come after.
    assert "60" < rules.name[:2] < "73"
    udevadm = shutil.which("udevadm")
    knows = udevadm and not subprocess.run([udevadm, "verify", "--help"], check=False, capture_output=True).returncode
    if udevadm and knows:  # systemd 254 and later
        subprocess.run([udevadm, "verify", str(rules)], check=True)


class _Unit(configparser.ConfigParser):
    def optionxform(self, optionstr: str) -> str:
        return optionstr


def test_unit_gives_cars_the_time_to_stop(tmp_path: Path) -> None:
    path = DEPLOY / "fleet.service"
    unit = _Unit(interpolation=None, delimiters=("=",))
    unit.read(path)
    assert unit.sections() == ["Unit", "Service", "Install"]
    service = unit["Service"]
    assert (service["Restart"], service["KillMode"], service["KillSignal"]) == ("on-failure", "mixed", "SIGTERM")
    first_s = (
        2 * GATEWAY_GRACE_S + GATEWAY_START_TIMEOUT_S + CAR_LINK_TIMEOUT_S
    )  # if a gateway hangs and its replacement is slow
    longest_s = max(first_s, CAR_STOP_RETRY_S + GATEWAY_GRACE_S) + RECORDER_EXIT_TIMEOUT_S + 2 * SERVICE_EXIT_TIMEOUT_S
    assert int(service["TimeoutStopSec"]) >= longest_s
    assert re.fullmatch(r"/usr/bin/env %h/\S+/\.venv/bin/fleet up fleet\.yaml", service["ExecStart"])
    assert unit["Install"]["WantedBy"] == "default.target"  # for a user's systemd; multi-user.target is the system's
    verifier = shutil.which("systemd-analyze")
    if verifier:
        # The tool checks that the program exists. This path is in the home of the user who runs the test.
        home, runtime = (
            tmp_path / "home",
            Path(tempfile.mkdtemp(dir="/tmp")),
        )  # the path of a socket has at most 107 characters
        program = home / "zenoh-car-fleet" / ".venv" / "bin" / "fleet"
        (home / ".config" / "fleet").mkdir(parents=True)
        program.parent.mkdir(parents=True)
        program.symlink_to("/bin/true")
        environment = os.environ | {"HOME": str(home), "XDG_RUNTIME_DIR": str(runtime)}
        done = subprocess.run(
            [verifier, "verify", "--user", str(path)], check=False, capture_output=True, text=True, env=environment
        )
        shutil.rmtree(runtime)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")  # an unknown key only prints

"""The container files of deploy/: each service runs what its unit runs, with no more rights."""

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from tests.deploy.test_units import DEPLOY, PREFIX, settings

STATE: Final = "/var/lib/car-fleet"
COMPOSE: Final[dict[str, Any]] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
UNITS: Final = {
    "certificates": "car-hub-certificates.service",
    "hub": "car-hub.service",
    "recorder": "car-recorder.service",
    "console": "car-console.service",
    "exporter": "car-exporter.service",
    "foxglove": "car-foxglove.service",
    "mqtt": "car-mqtt.service",
}


def test_each_service_runs_what_its_unit_runs() -> None:
    assert set(COMPOSE["services"]) == set(UNITS)
    for name, service in COMPOSE["services"].items():
        unit = settings(UNITS[name])
        words = shlex.split(unit["ExecStart"][0].replace(PREFIX, "").replace("%S/car-fleet", STATE))
        assert service["command"] == [word for word in words if word != "$OPTIONS"], name
        assert service["mem_limit"] == unit["MemoryMax"][0].lower(), name
        if "TimeoutStopSec" in unit:
            assert service["stop_grace_period"] == f"{unit['TimeoutStopSec'][0]}s", name


def test_no_service_has_a_right_that_it_does_not_need() -> None:
    for name, service in COMPOSE["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert not {"privileged", "devices", "cap_add", "user", "pid"} & set(service), name
        assert service["volumes"] == [f"state:{STATE}"], name
    text = (DEPLOY / "Containerfile").read_text(encoding="ascii")
    last = text.rpartition("\nFROM ")[2]
    assert re.search(r"^USER [1-9]\d+$", last, re.MULTILINE), "not root"
    assert f"FLEET_STATE_DIR={STATE}" in last


def test_image_is_made_of_what_the_context_lets_through() -> None:
    ignored = (DEPLOY / "Containerfile.dockerignore").read_text(encoding="ascii").splitlines()
    let_through = {line[1:] for line in ignored if line.startswith("!")}
    build = (DEPLOY / "Containerfile").read_text(encoding="ascii").split("\nFROM ")[1]
    copied = {word for line in build.splitlines() if line.startswith("COPY ") for word in line.split()[1:-1]}
    assert ignored[0] == "*"
    assert copied == let_through
    assert all((DEPLOY.parent / name).exists() for name in copied)


@pytest.mark.soak  # needs docker-compose
def test_compose_takes_the_file(tmp_path: Path) -> None:
    words = ["docker-compose", "-f", str(DEPLOY / "compose.yaml"), "config", "-q"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr

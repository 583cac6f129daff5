"""Tests the units of deploy/ for systemd of a system: their limits by the code, and all of them by systemd-analyze."""

import os
import re
import subprocess
from pathlib import Path
from typing import Final

import pytest

from fleet.supervisor.process_state import GATEWAY_GRACE_S
from fleet.supervisor.supervisor import RECORDER_EXIT_TIMEOUT_S, SERVICE_EXIT_TIMEOUT_S
from gateway.link.ble import BLE_WRITE_TIMEOUT_S, DISCONNECT_TIMEOUT_S
from gateway.link.serial import SERIAL_WRITE_TIMEOUT_S
from schemas.bus import HUB_RESTART_DELAY_S
from schemas.process.service_notifier import FEEDS_PER_WATCHDOG

DEPLOY: Final = Path(__file__).parent.parent.parent / "deploy"
GATEWAY: Final = "car-gateway@.service"
SERVICES: Final = sorted(path.name for path in DEPLOY.glob("car-*.service"))
PREFIX: Final = "/opt/car-fleet/bin/"
EXPOSURE: Final = 30
"""Maximum exposure by `systemd-analyze security`, tenths."""


def settings(name: str) -> dict[str, list[str]]:
    """Return the values of each setting of a unit's section [Service], in their order."""
    found: dict[str, list[str]] = {}
    section = (DEPLOY / name).read_text(encoding="ascii").partition("[Service]\n")[2].partition("\n[")[0]
    for line in section.splitlines():
        if line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def test_there_is_one_for_each_service() -> None:
    kinds = ["console", "exporter", "foxglove", "gateway@", "hub-certificates", "hub", "mqtt", "recorder"]
    assert [f"car-{kind}.service" for kind in kinds] == SERVICES


def test_watchdog_timeout_exceeds_longest_writer_turn() -> None:
    watchdog_s = float(settings(GATEWAY)["WatchdogSec"][0])
    longest_s = max(SERIAL_WRITE_TIMEOUT_S, BLE_WRITE_TIMEOUT_S + DISCONNECT_TIMEOUT_S)
    assert watchdog_s * (1 - 1 / FEEDS_PER_WATCHDOG) > longest_s
    assert (settings(GATEWAY)["Type"], settings(GATEWAY)["Restart"]) == (["notify"], ["always"])


def test_each_has_the_time_that_its_end_takes() -> None:
    least = {
        GATEWAY: GATEWAY_GRACE_S,
        "car-recorder.service": RECORDER_EXIT_TIMEOUT_S,
        "car-console.service": SERVICE_EXIT_TIMEOUT_S,
    }
    for name, seconds in least.items():
        assert float(settings(name)["TimeoutStopSec"][0]) > seconds, name


def test_hub_is_back_before_a_gateway_starts_another_one() -> None:
    assert float(settings("car-hub.service")["RestartSec"][0]) < HUB_RESTART_DELAY_S


def test_all_are_locked_in_alike() -> None:
    own = {"DevicePolicy", "DeviceAllow", "PrivateDevices"}
    locks = {}
    for name in SERVICES:
        text = (DEPLOY / name).read_text(encoding="ascii")
        lines = text[text.index("NoNewPrivileges=") : text.index("\n[Install]") if "[Install]" in text else None]
        locks[name] = [line for line in lines.splitlines() if line.partition("=")[0] not in own]
        assert "MemoryMax" in settings(name), name
        assert settings(name)["StateDirectory"] == ["car-fleet"]
    assert all(each == locks[GATEWAY] for each in locks.values())
    assert settings(GATEWAY)["DevicePolicy"] == ["closed"]
    assert [name for name in SERVICES if settings(name).get("PrivateDevices") != ["yes"]] == [GATEWAY]


@pytest.mark.soak  # needs systemd-analyze
def test_systemd_takes_them_as_they_are(tmp_path: Path) -> None:
    """The tool looks whether each program exists, so the units get the path of one."""
    for path in DEPLOY.glob("car-*"):
        if path.suffix in (".service", ".timer"):
            text = path.read_text(encoding="ascii")
            programs = re.findall(rf"{PREFIX}(\w+)", text)
            for program in programs:
                (tmp_path / program).unlink(missing_ok=True)
                (tmp_path / program).symlink_to("/bin/true")
            (tmp_path / path.name).write_text(text.replace(PREFIX, f"{tmp_path}/"), encoding="ascii")
    names = [str(tmp_path / name) for name in (*SERVICES, "car-hub-certificates.timer")]
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *names],
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | {"SYSTEMD_UNIT_PATH": f"{tmp_path}:"},
    )
    ours = [line for line in done.stderr.splitlines() if "car-" in line or str(tmp_path) in line]
    assert (done.returncode, ours) == (0, [])  # an unknown key only prints


@pytest.mark.soak  # needs systemd-analyze
@pytest.mark.parametrize("name", SERVICES)
def test_little_is_exposed(name: str) -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--no-pager", "--offline=true", f"--threshold={EXPOSURE}", str(DEPLOY / name)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-200:] + done.stderr

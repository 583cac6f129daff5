"""The directory of a fleet's state, by platform and by bus."""

import sys
from pathlib import Path

import pytest

from schemas.bus import DEFAULT_ENDPOINT
from schemas.state_dir import default_directory, directory_of


def test_directory_is_the_variables_or_the_platforms(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path / "chosen"))
    assert default_directory() == tmp_path / "chosen"
    monkeypatch.delenv("FLEET_STATE_DIR")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_STATE_HOME", "")
    assert default_directory() == tmp_path / ".local" / "state" / "zenoh-car-fleet"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert default_directory() == tmp_path / "state" / "zenoh-car-fleet"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert default_directory() == tmp_path / "Library" / "Application Support" / "zenoh-car-fleet"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert default_directory() == tmp_path / "local" / "zenoh-car-fleet"


@pytest.mark.parametrize("endpoint", [DEFAULT_ENDPOINT, "tcp/localhost:7447"])
def test_default_bus_uses_state_directory_itself(tmp_path: Path, endpoint: str) -> None:
    assert directory_of(endpoint, tmp_path) == tmp_path


def test_each_bus_has_a_directory_of_its_own(tmp_path: Path) -> None:
    endpoints = [f"tcp/{host}:{port}" for host in ("127.0.0.1", "[::1]", "1", "lab.local") for port in (7448, 7449)]
    endpoints += ["udp/127.0.0.1:7448", "tcp/[::1]:7447", f"tcp/{'a' * 300}:1", f"tcp/{'a' * 300}:2"]
    places = [directory_of(endpoint, tmp_path) for endpoint in endpoints]
    assert len(set(places)) == len(endpoints)
    for place in places:
        assert place.parent == tmp_path / "buses"
        assert len(place.name) < 100
    assert directory_of("tcp/localhost:7448", tmp_path) == directory_of("TCP/127.0.0.1:7448", tmp_path)

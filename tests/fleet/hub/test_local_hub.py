"""What a computer stores that is a hub or joins one: for its user, a car, a service."""

from pathlib import Path

import pytest

from fleet.hub.hub_store import HubStore
from fleet.hub.join import Joined
from fleet.hub.local_hub import SECURE_ENDPOINT, store_joined
from schemas.bus.credentials import Credentials, NoCredentials
from schemas.identity import Service, service
from schemas.running_cars import RunningMark
from schemas.state_dir import DEFAULT_ENDPOINT, directory_of
from tests.support import in_process
from tests.support.text_parts import has_parts


@pytest.mark.parametrize(
    ("joins", "user"),
    [
        (["person.mia", "car.red", "service.recorder"], "person.mia"),
        (["car.red", "person.mia"], "person.mia"),
        (["person.mia", "person.eve"], "person.eve"),
        (["car.red", "car.blue"], "car.blue"),
    ],
)
def test_computers_user_is_the_person_who_joined_last(
    joins: list[str], user: str, monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    for identity in joins:
        endpoint = store_joined("192.0.2.1", Joined(identity, 7447, b"ca", b"certificate", b"key", ""))
    credentials = Credentials.of(endpoint)
    assert credentials.me == user
    assert [credentials.identity(each) for each in joins] == joins


def test_leave_refuses_beside_running_gateways(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    monkeypatch.delenv("FLEET_ENDPOINT", raising=False)
    endpoint = store_joined("192.0.2.1", Joined("car.red", 7447, b"ca", b"certificate", b"key", ""))
    mark = RunningMark(directory_of(endpoint), "fleet", "red")
    mark.renew()
    refused = in_process.fleet("leave")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "(red)" in refused.stderr
    assert Credentials.of(endpoint).exist
    mark.end()
    assert in_process.fleet("leave").returncode == 0
    assert not Credentials.of(endpoint).exist
    RunningMark(directory_of(DEFAULT_ENDPOINT), "fleet", "red").renew()
    assert "has not joined a hub" in in_process.fleet("leave").stderr


def test_service_invited_elsewhere_is_taken_back(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    recorder = service(Service.RECORDER)
    assert in_process.fleet("hub", "init", "--local").returncode == 0
    store = HubStore.of(SECURE_ENDPOINT)
    store.reserve(recorder)
    with pytest.raises(NoCredentials, match="fleet hub init --local --service recorder"):
        Credentials.of(SECURE_ENDPOINT).identity(recorder)
    assert in_process.fleet("hub", "init", "--local", "--service", "recorder").returncode == 0
    assert Credentials.of(SECURE_ENDPOINT).identity(recorder) == recorder


def test_other_bus_in_the_environment_is_told_with_the_way_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    """The hub would be set up, and no command would use it: the next one said that this computer was no hub."""
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("FLEET_ENDPOINT", other := "tcp/192.0.2.1:7447")
    done = in_process.fleet("hub", "init", "--local")
    assert done.returncode == 0
    assert has_parts(done.stderr, f"{other} … unset FLEET_ENDPOINT")
    refused = in_process.fleet("hub", "show")
    assert refused.returncode == 1
    assert has_parts(refused.stderr, f"{other} … {SECURE_ENDPOINT} … unset FLEET_ENDPOINT")
    monkeypatch.delenv("FLEET_ENDPOINT")
    assert in_process.fleet("hub", "init", "--local").stderr == ""
    assert in_process.fleet("hub", "show").returncode == 0

"""The files of a hub: made once, renewed when due, and what is lost or damaged is named."""

import json
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fleet.hub import authority
from fleet.hub.hub_store import BrokenHub, HubStore
from schemas.bus import Credentials, NoCredentials
from schemas.identity import car, person

ENDPOINT = "tls/127.0.0.1:7447"
NOW = datetime(2026, 11, 26, tzinfo=UTC)
ME = person("ann")


def store_in(directory: Path) -> HubStore:
    store = HubStore.load(Credentials(directory, ENDPOINT))
    store.ensure([car("red")], ME, addresses=["192.0.2.1"], listens=["tls/0.0.0.0:7447"], now=NOW)
    return store


def files(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def common_names(store: HubStore) -> set[str]:
    return {each["cert_common_names"][0] for each in store.credentials.access_control["subjects"]}


def test_nobody_else_can_read_its_files(tmp_path: Path) -> None:
    store = store_in(tmp_path / "tls")
    assert {stat.S_IMODE(path.stat().st_mode) for path in store.directory.iterdir()} == {0o600}
    assert stat.S_IMODE(store.directory.stat().st_mode) == 0o700


def test_a_second_time_changes_nothing(tmp_path: Path) -> None:
    before = files(store_in(tmp_path).directory)
    assert files(store_in(tmp_path).directory) == before


def test_due_certificates_are_renewed_and_the_authority_stays(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    before = files(store.directory)
    store.ensure([], ME, addresses=["192.0.2.1"], now=NOW + authority.LIFETIME - timedelta(days=30))
    changed = {name for name, data in files(store.directory).items() if before[name] != data}
    assert changed == {"hub.pem", "hub.key", f"{ME}.pem", f"{ME}.key", "identities.json"}
    assert store.credentials.listens == ["tls/0.0.0.0:7447"], "as before"


def test_whoever_is_revoked_is_in_no_rule_and_comes_back_under_another_name(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.reserve(person("mia"), NOW)
    assert "person.mia" in common_names(store)
    assert store.revoke(person("mia"))
    assert not store.revoke(person("mia"))
    assert not store.revoke(person("tom"))
    assert common_names(store) == {"car.red", ME}
    store.reserve(person("mia"), NOW)
    assert common_names(store) == {"car.red", ME, "person.mia.2"}


def test_a_second_invitation_makes_the_first_certificate_worthless(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    for _ in range(2):
        store.reserve(person("mia"), NOW)
    assert common_names(store) == {"car.red", ME, "person.mia.2"}


def test_a_lost_authority_is_said_and_nothing_is_overwritten(tmp_path: Path) -> None:
    store_in(tmp_path).directory.joinpath("ca.key").unlink()
    before = files(tmp_path)
    with pytest.raises(BrokenHub, match="join again"):
        store_in(tmp_path)
    assert files(tmp_path) == before


@pytest.mark.parametrize("text", ["", "[]", "{", '{"person.mia": {"what": 1}}', '{"person.mia": 1}'])
def test_damaged_lists_of_identities_are_said(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    directory = Credentials.of(ENDPOINT).directory
    directory.mkdir(parents=True)
    (directory / "identities.json").write_text(text)
    with pytest.raises(BrokenHub, match=r"identities\.json"):
        HubStore.of(ENDPOINT)


def test_without_a_certificate_the_way_to_one_is_said(tmp_path: Path) -> None:
    credentials = Credentials(tmp_path, ENDPOINT)
    with pytest.raises(NoCredentials, match="fleet join"):
        credentials.of_client()
    with pytest.raises(NoCredentials, match="fleet up --secure"):
        credentials.of_hub()


def test_a_program_has_its_own_certificate_or_that_of_the_user(tmp_path: Path) -> None:
    credentials = store_in(tmp_path).credentials
    assert credentials.identity("car.red") == "car.red"
    with pytest.raises(NoCredentials, match="fleet hub init --car blue"):
        credentials.identity("car.blue")
    (tmp_path / "hub.key").unlink()
    with pytest.raises(NoCredentials, match="fleet hub invite --car blue"):
        credentials.identity("car.blue")
    assert credentials.identity("service.console") == ME, "the page of a person"
    assert credentials.identity() == ME


def test_damaged_rules_are_said(tmp_path: Path) -> None:
    credentials = store_in(tmp_path).credentials
    (tmp_path / "hub.json").write_text("{")
    with pytest.raises(NoCredentials, match=r"hub\.json"):
        _ = credentials.access_control
    (tmp_path / "hub.json").write_text(json.dumps({"listen": []}))
    with pytest.raises(NoCredentials, match=r"hub\.json"):
        _ = credentials.access_control

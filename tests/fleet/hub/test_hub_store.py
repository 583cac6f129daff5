"""The files of a hub: made once, renewed when due, and what is lost or damaged is named."""

import json
import stat
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fleet.hub import certificate_authority
from fleet.hub.certificate_parts import LIFETIME
from fleet.hub.hub_store import BrokenHub, HubStore
from schemas.bus.credentials import Credentials, NoCredentials
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


def test_second_time_changes_nothing(tmp_path: Path) -> None:
    before = files(store_in(tmp_path).directory)
    assert files(store_in(tmp_path).directory) == before


def test_due_certificates_are_renewed_and_the_authority_stays(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    before = files(store.directory)
    store.ensure([], ME, addresses=["192.0.2.1"], now=NOW + LIFETIME - timedelta(days=30))
    changed = {name for name, data in files(store.directory).items() if before[name] != data}
    assert changed == {"hub.pem", "hub.key", f"{ME}.pem", f"{ME}.key", "identities.json"}
    assert store.credentials.listens == ["tls/0.0.0.0:7447"], "as before"


def test_revoked_identity_is_in_no_rule_and_returns_under_new_name(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.reserve(person("mia"), NOW)
    assert "person.mia" in common_names(store)
    assert store.revoke(person("mia"))
    rules = store.directory / "hub.json"
    before = rules.read_bytes()
    rules.write_text("{}")  # as if writing it had failed
    assert store.revoke(person("mia")), "once more, and the rules are in force"
    assert json.loads(rules.read_bytes())["access_control"] == json.loads(before)["access_control"]
    assert not store.revoke(person("tom"))
    assert common_names(store) == {"car.red", ME}
    store.reserve(person("mia"), NOW)
    assert common_names(store) == {"car.red", ME, "person.mia.2"}


@pytest.mark.parametrize("entry", [{"until": 5}, {"until": "2027", "generation": "x"}, {"nonsense": 1}, 3])
def test_damaged_identities_are_named(entry: object, tmp_path: Path) -> None:
    store_in(tmp_path).directory.joinpath("identities.json").write_text(json.dumps({"person.root": entry}))
    with pytest.raises(BrokenHub, match=r"identities\.json"):
        store_in(tmp_path)


def test_second_invitation_makes_the_first_certificate_worthless(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    for _ in range(2):
        store.reserve(person("mia"), NOW)
    assert common_names(store) == {"car.red", ME, "person.mia.2"}


def test_lost_authority_is_said_and_nothing_is_overwritten(tmp_path: Path) -> None:
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


def test_program_uses_own_certificate_or_that_of_user(tmp_path: Path) -> None:
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


def test_revocation_survives_concurrent_join(tmp_path: Path) -> None:
    """One program waits for eve to join. Another one revokes bob."""
    one = store_in(tmp_path)
    one.reserve(person("bob"), NOW)
    one.reserve(person("eve"), NOW)
    assert HubStore.load(one.credentials).revoke(person("bob"))
    _, request = certificate_authority.new_request("eve")
    one.sign(request, person("eve"), NOW)
    assert HubStore.load(one.credentials).known[person("bob")].revoked
    assert common_names(one) == {"car.red", ME, "person.eve"}


@pytest.mark.parametrize("change", [HubStore.revoke, HubStore.reserve])
def test_no_certificate_after_concurrent_revoke_or_new_invitation(
    change: Callable[[HubStore, str], object], tmp_path: Path
) -> None:
    one = store_in(tmp_path)
    _, request = certificate_authority.new_request("eve")
    one.reserve(person("eve"), NOW)
    change(HubStore.load(one.credentials), person("eve"))
    with pytest.raises(certificate_authority.BadRequestForCertificate):
        one.sign(request, person("eve"), NOW)


def test_user_of_hub_computer_cannot_be_invited(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    with pytest.raises(BrokenHub, match="another name"):
        store.reserve(ME, NOW)
    assert store.credentials.identity() == ME


def test_ensure_keeps_remote_identity_unless_taken(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.reserve(car("red"), NOW)
    assert not (tmp_path / "car.red.key").exists()
    store.ensure([car("red")], ME, addresses=[], now=NOW)
    assert "car.red.2" in common_names(store)
    with pytest.raises(NoCredentials):
        store.credentials.identity(car("red"))
    store.ensure([], ME, addresses=[], now=NOW, take=[car("red")])
    assert "car.red.3" in common_names(store)
    assert store.credentials.identity(car("red")) == car("red")


@pytest.mark.parametrize("name", [f"{ME}.key", f"{ME}.pem", "car.red.key", "hub.key", "hub.pem", "hub.json"])
@pytest.mark.parametrize("text", ["", "junk"])
def test_damaged_certificate_file_is_made_again(name: str, text: str, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    (tmp_path / name).write_text(text)
    HubStore.load(store.credentials).ensure([car("red")], ME, addresses=["192.0.2.1"], now=NOW)
    for each in (ME, "car.red", "hub"):
        assert certificate_authority.belong(
            (tmp_path / f"{each}.pem").read_bytes(), (tmp_path / f"{each}.key").read_bytes()
        )
    assert common_names(store) == {"car.red", ME}


@pytest.mark.parametrize("name", ["ca.key", "ca.pem"])
def test_damaged_certificate_authority_is_named(name: str, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    (tmp_path / name).write_text("junk")
    store.reserve(person("eve"), NOW)
    _, request = certificate_authority.new_request("eve")
    with pytest.raises(BrokenHub, match=r"ca\.key"):
        store.sign(request, person("eve"), NOW)


def test_store_change_waits_for_lock_but_not_for_killed_holder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_in(tmp_path)
    monkeypatch.setattr("schemas.process.file_lock.LOCK_TIMEOUT_S", 0.1)
    holder = (
        "import sys, time; from pathlib import Path; from schemas.process.file_lock import FileLock;"
        "lock = FileLock(Path(sys.argv[1])); print(lock.try_take(), flush=True); time.sleep(1e6)"
    )
    command = [sys.executable, "-c", holder, str(tmp_path / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "True\n"
        with pytest.raises(BrokenHub, match="lock"):
            store.reserve(person("eve"), NOW)
        other.kill()
        other.wait()
    store.reserve(person("eve"), NOW)
    assert "person.eve" in common_names(store)

"""The certificate of the console: made once, renewed for new addresses, private."""

import ssl
import stat
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner

from fleet.cli import cli
from fleet.console import certificate, network_console
from fleet.console.certificate import BadKeyFile, ensure_certificate, needs_renewal
from fleet.console.people_book import PagePerson, PeopleBook
from fleet.console.people_file import PeopleFile, people_path
from schemas.bus import resolve_endpoint

NOW = datetime(2026, 11, 22, tzinfo=UTC)


def test_certificate_is_kept_until_new_address_or_expiry(tmp_path: Path) -> None:
    made = ensure_certificate(["192.168.1.5", "laptop.local"], NOW, tmp_path)
    assert made.names == ("192.168.1.5", "laptop.local")
    key = made.key_path.read_bytes()
    for path in (made.path, made.key_path):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    made.load_into(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
    assert ensure_certificate(["192.168.1.5"], NOW + timedelta(days=300), tmp_path) == made
    moved = ensure_certificate(["10.0.0.7"], NOW, tmp_path)
    assert moved.names == ("10.0.0.7", "192.168.1.5", "laptop.local")
    assert moved.fingerprint != made.fingerprint
    assert ensure_certificate(["192.168.1.5"], NOW, tmp_path) == moved, "a move back needs no new one"
    late = ensure_certificate(["10.0.0.7"], NOW + timedelta(days=380), tmp_path)
    assert late.expires > moved.expires
    assert key == made.key_path.read_bytes(), "the key stays"


def test_world_readable_key_is_closed_and_damaged_key_named(tmp_path: Path) -> None:
    made = ensure_certificate(["10.0.0.7"], NOW, tmp_path)
    made.key_path.chmod(0o644)
    ensure_certificate(["10.0.0.7"], NOW, tmp_path)
    assert stat.S_IMODE(made.key_path.stat().st_mode) == 0o600
    made.path.write_text("damaged")
    assert ensure_certificate(["10.0.0.7"], NOW, tmp_path).names == ("10.0.0.7",)
    made.key_path.write_text("damaged")
    with pytest.raises(BadKeyFile, match="delete it"):
        ensure_certificate(["10.0.0.7"], NOW, tmp_path)


def test_new_key_makes_new_console_certificate(tmp_path: Path) -> None:
    made = ensure_certificate(["10.0.0.7"], NOW, tmp_path)
    made.key_path.unlink()
    assert ensure_certificate(["10.0.0.7"], NOW, tmp_path).fingerprint != made.fingerprint


def test_many_addresses_need_no_new_certificate_each_time(tmp_path: Path) -> None:
    many = [f"10.0.{number}.1" for number in range(certificate.MAX_NAMES + 5)]
    assert ensure_certificate(many, NOW, tmp_path) == ensure_certificate(many, NOW, tmp_path)


def test_certificate_is_renewed_a_month_before_its_end() -> None:
    for days, needed in ((31, False), (30, True), (-1, True)):
        assert needs_renewal(["a"], ["a"], NOW + timedelta(days=days), NOW) is needed


def test_new_address_is_written_for_fleet_console_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    addresses = ["192.168.1.5"]
    monkeypatch.setattr(network_console, "own_addresses", lambda: list(addresses))
    people, listener = PeopleFile(tmp_path / "people.json"), network_console.LimitedListener.on_port(0)
    try:
        served = network_console.Lan(listener, people)
        assert people.read().address == f"https://192.168.1.5:{served.port}"
        addresses[:] = ["10.0.0.7", "192.168.1.5"]
        served._renew()
        assert people.read().address == f"https://10.0.0.7:{served.port}"
        assert "10.0.0.7" in served.certificate.names
    finally:
        listener.close()


def test_people_file_is_private_shared_and_survives_damage(tmp_path: Path) -> None:
    path = tmp_path / "state" / "fleet.@console.json"
    ours, theirs = PeopleFile(path), PeopleFile(path)
    assert ours.read() == PeopleBook()
    theirs.change(lambda book: (book.issue("K7QF3MXP", PagePerson("mia"), 1.8e9), None))
    assert len(ours.read().codes) == 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    ours.change(lambda book: (book.redeem("K7QF3MXP", "c", "d", "", 1.8e9) or book, None))
    assert [each.id for each in theirs.read().devices] == ["d"]
    path.write_text("{")
    assert theirs.read() == PeopleBook()


def test_open_code_of_a_person_without_device_is_revoked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    people = PeopleFile(people_path(resolve_endpoint(None), "fleet"))
    people.change(lambda book: (book.issue("K7QF3MXP", PagePerson("mia"), time.time()), None))
    done = CliRunner().invoke(cli, ["console", "people", "--revoke", "mia"])
    assert (done.exit_code, people.read().codes) == (0, ()), done.output
    assert CliRunner().invoke(cli, ["console", "people", "--revoke", "mia"]).exit_code == 2


def test_revoking_tells_that_people_file_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    people = PeopleFile(people_path(resolve_endpoint(None), "fleet"))
    people.change(lambda book: (book.issue("K7QF3MXP", PagePerson("mia"), 1.8e9), None))
    people.change(lambda book: (book.redeem("K7QF3MXP", "c", "d", "", 1.8e9) or book, None))
    lock = people.path.with_name(f"{people.path.name}.lock")
    lock.unlink()
    lock.mkdir()
    failed = CliRunner().invoke(cli, ["console", "people", "--revoke", "mia"])
    assert (failed.exit_code, str(people.path) in failed.stderr) == (1, True), failed.output

"""One computer joins, over a real TLS server. Strangers, guesses and a false hub do not."""

import http.client
import json
import resource
import shutil
import socket
import ssl
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fleet.hub.discovery import announced, hubs_found
from fleet.hub.hub_store import HubStore
from fleet.hub.invitation import Invitation
from fleet.hub.join import NotJoined, join
from fleet.hub.join_code import MAX_GUESSES, JoinCode
from schemas.bus.credentials import Credentials
from schemas.identity import car, person, site
from schemas.state_dir import STATE_VARIABLE, directory_of
from tests.support import in_process
from tests.support.ports import free_port
from tests.support.processes import PATIENCE_S

ME = person("ann")


def made(directory: Path) -> HubStore:
    store = HubStore(Credentials(directory, "tls/127.0.0.1:7447"))
    store.ensure([car("red")], ME, addresses=["127.0.0.1"])
    store.reserve(person("mia"))
    return store


@pytest.fixture
def store(tmp_path: Path) -> HubStore:
    return made(tmp_path / "hub")


@pytest.fixture
def invitation(store: HubStore) -> Iterator[Invitation]:
    opened = Invitation(
        store, person("mia"), hub_port=7447, address="127.0.0.1", port=free_port(), fleet_file="cars: {}"
    )
    yield opened
    opened.close()


def post(invitation: Invitation, body: bytes, **headers: str) -> tuple[int, dict[str, str]]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    connection = http.client.HTTPSConnection("127.0.0.1", invitation.port, timeout=30, context=context)
    connection.request("POST", "/join", body, headers)
    answer = connection.getresponse()
    found = answer.status, json.loads(answer.read())
    connection.close()
    return found


@pytest.mark.parametrize("where", ["", "buses", "hub"])
def test_join_spends_no_code_if_file_is_in_the_way(
    where: str, invitation: Invitation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = tmp_path / "state"
    monkeypatch.setenv(STATE_VARIABLE, str(state))
    hub = directory_of("tls/127.0.0.1:7447")
    place = {"": state, "buses": hub.parent, "hub": hub}[where]
    place.parent.mkdir(parents=True, exist_ok=True)
    place.touch()
    done = in_process.fleet("join", f"127.0.0.1:{invitation.port}", invitation.code, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{place}: " in done.stderr
    assert STATE_VARIABLE in done.stderr
    assert join("127.0.0.1", invitation.code, invitation.port).identity == person("mia")


def test_join_spends_no_code_if_disk_is_full(
    invitation: Invitation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv(STATE_VARIABLE, str(state))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        done = in_process.fleet("join", f"127.0.0.1:{invitation.port}", invitation.code, cwd=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{state}: " in done.stderr
    assert [*state.iterdir()] == []
    assert join("127.0.0.1", invitation.code, invitation.port).identity == person("mia")


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", ""], ids=["named", "found"])
def test_join_on_the_hubs_own_computer_spends_no_code(
    host: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    own = made(directory_of("tls/127.0.0.1:7447") / "tls")
    opened = Invitation(own, person("mia"), hub_port=7447, address="127.0.0.1", port=free_port(), fleet_file="cars: {}")
    # The real search, with more patience: a busy machine answers late.
    monkeypatch.setattr("fleet.commands.hub.hubs_found", lambda _: hubs_found(["127.0.0.1"], PATIENCE_S))
    with closing(opened), announced(opened.port, opened.code, ["127.0.0.1"]):
        words = [host.format(port=opened.port)] if host else []
        done = in_process.fleet("join", *words, opened.code, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (1, "")
        assert "still good" in done.stderr
        assert join("127.0.0.1", opened.code, opened.port).identity == person("mia")


def test_hub_that_cannot_sign_says_so(invitation: Invitation, store: HubStore, tmp_path: Path) -> None:
    other = made(tmp_path / "other")
    shutil.copy(other.directory / "ca.key", store.directory / "ca.key")
    with pytest.raises(NotJoined, match="cannot sign"):
        join("127.0.0.1", invitation.code, invitation.port)


@pytest.mark.parametrize("host", ["a b", "a..b"])
def test_host_that_is_no_address_is_refused(host: str, invitation: Invitation, tmp_path: Path) -> None:
    done = in_process.fleet("join", host, invitation.code, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert "is not the address of a computer" in done.stderr


def test_join_code_works_once(invitation: Invitation, store: HubStore) -> None:
    joined = join("127.0.0.1", invitation.code, invitation.port)
    assert (joined.identity, joined.port, joined.fleet_file) == (person("mia"), 7447, "cars: {}")
    assert joined.ca == (store.directory / "ca.pem").read_bytes()
    assert invitation.wait() == ""
    assert invitation.joined_from == "127.0.0.1"
    assert not (store.directory / "person.mia.key").exists(), "its key is on the other computer only"
    with pytest.raises(NotJoined, match="used or has expired"):
        join("127.0.0.1", invitation.code, invitation.port)


def test_site_joins_a_hub_of_a_hundred_cars(store: HubStore) -> None:
    for number in range(100):
        store.reserve(car(f"car{number}"))
    store.reserve(site("north"))
    large = Invitation(store, site("north"), hub_port=7447, port=0, fleet_file="# " + "x" * 100_000)
    try:
        joined = join("127.0.0.1", large.code, large.port, addresses=["127.0.0.1"])
        assert len(json.dumps(joined.rules)) > 200_000
        assert len(joined.fleet_file) > 100_000
    finally:
        large.close()


def test_five_wrong_codes_end_it(invitation: Invitation) -> None:
    wrong = JoinCode("2" * 12, invitation.code.pin)
    for _ in range(MAX_GUESSES):
        with pytest.raises(NotJoined, match="wrong"):
            join("127.0.0.1", wrong, invitation.port)
    with pytest.raises(NotJoined, match="used or has expired"):
        join("127.0.0.1", invitation.code, invitation.port)
    assert str(MAX_GUESSES) in invitation.wait()
    assert invitation.joined_from == ""


@pytest.mark.parametrize("guess", ["\\ud800", "\\u0000", "x" * 9000])
def test_join_guess_of_any_characters_is_refused(guess: str, invitation: Invitation) -> None:
    assert post(invitation, f'{{"secret": "{guess}", "request": ""}}'.encode())[0] == 403


def test_concurrent_join_guesses_are_limited(invitation: Invitation) -> None:
    answers = [invitation._take("2" * 12, b"", [], "192.0.2.1")[0] for _ in range(1000)]
    assert answers == [403] * MAX_GUESSES + [410] * (1000 - MAX_GUESSES)


def test_join_sends_no_secret_to_false_hub(invitation: Invitation, tmp_path: Path) -> None:
    false = Invitation(made(tmp_path / "false"), person("mia"), hub_port=7447, address="127.0.0.1", port=free_port())
    try:
        with pytest.raises(NotJoined, match="pretends"):
            join("127.0.0.1", invitation.code, false.port)
        assert false._wrong == 0, "the secret was not sent"
    finally:
        false.close()


def test_false_hub_beside_right_authority_gets_nothing(invitation: Invitation, tmp_path: Path) -> None:
    """Anybody can read the certificate of the authority. OpenSSL trusts each one of a text."""
    false = Invitation(made(tmp_path / "false"), person("mia"), hub_port=7447, address="127.0.0.1", port=free_port())
    try:
        right, own = invitation._ca, false._ca
        for false._ca in (right + own, own + right):
            with pytest.raises(NotJoined, match="pretends"):
                join("127.0.0.1", invitation.code, false.port)
        assert false._wrong == 0, "the secret was not sent"
    finally:
        false.close()


def test_join_refuses_invalid_identity(invitation: Invitation) -> None:
    invitation._answer["identity"] = "../../escaped"
    with pytest.raises(NotJoined, match="identity"):
        join("127.0.0.1", invitation.code, invitation.port)


@pytest.mark.parametrize(
    "body", [b"", b"junk", b"[]", b"{}", b'{"secret": 1}', b'{"secret": "x", "request": "?"}', b"x" * 20_000]
)
def test_malformed_join_request_is_refused_and_costs_no_guess(body: bytes, invitation: Invitation) -> None:
    status, found = post(invitation, body)
    assert status in (400, 413)
    assert found["error"]
    assert join("127.0.0.1", invitation.code, invitation.port).identity == person("mia")


def test_invalid_certificate_request_keeps_join_code(invitation: Invitation) -> None:
    body = json.dumps({"secret": invitation.code.secret, "request": "anVuaw=="}).encode()
    assert post(invitation, body)[0] == 400
    assert join("127.0.0.1", invitation.code, invitation.port).identity == person("mia")


def test_silent_strangers_do_not_delay_join(invitation: Invitation) -> None:
    silent = [socket.create_connection(("127.0.0.1", invitation.port)) for _ in range(20)]
    try:
        assert join("127.0.0.1", invitation.code, invitation.port).identity == person("mia")
    finally:
        for each in silent:
            each.close()


def test_join_without_listener_says_no_answer(store: HubStore) -> None:
    with pytest.raises(NotJoined, match="does not answer"):
        join("127.0.0.1", JoinCode.new(bytes(32)), free_port())

"""The routes of the sessions page without a browser. They serve recordings, and no path leads out of the folder."""

import contextlib
import http.client
import io
import json
import select
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from fleet.console.past_api import MAX_OPEN_LOOKS
from tests.fleet.recording.damaged import written
from tests.fleet.replay.make_session import START_NS, make
from tests.support.console import ConsoleProcess
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses


@pytest.fixture
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetProcesses]:
    processes = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("server"))
    yield processes
    processes.close()


def answer(port: int, verb: str, path: str, body: str = "", **headers: str) -> tuple[int, bytes]:
    """Send a request to the console; return status and text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S * 2)
    connection.request(verb, path, body, headers)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def cookie_of(port: int) -> str:
    """Return the cookie of the console's own pages."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S * 2)
    connection.request("GET", "/hello")
    found = connection.getresponse().getheader("Set-Cookie") or ""
    connection.close()
    return found.partition(";")[0]


def test_sessions_api_lists_verifies_downloads_exports_without_path_escape(
    fleet: FleetProcesses, tmp_path: Path
) -> None:
    place = tmp_path / "sessions"
    secret = tmp_path / "20260101T000000Z-secret"
    foreign = place / "20260920T141320Z-\u0443\u0440\u043e\u043a"
    for path in (place / "20260921T141320Z-fleet", foreign, secret):
        path.mkdir(parents=True)
        written(path / "0001.mcap")
    (place / "link").symlink_to(secret)
    console = ConsoleProcess(fleet, "--sessions", str(place))
    own = {"Origin": console.address, "Cookie": cookie_of(console.port)}

    def ask(path: str, **headers: str) -> Any:
        status, data = answer(console.port, "POST", path, **(own | headers))
        return json.loads(data) if status == 200 else status

    listed = json.loads(answer(console.port, "GET", "/sessions")[1])
    assert [each["name"] for each in listed["sessions"]] == ["20260921T141320Z-fleet", foreign.name]
    assert answer(console.port, "GET", f"/sessions/{quote(foreign.name)}/download")[0] == 200, "its name is no Latin-1"
    name = listed["sessions"][0]["name"]
    verdict = ask(f"/sessions/{name}/verify")
    assert "session.json is missing" in verdict["words"]
    status, data = answer(console.port, "GET", f"/sessions/{name}/download")
    archive = zipfile.ZipFile(io.BytesIO(data))
    assert status == 200
    assert archive.read(f"{name}/0001.mcap") == (place / name / "0001.mcap").read_bytes()
    exported = ask(f"/sessions/{name}/export/csv")
    tables = zipfile.ZipFile(io.BytesIO(answer(console.port, "GET", exported["url"])[1]))
    assert any(each.endswith("/fleet.v1.Range.csv") for each in tables.namelist()), tables.namelist()
    assert "No recorder is on the bus." in ask("/recording/start")["words"]

    for bad in ("..", "%2e%2e", f"..%2f{secret.name}", f"../{secret.name}", "link", "%2fetc", ".", "a%00b"):
        assert answer(console.port, "GET", f"/sessions/{bad}/download")[0] == 404, bad
        assert ask(f"/sessions/{bad}/verify") == 404, bad
    for bad in ("%2e%2e", f"..%2f{name}", name):
        assert answer(console.port, "GET", f"/exports/{bad}")[0] == 404, bad
    assert ask(f"/sessions/{name}/verify", Origin="http://evil.example") == 403
    assert ask("/recording/stop", Cookie="") == 403
    assert console.process.end() == 0


def test_past_api_answers_without_path_escape(fleet: FleetProcesses, tmp_path: Path) -> None:
    place, secret = tmp_path / "sessions", tmp_path / "20260101T000000Z-secret"
    name = "20260921T141320Z-fleet"
    for path in (place / name, secret):
        path.mkdir(parents=True)
        make(path / "0001.mcap")
    console = ConsoleProcess(fleet, "--sessions", str(place))
    own = {"Origin": console.address, "Cookie": cookie_of(console.port)}
    body = json.dumps({"at_ms": START_NS // 1_000_000 + 4500, "car": "red"})
    lanes = json.loads(answer(console.port, "GET", f"/past/{name}")[1])
    assert (lanes["ok"], lanes["cars"]) == (True, ["blue", "green", "red"])
    moment = json.loads(answer(console.port, "POST", f"/past/{name}/at", body, **own)[1])
    assert [each["motion"]["motion"] for each in moment["cars"]] == ["forward"] * 3
    assert moment["detail"]["car"] == "red"
    for bad in ("..", "%2e%2e", f"..%2f{secret.name}", f"../{secret.name}", ".", "a%00b"):
        assert answer(console.port, "GET", f"/past/{bad}")[0] == 404, bad
        assert answer(console.port, "POST", f"/past/{bad}/at", body, **own)[0] == 404, bad
    assert answer(console.port, "POST", f"/past/{name}/at", "{}x", **own)[0] == 400
    assert answer(console.port, "POST", f"/past/{name}/at", body, **own | {"Origin": "http://evil.example"})[0] == 403
    many = [send_request(console.port, "GET", f"/past/{name}") for _ in range(10)]
    statuses = [each.getresponse().status for each in many]
    for each in many:
        each.close()
    assert set(statuses) == {200, 429}
    assert statuses.count(200) >= MAX_OPEN_LOOKS
    assert console.process.end() == 0


REQUESTS = 40
"""Requests that one person sends at once."""
ROUNDS = 4
"""Maximum number of tries."""
MAX_SLOWER = 6.0
"""Ratio of times: a process beside those of others, at 2 at a time, and what a busy machine adds. All 40 need 20."""


def send_request(port: int, verb: str, path: str, **headers: str) -> http.client.HTTPConnection:
    """Send a request. Return its connection, whose answer nobody has read."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S * 2)
    connection.request(verb, path, "", headers)
    return connection


@pytest.mark.parametrize(
    ("verb", "kind", "kept"), [("GET", "", True), ("POST", "verify", True), ("POST", "verify", False)]
)
def test_many_requests_of_one_person_keep_no_other_request_waiting(
    fleet: FleetProcesses, tmp_path: Path, verb: str, kind: str, kept: bool
) -> None:
    """Also if the clients of these requests have gone."""
    path = tmp_path / "sessions" / "20260921T141320Z-fleet"
    path.mkdir(parents=True)
    written(path / "0001.mcap")
    console = ConsoleProcess(fleet, "--sessions", str(path.parent))
    own = {"Origin": console.address, "Cookie": cookie_of(console.port)}
    flooded = f"/sessions/{path.name}/{kind}" if kind else "/sessions"

    def list_time() -> float:
        since = time.monotonic()
        assert json.loads(answer(console.port, "GET", "/sessions")[1])["sessions"]
        return time.monotonic() - since

    def waits() -> bool:
        """Return True if another request took longer than beside those of others."""
        alone_s = max(list_time(), list_time())
        with contextlib.ExitStack() as connections:
            requests = [send_request(console.port, verb, flooded, **own) for _ in range(REQUESTS)]
            for each in requests:
                connections.callback(each.close)
            select.select([each.sock for each in requests], [], [], PATIENCE_S)  # the others wait or are at work now
            if not kept:
                connections.close()
            flooded_s = list_time()
            if not kept:  # its own next request does not wait for them, either
                since = time.monotonic()
                assert answer(console.port, verb, flooded, "", **own)[0] == 200
                flooded_s = max(flooded_s, time.monotonic() - since)
        return flooded_s >= MAX_SLOWER * alone_s

    # A stalled machine is as slow as a request that waits, but not each time.
    assert not all(waits() for _ in range(ROUNDS))
    assert console.process.end() == 0

"""The console's server without a browser: it stops cars, pairs devices, survives attacks."""

import contextlib
import http.client
import json
from collections.abc import Iterator

import pytest
from click.testing import CliRunner
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from fleet.cli import cli
from fleet.client.client import Fleet as Client
from fleet.console.people_file import PeopleFile, people_path
from tests.support.console import ConsoleProcess
from tests.support.judge import Judge
from tests.support.network_client import NetworkDevice, network_port, untrusting
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for


class ServerStage:
    """One car, its gateway, and a console that also serves the network."""

    def __init__(self, fleet: FleetProcesses) -> None:
        self.fleet = fleet
        _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
        fleet.gateway(link, car="red", platform="arduino")
        self.judge = Judge.follow(fleet.bus, "red")
        self.console = ConsoleProcess(fleet, "--lan", "--lan-port", "0")
        self.lan_port = network_port(self.console)
        fleet.ready("red")
        self.person = Client(fleet.endpoint, sender="mia", kind="person")

    def run(self, *arguments: str) -> str:
        """Run `fleet console ...`; its output."""
        done = CliRunner().invoke(cli, ["console", *arguments], env=self.fleet.environment)
        assert done.exit_code == 0, done.output
        return done.output

    def code(self, *arguments: str) -> str:
        """A new pairing code."""
        return self.run("pair", *arguments).split(" type ")[1][:9]

    def device(self, *arguments: str) -> NetworkDevice:
        """A paired device."""
        made = NetworkDevice(self.lan_port)
        assert made.pair(self.code(*arguments))["ok"]
        return made

    def drive(self) -> None:
        """Another person drives red."""
        self.person.car("red").drive("forward", 10.0, wait=False).check()
        wait_for(lambda: self.judge.driving, "red drives")

    def rest(self) -> None:
        """Stop red and end its hold, if it was driven or stopped."""
        if not self.fleet.state("safety").HasField("hold") and not self.judge.driving:
            return
        self.person.stop(["red"])
        self.person.resume(["red"])
        wait_for(lambda: not self.judge.driving, "red stands")

    def log(self) -> str:
        """What the console has logged."""
        return self.console.process.stderr


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerStage]:
    stage = ServerStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("server")))
    yield stage
    stage.person.close()
    assert stage.console.process.end() == 0
    stage.fleet.close()


@pytest.fixture
def stage(stages: ServerStage) -> Iterator[ServerStage]:
    yield stages
    stages.rest()


def answer(port: int, verb: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    """Ask the console; its status and its text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    with contextlib.suppress(ConnectionError):  # it refuses a large body before its end
        connection.request(verb, path, body, headers)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def test_a_stop_stops_and_strangers_are_refused(stage: ServerStage) -> None:
    console, own = stage.console, stage.console.address
    status, page = answer(console.port, "GET", "/")
    assert status == 200
    assert b"<html" in page
    assert answer(console.port, "GET", "/", Host="evil.example")[0] in (400, 403, 421)
    stage.drive()
    assert answer(console.port, "POST", "/stop", Origin="http://evil.example")[0] == 403
    assert stage.judge.driving, "a stranger stopped it"
    assert answer(console.port, "POST", "/stop", Origin=own)[0] // 100 == 2
    wait_for(lambda: not stage.judge.driving, "red stands")


def test_a_stranger_on_the_network_gets_nothing(stage: ServerStage) -> None:
    stranger = NetworkDevice(stage.lan_port)
    assert stranger.ask("GET", "/") == (303, b"")
    assert b"Pair this device" in stranger.ask("GET", "/pair")[1]
    for path in ("/hello", "/people", "/static/app.js", "/static/console.js", "/docs", "/..", "/static/../console.py"):
        status, text = stranger.ask("GET", path)
        assert (status, b"not paired" in text) == (403, True), path
    stage.drive()
    for path in ("/stop", "/people", "/plan/set"):
        assert stranger.ask("POST", path, "{}")[0] == 403
    with pytest.raises(InvalidStatus):
        stranger.socket()
    stranger.cookie = f"__Host-fleet_console_{stage.lan_port}=guess"
    with pytest.raises(InvalidStatus):
        stranger.socket()
    assert stage.judge.driving


def test_a_paired_device_has_its_person_and_stops_cars(stage: ServerStage) -> None:
    device = NetworkDevice(stage.lan_port)
    assert device.pair(stage.code())["ok"]
    for flag in ("; HttpOnly", "; Secure", "; SameSite=Strict", "; Path=/"):
        assert flag in device.cookie_flags
    assert device.ask("GET", "/")[0] == 200
    teacher = stage.device("teacher", "--rank", "lead")
    with teacher.socket() as page:
        hello = json.loads(page.recv())
    assert hello["person"] == {"name": "teacher", "rank": "lead"}
    stage.drive()
    assert device.ask("POST", "/stop", Origin="https://evil.example")[0] == 403
    assert device.ask("POST", "/stop", Host=f"evil.example:{stage.lan_port}")[0] == 403
    assert stage.judge.driving
    assert device.ask("POST", "/stop")[0] == 204
    wait_for(lambda: not stage.judge.driving, "red stands")
    # Only leads and this computer see who is paired, and pair others.
    assert json.loads(device.ask("GET", "/people")[1]) == {"may_pair": False, "lan": None}
    assert device.ask("POST", "/people", '{"t": "pair", "name": "x", "rank": "lead"}')[0] == 403
    listed = json.loads(teacher.ask("GET", "/people")[1])["lan"]
    assert {each["name"] for each in listed["devices"]} >= {"teacher"}
    offered = json.loads(teacher.ask("POST", "/people", '{"t": "pair", "name": "eva", "rank": "person"}')[1])
    assert NetworkDevice(stage.lan_port).pair(offered["code"])["name"] == "eva"
    assert offered["qr"].startswith("data:image/svg+xml")
    assert teacher.ask("POST", "/people", '{"t": "pair", "name": "Eva E", "rank": "person"}')[0] == 400


def book_file(stage: ServerStage) -> PeopleFile:
    """The file of the paired devices."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLEET_STATE_DIR", stage.fleet.environment["FLEET_STATE_DIR"])
        return PeopleFile(people_path(stage.fleet.endpoint, "fleet"))


@pytest.mark.parametrize("how", ["command", "page"])
def test_a_revoked_device_is_out_at_once(stage: ServerStage, how: str) -> None:
    device, lead = stage.device("thief"), stage.device("boss", "--rank", "lead")
    with device.socket() as page:
        hold(page)
        wait_for(lambda: stage.judge.driving, "red drives")
        if how == "command":
            assert "(thief) is revoked" in stage.run("people", "--revoke", "thief")
        else:
            listed = json.loads(lead.ask("GET", "/people")[1])["lan"]["devices"]
            (chosen,) = [each["id"] for each in listed if each["name"] == "thief"]
            assert lead.ask("POST", "/people", json.dumps({"t": "revoke", "id": chosen}))[0] == 200
        read_to_the_end(page)
    wait_for(lambda: not stage.judge.driving, "red stands")
    assert device.ask("GET", "/hello")[0] == 403
    assert device.ask("POST", "/stop")[0] == 403
    assert "thief" not in stage.run("people")
    stage.run("people", "--revoke", "boss")


def hold(page: ClientConnection) -> None:
    """Press forward for red, as a page does: with the newest tick."""
    while (message := json.loads(page.recv(timeout=10)))["t"] != "tick":
        pass
    page.send(json.dumps({"t": "press", "press": 1, "cars": ["red"], "motion": "forward", "n": message["n"]}))


def read_to_the_end(page: ClientConnection) -> None:
    """Read until the console closes the socket."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            page.recv(timeout=10)


def test_an_expired_cookie_opens_nothing_and_still_stops(stage: ServerStage) -> None:
    device = stage.device("old")
    file = book_file(stage)
    text = file.read().as_text()
    paired = next(each for each in file.read().devices if each.person.name == "old")
    aged = text.replace(str(paired.paired_s), str(paired.paired_s - 31 * 86_400))
    with device.socket() as page:
        file.change(lambda book: (type(book).of_text(aged), None))
        read_to_the_end(page)
    assert device.ask("GET", "/hello")[0] == 403
    assert device.ask("POST", "/plan/check", "roles: {}")[0] == 403
    with pytest.raises(InvalidStatus):
        device.socket()
    stage.drive()
    assert device.ask("POST", "/stop")[0] == 204
    wait_for(lambda: not stage.judge.driving, "red stands")


def test_a_thousand_guesses_get_nothing_and_are_slowed_down(stage: ServerStage) -> None:
    stranger, code = NetworkDevice(stage.lan_port), stage.code("late")
    connection = http.client.HTTPSConnection("127.0.0.1", stage.lan_port, timeout=30, context=untrusting())
    statuses: list[int] = []
    for number in range(1000):
        try:
            connection.request("POST", "/pair", f"AAAA{number:04}", {"Origin": stranger.origin})
            response = connection.getresponse()
        except (http.client.HTTPException, OSError):  # a stranger's connection lasts for ten seconds
            connection.close()
            continue
        statuses.append(response.status)
        response.read()
    connection.close()
    assert len(statuses) > 900
    assert set(statuses) <= {403, 429}
    assert statuses.count(403) < 10, "the others were not even compared"
    # The right code must wait, too, and is not used up.
    assert stranger.pair(code)["ok"] is False
    assert json.loads(answer(stage.console.port, "GET", "/people")[1])["lan"]["wrong_codes"] > 900
    assert stage.log().count("wrong pairing code") < 20
    assert any(each.person.name == "late" for each in book_file(stage).read().codes)

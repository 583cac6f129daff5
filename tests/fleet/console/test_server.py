"""The console's server without a browser: it stops cars, pairs devices, survives attacks."""

import contextlib
import http.client
import itertools
import json
import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh
from click.testing import CliRunner
from msgspec.structs import replace
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from fleet.cli import cli
from fleet.client.client import Fleet as Client
from fleet.client.commands import drive_request, resume_request
from fleet.console.budgets import (
    CHECK_BURST,
    CHECK_RATE,
    COMMAND_BURST,
    COMMAND_RATE,
    MAX_OPEN_COMMANDS,
    PAGE_BURST,
    PAGE_RATE,
    REQUEST_BURST,
)
from fleet.console.car_view import MAX_OTHER_CARS
from fleet.console.connection_limit import MAX_PER_DEVICE
from fleet.console.console import MAX_PAGES_OF_DEVICE, MAX_PAGES_OF_GUEST
from fleet.console.log_rate import LOG_BURST
from fleet.console.page_link import SEND_TIMEOUT_S
from fleet.console.people_file import PeopleFile, people_path
from fleet.console.plot_buffer import MAX_SERIES
from fleet.console.request_body import BODY_TIMEOUT_S
from fleet.console.server import MAX_MESSAGE_BYTES, SENT_TOO_MUCH, TRY_AGAIN_LATER
from fleet.console.waiting_room import ADDRESS_BURST
from schemas.bus import Bus, Sample, reply_message
from schemas.gen import fleet_v1_pb2 as pb
from schemas.keys import car_token, command_key, person_of, topic_key
from schemas.messages import encoding_of
from schemas.topics import Qos
from schemas.words import MODE_TEXTS
from tests.support.console import LEADS_ONLY, ConsoleProcess
from tests.support.judge import Judge
from tests.support.network_client import NetworkDevice, network_port, untrusting
from tests.support.page_flood import HALF_REQUESTS, PLAN, half_request
from tests.support.ports import free_endpoint
from tests.support.processes import LONG_S, FleetProcesses, wait_for
from tests.support.soaks import only_in_soak

PEOPLE = ("teacher:lead", "mia", "thief")
"""The people who may drive red."""
GUESTS = (
    *("calm", "echo", "eva", "bad", "large", "late", "old", "owner", "stop"),
    *("hasty", "bomber", "merger", "nervous", "greedy"),
    *("giver", *(f"giver_{kind}" for kind in ("take", "give_back", "unpause", "do"))),
    *("presser", "plotter", "pinger", "lister", "twotab", "tworeq", "viewer", "twoways"),
    *(f"pupil{number}" for number in range(30)),
)
"""The people who drive other cars."""
FLOOD = 40_000
"""Messages of a page that floods."""
STOPS_AT_ONCE = 40
INFLATED = 10_000_000
"""Size of a message that has some 10 kB when it is compressed: less than a page may send."""
EACH = 20
"""Bombs and plans of a viewer."""
MAX_COST = 6.0
"""Maximum CPU time that one of them costs, as a multiple of a page that opens."""
MAX_BOMB_MB = 5.0
"""Half of an inflated message."""
MAX_UNREAD_MB = 5.0
"""Growth by a page that reads nothing: its buffers, TLS, and what the allocator keeps."""
WARM_UP = 2000
"""Connections until TLS and the allocator need no more memory. The first thousand take 17 MB, the next one about 1."""
MAX_GROWTH_MB_PER_THOUSAND = 2.0


class ServerStage:
    """Cars, red before all, their gateways, and a console that also serves the network."""

    def __init__(self, fleet: FleetProcesses, *more: str) -> None:
        self.fleet = fleet
        cars = ("red", *more)
        _, links = fleet.simulate(*(f"{car}:arduino:tcp" for car in cars), truth=True)
        listed = (*PEOPLE, *(f"{name}:other" for name in GUESTS))
        people = [word for name in listed for word in ("--person", name)]
        for car, link in zip(cars, links, strict=True):
            longest = f"{LONG_S:g}s"  # longer than any wait here: only a stop ends a drive
            fleet.gateway(link, *people, "--longest-drive", longest, car=car, platform="arduino")
        self.judge = Judge.follow(fleet.bus, "red")
        self.console = ConsoleProcess(fleet, "--lan", "--lan-port", "0")
        self.lan_port = network_port(self.console)
        for car in cars:
            fleet.ready(car)
        self.person = Client(fleet.endpoint, sender="mia", kind="person")

    def run(self, *arguments: str) -> str:
        """Run `fleet console ...`; return its output."""
        done = CliRunner().invoke(cli, ["console", *arguments], env=self.fleet.environment)
        assert done.exit_code == 0, done.output
        return done.output

    def code(self, *arguments: str) -> str:
        """Return a new pairing code."""
        return self.run("pair", *arguments).split(" type ")[1][:9]

    def device(self, *arguments: str, source: str | None = None) -> NetworkDevice:
        """Return a paired device. source: its address, of loopback."""
        made = NetworkDevice(self.lan_port, source=source)
        assert made.pair(self.code(*arguments))["ok"]
        return made

    def drive(self) -> None:
        """Drive red as another person."""
        wish = replace(drive_request("forward", LONG_S, wait=False), take=True)
        while not (outcome := self.person.ask(wish, ["red"])[0]).ok:
            assert outcome.reason in ("held", "expired", "leased"), outcome  # a test before, or a machine that stalls
            time.sleep(0.6)  # after a stop, the gateway rejects a stream that does not pause
        wait_for(lambda: self.judge.driving, "red drives")

    def rest(self) -> None:
        """Stop red if it drives."""
        if self.judge.driving:
            self.person.ask(drive_request("stop"), ["red"])  # without a hold: the next test drives at once
            wait_for(lambda: not self.judge.driving, "red stands")

    def log(self) -> str:
        """Return the log of the console."""
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


def answer(port: int, verb: str, path: str, body: str | None = None, **headers: str) -> tuple[int, bytes]:
    """Send a request to the console; return status and text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    with contextlib.suppress(ConnectionError):  # the console rejects a large body before its end
        connection.request(verb, path, body, headers)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def test_loopback_stop_works_and_foreign_origin_is_refused(stage: ServerStage) -> None:
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


def test_unpaired_network_device_gets_nothing(stage: ServerStage) -> None:
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


def test_paired_device_has_its_person_and_stops_cars(stage: ServerStage) -> None:
    device = NetworkDevice(stage.lan_port)
    assert device.pair(stage.code("mia"))["ok"]
    for flag in ("; HttpOnly", "; Secure", "; SameSite=Strict", "; Path=/"):
        assert flag in device.cookie_flags
    assert device.ask("GET", "/")[0] == 200
    teacher = stage.device("teacher", "--rank", "lead")
    with teacher.socket() as page:
        hello = json.loads(page.recv())
    assert hello["person"] == {"name": "teacher", "rank": "lead"}
    assert hello["modes"] == {mode: list(words) for mode, words in MODE_TEXTS.items()}
    stage.drive()
    assert device.ask("POST", "/stop", Origin="https://evil.example")[0] == 403
    assert device.ask("POST", "/stop", Host=f"evil.example:{stage.lan_port}")[0] == 403
    assert stage.judge.driving
    assert device.ask("POST", "/stop")[0] == 204
    wait_for(lambda: not stage.judge.driving, "red stands")
    # Only leads and this computer see the paired devices, and pair new ones.
    assert json.loads(device.ask("GET", "/people")[1]) == {"may_pair": False, "lan": None}
    assert device.ask("POST", "/people", '{"t": "pair", "name": "x", "rank": "lead"}')[0] == 403
    listed = json.loads(teacher.ask("GET", "/people")[1])["lan"]
    assert {each["name"] for each in listed["devices"]} >= {"teacher"}
    offered = json.loads(teacher.ask("POST", "/people", '{"t": "pair", "name": "eva", "rank": "person"}')[1])
    assert NetworkDevice(stage.lan_port).pair(offered["code"])["name"] == "eva"
    assert offered["qr"].startswith("data:image/svg+xml")
    for name in ("Eva E", "nobody"):  # no name, and no person of this fleet
        assert teacher.ask("POST", "/people", json.dumps({"t": "pair", "name": name, "rank": "person"}))[0] == 400


def test_pairing_code_needs_person_of_fleet_and_running_console(stage: ServerStage, tmp_path: Path) -> None:
    def pair(name: str, fleet: FleetProcesses = stage.fleet, rank: str = "person") -> tuple[int, str]:
        done = CliRunner().invoke(cli, ["console", "pair", name, "--rank", rank], env=fleet.environment)
        return done.exit_code, done.output

    wait_for(lambda: pair("eva")[0] == 0, "the gateways have named their people")
    codes = len(book_file(stage).read().codes)
    code, words = pair("evaa")
    assert (code, "eva" in words, " type " in words) == (2, True, False)
    code, words = pair("eva", rank="lead")
    assert (code, "teacher" in words, " type " in words) == (2, True, False)
    assert len(book_file(stage).read().codes) == codes
    assert pair("teacher", rank="lead")[0] == 0
    # Another fleet's console has ended, however that went. Its address is still in its file.
    hub = FleetProcesses(free_endpoint(), tmp_path)
    try:
        ended = ConsoleProcess(hub, "--lan", "--lan-port", "0")
        assert pair("eva", hub)[0] == 0, "that fleet lists nobody"
        ended.process.kill()
        ended.process.wait()
        code, words = pair("eva", hub)
        assert (code, "`fleet console --lan`" in words) == (2, True)
    finally:
        hub.close()


def told(page: ClientConnection, kind: str) -> dict[str, Any]:
    """Return the next message of a kind to a page."""
    while (found := json.loads(page.recv(timeout=30)))["t"] != kind:
        pass
    return dict(found)


def test_class_joins_with_one_code_watches_stops_and_is_assigned(stage: ServerStage) -> None:
    teacher, pupil = stage.device("teacher", "--rank", "lead"), stage.device("mia")

    def people(who: NetworkDevice, **message: str) -> tuple[int, Any]:
        status, text = who.ask("POST", "/people", json.dumps(message))
        return status, json.loads(text)

    for kind in ("open_class", "close_class", "assign"):
        assert people(pupil, t=kind)[0] == 403
    status, opened = people(teacher, t="open_class")
    assert (status, opened["lifetime_s"], opened["qr"][:14]) == (200, 600, "data:image/svg")
    guests = [NetworkDevice(stage.lan_port) for _ in range(3)]
    names = [guest.pair(opened["code"])["name"] for guest in guests]
    assert names == ["guest-1", "guest-2", "guest-3"]
    assert guests[0].pair(opened["code"])["name"] == "guest-1", "who scans again stays"
    assert pupil.pair(opened["code"])["name"] == "mia"
    refused_paths = {"GET": ("/sessions", "/past/x"), "POST": ("/people", "/plan/check", "/recording/status")}
    for verb, path in ((verb, path) for verb, paths in refused_paths.items() for path in paths):
        status, words = guests[0].ask(verb, path, None if verb == "GET" else "{}")
        assert (status, b"watches and stops" in words) == (403, True), path
    for path in ("/", "/hello", "/static/app.js"):
        assert guests[0].ask("GET", path)[0] == 200

    stage.drive()
    with guests[0].socket() as page:
        assert told(page, "hello")["person"] == {"name": "guest-1", "rank": "guest"}
        rights = told(page, "rights")
        assert set(rights["cars"]["red"]) >= {"move", "act", "take", "lend", "resume"}
        assert rights["manage"] == rights["pause"] != ""
        refused: list[dict[str, Any]] = [
            {"t": "press", "press": 1, "cars": ["red"], "motion": "forward", "n": told(page, "tick")["n"]},
            {"t": "take", "id": 1, "cars": ["red"]},
            {"t": "do", "id": 2, "verb": "led", "cars": ["red"], "rgb": [1, 2, 3]},
            {"t": "do", "id": 3, "verb": "estop", "cars": ["red"], "why": ""},
            {"t": "estop", "id": "e", "why": ""},
            {"t": "pause", "id": "p", "why": ""},
            {"t": "unpause", "id": 4},
            {"t": "plan", "id": 5, "verb": "stop"},
        ]
        for message in refused:
            page.send(json.dumps(message))
            assert "Board" in told(page, "bad")["words"], message
        page.send('{"t": "map"}')
        assert "red" in told(page, "map")["cars"]
        assert stage.judge.driving, "nothing of that was carried out"
        page.send('{"t": "stop", "id": "guest"}')
        wait_for(lambda: not stage.judge.driving, "red stands")
        assert person_of(stage.fleet.state("safety").hold.by) == "guest", "and no lead is said to have stopped it"
        stage.drive()
        assert guests[1].ask("POST", "/stop?id=other")[0] == 204
        wait_for(lambda: not stage.judge.driving, "red stands again")

        listed = {each["name"]: each for each in json.loads(teacher.ask("GET", "/people")[1])["lan"]["devices"]}
        assert listed["guest-1"]["rank"] == "guest"
        device = listed["guest-1"]["id"]
        for wrong in ({"id": device, "name": "nobody"}, {"id": "none", "name": "eva"}, {"id": device, "name": "E <b>"}):
            assert people(teacher, t="assign", **wrong)[0] == 400
        assert people(teacher, t="assign", id=device, name="eva")[0] == 200
        with pytest.raises(ConnectionClosed):
            told(page, "none")
        assert page.close_code == 1000, "it connects again, and is told nothing of a revocation"
    with guests[0].socket() as page:
        assert told(page, "hello")["person"] == {"name": "eva", "rank": "person"}
    assert people(teacher, t="assign", id=device, name="mia")[0] == 400, "a person stays who they are"
    assert people(teacher, t="close_class")[0] == 200
    late = NetworkDevice(stage.lan_port)
    assert not late.pair(opened["code"])["ok"]
    assert late.ask("GET", "/hello")[0] == 403
    with contextlib.ExitStack() as pages:
        for _ in range(MAX_PAGES_OF_GUEST):
            told(pages.enter_context(guests[1].socket()), "hello")
        with guests[1].socket() as one_more, pytest.raises(ConnectionClosed):
            told(one_more, "hello")
    for name in ("guest-2", "guest-3", "eva"):
        stage.run("people", "--revoke", name)


def book_file(stage: ServerStage) -> PeopleFile:
    """Return the file of the paired devices."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLEET_STATE_DIR", stage.fleet.environment["FLEET_STATE_DIR"])
        return PeopleFile(people_path(stage.fleet.endpoint, "fleet"))


def test_page_tells_coordinator_that_hangs_from_none(stage: ServerStage) -> None:
    teacher = stage.device("teacher", "--rank", "lead")

    def asked(page: Any) -> str:
        page.send(json.dumps({"t": "plan", "id": 8, "verb": "stop"}))
        return str(next_message(page, "plan_done")["words"])

    with Bus.open(stage.fleet.endpoint) as bus, teacher.socket() as page:
        assert asked(page).startswith("No plan is running")
        token = bus.token(car_token("fleet", "@coordinator"))
        assert asked(page) == "The coordinator is on the bus and does not answer.", token
        status, text = teacher.ask("POST", "/plan/set", "roles:\n  guide: {mode: tracking}\n")
        assert (status, json.loads(text)["ok"]) == (200, False)
        assert "does not answer" in text.decode(), "no second one is started"


def test_recordings_and_plans_need_a_lead(stage: ServerStage) -> None:
    driver, teacher = stage.device("mia"), stage.device("teacher", "--rank", "lead")
    own = {"Origin": stage.console.address, "Cookie": loopback_cookie(stage)}
    plan = "roles:\n  guide: {mode: trackin}\n"  # a good one would start
    for path in ("/recording/start", "/recording/stop", "/plan/set"):
        refused = {"ok": False, "words": LEADS_ONLY}
        status, text = driver.ask("POST", path, plan)
        assert (status, json.loads(text)) == (403, refused), path
        assert answer(stage.console.port, "POST", path, plan, **own)[0] == 403, "this computer's person is no lead"
        status, text = teacher.ask("POST", path, plan)
        assert status == 200
        assert " mean tracking?" in text.decode() or "the bus" in text.decode(), "passed on"
    with driver.socket() as page:
        assert next_message(page, "rights")["manage"] == LEADS_ONLY
        page.send(json.dumps({"t": "plan", "id": 7, "verb": "stop"}))
        assert next_message(page, "plan_done")["words"] == LEADS_ONLY
        page.send(json.dumps({"t": "pause", "id": "p1", "why": "x"}))  # the page may not claim that all stopped
        assert next_message(page, "bad")["words"] == LEADS_ONLY
    for path in ("/recording/status", "/recording/mark", "/plan/check"):
        assert driver.ask("POST", path, plan)[0] == 200, "for everyone"
    assert driver.ask("GET", "/sessions")[0] == 200


def test_ping_is_answered_with_its_number(stage: ServerStage) -> None:
    with stage.device("mia").socket() as page:
        page.send(json.dumps({"t": "ping", "id": 7}))
        assert next_message(page, "pong")["id"] == 7
        page.send(json.dumps({"t": "ping", "id": "7"}))
        assert next_message(page, "bad")["words"].startswith("id ")


def test_forbidden_command_of_pupil_ends_no_press_of_lead(stage: ServerStage) -> None:
    teacher, pupil = stage.device("teacher", "--rank", "lead"), stage.device("eva")
    with teacher.socket() as page, pupil.socket() as other:
        driving = hold(stage, page)
        began_ns = time.time_ns()
        for number, wish in enumerate(({"t": "give_back"}, {"t": "do", "verb": "mode", "mode": "tracking"})):
            other.send(json.dumps({"id": number, "cars": ["red"], **wish}))
            assert next_message(other, "done")["id"] == number
        assert stage.judge.driving
        assert all(on for at, on in stage.judge.motors if at > began_ns), "it drove on without a pause"
    driving.join()
    wait_for(lambda: not stage.judge.driving, "red stands")


def test_plan_is_set_under_person_name_without_open_page(stage: ServerStage) -> None:
    teacher = stage.device("teacher", "--rank", "lead")
    by: list[str] = []

    def take(query: zenoh.Query) -> bool:
        payload = query.payload.to_bytes() if query.payload is not None else b""
        by.append(pb.Plan.FromString(payload).set_by)
        reply_message(query, str(query.key_expr), pb.Result(status="sent", words="it is in force"), as_json=False)
        return True

    declared: Any = stage.fleet.bus.queryable("fleet/@coordinator/@cmd/plan", take)
    try:
        for open_page in (False, True):
            with teacher.socket() if open_page else contextlib.nullcontext() as page:
                if page is not None:
                    page.recv()  # the page has joined
                status, text = teacher.ask("POST", "/plan/set", "roles:\n  guide: {mode: tracking}\n")
            assert (status, json.loads(text)) == (200, {"ok": True, "words": "it is in force"})
    finally:
        declared.undeclare()
    assert [name.partition("@")[0] for name in by] == ["teacher", "teacher"]


def test_stop_has_person_name_without_open_page(stage: ServerStage) -> None:
    device = stage.device("eva")

    def holder() -> str:
        (safety,) = stage.person.get("red/state/safety")
        return str(safety.value.hold.by.partition("@")[0])

    stage.drive()
    assert device.ask("POST", "/stop")[0] == 204
    wait_for(holder, "red is on hold")
    assert holder() == "eva", "a lead's name would keep red from all others"


def next_message(page: ClientConnection, kind: str) -> Any:
    """Wait for the next message of this kind to a page, and return it."""
    while (found := json.loads(page.recv(timeout=30)))["t"] != kind:
        pass
    return found


def hold(stage: ServerStage, page: ClientConnection) -> threading.Thread:
    """Press forward on a page and hold it, as a browser does, until the console closes it."""
    driving = threading.Thread(target=press_until_closed, args=(page,))
    driving.start()
    wait_for(lambda: stage.judge.driving, "red drives")
    return driving


def press_until_closed(page: ClientConnection) -> None:
    """Press forward and echo each tick. If the press ends, press again: a gateway requires a pause after a stop."""
    press, again_at = 0, -1.0
    fields = {"cars": ["red"], "motion": "forward"}
    with contextlib.suppress(ConnectionClosed):
        while True:
            message = json.loads(page.recv(timeout=30))
            if message["t"] in ("over", "refused"):
                again_at = time.monotonic() + 0.6
            elif message["t"] == "tick" and time.monotonic() > again_at:
                press, again_at = press + 1, math.inf
                page.send(json.dumps({"t": "press", "press": press, "n": message["n"], **fields}))
            elif message["t"] == "tick":
                page.send(json.dumps({"t": "echo", "press": press, "n": message["n"]}))


@pytest.mark.parametrize("how", ["command", "page"])
def test_revoked_device_is_disconnected_at_once(stage: ServerStage, how: str) -> None:
    device, lead = stage.device("thief"), stage.device("teacher", "--rank", "lead")
    with device.socket() as page:
        driving = hold(stage, page)
        if how == "command":
            assert "(thief) is revoked" in stage.run("people", "--revoke", "thief")
        else:
            listed = json.loads(lead.ask("GET", "/people")[1])["lan"]["devices"]
            (chosen,) = [each["id"] for each in listed if each["name"] == "thief"]
            assert lead.ask("POST", "/people", json.dumps({"t": "revoke", "id": chosen}))[0] == 200
        wait_for(lambda: not stage.judge.driving, "red stands")
        driving.join(30)
        assert not driving.is_alive(), "its page is closed"
    assert device.ask("GET", "/hello")[0] == 403
    assert device.ask("POST", "/stop")[0] == 403
    assert "thief" not in stage.run("people")
    stage.run("people", "--revoke", "teacher")


MAX_CLOSING_S = 0.5
"""Maximum time for which a closed page still looks live. The client of the test itself waits for 1 s at most."""


def test_page_is_closed_at_once_with_messages_behind(stage: ServerStage) -> None:
    """The page says that it is live until its connection has ended, as after a revocation while it drives."""
    times = []
    for _ in range(3):  # a busy machine may delay one of them
        with stage.device("calm").socket() as page:
            next_message(page, "rights")
            began = time.monotonic()
            with page.send_context():  # all at once
                page.protocol.send_binary(b"closes the page")
                for _ in range(5):
                    page.protocol.send_text(b'{"t":"echo","n":1,"press":1}')
            read_to_the_end(page)
            times.append(time.monotonic() - began)
    assert min(times) < MAX_CLOSING_S, times


def read_to_the_end(page: ClientConnection) -> None:
    """Read until the console closes the socket."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            page.recv(timeout=10)


def test_expired_cookie_opens_nothing_and_still_stops(stage: ServerStage) -> None:
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


def test_guesses_get_nothing_and_are_slowed_down(stage: ServerStage) -> None:
    stranger, code = NetworkDevice(stage.lan_port, source="127.0.0.3"), stage.code("late")
    connection = stranger.connection()
    statuses: list[int] = []
    # A thousand are in test_pairing, on virtual time.
    for number in range(50):
        try:
            connection.request("POST", "/pair", f"AAAA{number:04}", {"Origin": stranger.origin})
            response = connection.getresponse()
        except (http.client.HTTPException, OSError):  # an unpaired connection lasts for ten seconds
            connection.close()
            continue
        statuses.append(response.status)
        response.read()
    connection.close()
    assert len(statuses) > 40
    assert set(statuses) <= {403, 429}
    assert statuses.count(403) < 10, "the others were not even compared"
    late = stranger.pair(code)
    assert late["ok"] is False, "the right code must wait, too"
    assert "wrong codes" in late["words"], "and is not called wrong"
    assert json.loads(answer(stage.console.port, "GET", "/people")[1])["lan"]["wrong_codes"] > 40
    assert stage.log().count("wrong pairing code") < 20
    assert NetworkDevice(stage.lan_port).pair(code)["ok"], "nobody else waits, and the code is not used up"
    assert not NetworkDevice(stage.lan_port, source="127.0.0.4").pair(code)["ok"], "a replay"


def test_cookie_at_two_addresses_is_logged(stage: ServerStage) -> None:
    device = stage.device("owner")
    thief = NetworkDevice(stage.lan_port, source="127.0.0.5")
    thief.cookie = device.cookie
    with device.socket() as page:
        page.recv()  # the page has joined
        thief.ask("GET", "/hello")
        wait_for(lambda: "in use at 127.0.0.5, 127.0.0.1" in stage.log(), "the warning")


@pytest.mark.parametrize("where", ["loopback", "network"])
def test_server_refuses_too_large_requests_and_unknown_paths(stage: ServerStage, where: str) -> None:
    device = stage.device("large")
    own = {"Origin": stage.console.address, "Cookie": loopback_cookie(stage)}

    def ask(verb: str, path: str, body: str | None = None) -> int:
        if where == "network":
            return device.ask(verb, path, body)[0]
        return answer(stage.console.port, verb, path, body, **own)[0]

    assert ask("POST", "/plan/check", "#" * 10_000_000) == 413
    assert ask("POST", "/plan/check", "roles:\n  guide: {mode: tracking}\n") == 200
    for path in ("/static/../server.py", "/static/%2e%2e/server.py", "/static//etc/passwd", "/static/..%5cserver.py"):
        assert ask("GET", path) == 404, path
    with device.socket() if where == "network" else loopback_socket(stage) as page:
        page.send("x" * (MAX_MESSAGE_BYTES + 1))
        read_to_the_end(page)
        assert page.close_code in (1009, 1006)  # what is still being sent may reset the connection first


def loopback_cookie(stage: ServerStage) -> str:
    """Return the cookie of a page of this computer."""
    connection = http.client.HTTPConnection("127.0.0.1", stage.console.port, timeout=30)
    connection.request("GET", "/hello")
    found = str(connection.getresponse().getheader("set-cookie"))
    connection.close()
    return found.partition(";")[0]


def loopback_socket(stage: ServerStage) -> ClientConnection:
    """Open the socket of a page of this computer."""
    address = f"ws://127.0.0.1:{stage.console.port}/ws"
    headers = {"Cookie": loopback_cookie(stage)}
    return connect(address, origin=Origin(stage.console.address), additional_headers=headers, proxy=None)


def close_code(page: ClientConnection) -> int:
    """Read until the console closes the page. Return why."""
    try:
        while True:
            page.recv(30)
    except ConnectionClosed as ended:
        return 0 if ended.rcvd is None else ended.rcvd.code


@pytest.mark.parametrize(
    ("name", "text"), [("echo", '{"t":"echo","n":1,"press":1}'), ("stop", '{"t":"stop","id":""}'), ("bad", "{")]
)
def test_flooding_page_is_closed_and_costs_nobody_a_stop(stage: ServerStage, name: str, text: str) -> None:
    thief, calm = stage.device(name), stage.device("calm")
    with thief.socket() as flooder, calm.socket() as page:
        closed = threading.Event()

        def flood() -> None:
            with contextlib.suppress(ConnectionClosed):
                for _ in range(FLOOD):
                    flooder.send(text)
            closed.set()

        threading.Thread(target=flood, daemon=True).start()
        assert closed.wait(60)
        assert close_code(flooder) == SENT_TOO_MUCH
        with thief.socket() as again:
            assert close_code(again) == SENT_TOO_MUCH, "it waits first"
        stage.drive()
        assert thief.ask("POST", "/stop")[0] == 204, "a closed page still stops all cars"
        wait_for(lambda: not stage.judge.driving, "red stands")
        stage.drive()
        page.send(json.dumps({"t": "stop", "id": name}))
        wait_for(lambda: not stage.judge.driving, "red stands")
    assert "Traceback" not in stage.log()


def test_stop_behind_message_that_closes_page_is_carried_out(stage: ServerStage) -> None:
    begun: list[str] = []
    subscribed: Any = stage.fleet.bus.subscribe("fleet/red/event/command", lambda sample: note_stop(sample, begun))
    with stage.device("hasty").socket() as page:
        with page.protocol_mutex:
            # More than the page may send, also with what it gains meanwhile, and the stop in the same bytes.
            for _ in range(int(PAGE_BURST + 4 * PAGE_RATE)):
                page.protocol.send_text(b'{"t":"echo","n":1,"press":1}')
            page.protocol.send_text(b'{"t":"stop","id":"last"}')
            page.socket.sendall(b"".join(page.protocol.data_to_send()))
        assert close_code(page) == SENT_TOO_MUCH
    wait_for(lambda: "hasty" in begun, "red's gateway has got it")
    subscribed.undeclare()


@pytest.mark.parametrize("parts", [1, 1000])
def test_inflated_websocket_message_is_refused_by_size(stage: ServerStage, parts: int) -> None:
    bomber, server = stage.device("bomber"), psutil.Process(stage.console.process.pid)
    with bomber.socket() as page:
        assert page.protocol.extensions, "it is compressed"
        before_mb = server.memory_info().rss / 1e6
        text = "x" * (INFLATED // parts)
        with contextlib.suppress(ConnectionClosed):
            page.send(text if parts == 1 else itertools.repeat(text, parts))
        read_to_the_end(page)
        assert page.close_code in (1009, 1006)  # what is still being sent may reset the connection first
    assert server.memory_info().rss / 1e6 < before_mb + MAX_BOMB_MB


def cpu_s(process: psutil.Process) -> float:
    """Return the CPU time of a process and of those that it has started, s."""
    used = [process.cpu_times(), *(each.cpu_times() for each in process.children(recursive=True))]
    return float(sum(each.user + each.system for each in used) + used[0].children_user + used[0].children_system)


def test_bombs_and_large_plans_of_viewer_cost_no_more_than_pages(stage: ServerStage) -> None:
    """A viewer is a person of the lowest rank, who may only watch and stop."""
    viewer, server = stage.device("viewer"), psutil.Process(stage.console.process.pid)
    statuses = Counter[int]()

    def page() -> None:
        with viewer.socket() as opened:
            opened.recv(30)

    def bomb() -> None:
        with viewer.socket() as opened:
            with contextlib.suppress(ConnectionClosed):
                opened.send("x" * INFLATED)
            read_to_the_end(opened)

    def plan(what: str) -> None:
        statuses[viewer.ask("POST", f"/plan/{what}", PLAN)[0]] += 1

    def cost_s(act: Callable[[], object]) -> float:
        before_s = cpu_s(server)
        for _ in range(EACH):
            act()
        return (cpu_s(server) - before_s) / EACH

    costs = cost_s(page), cost_s(bomb), cost_s(partial(plan, "set"))
    assert statuses == {403: EACH}, "only a lead sets plans"
    assert max(costs) < MAX_COST * costs[0]
    begun = time.monotonic()
    plan("check")
    while statuses[429] < EACH:  # a small plan: on a busy machine, a large one takes longer than it may be asked for
        statuses[viewer.ask("POST", "/plan/check", "roles:\n  guide: {mode: tracking}\n")[0]] += 1
    assert statuses[200] <= CHECK_BURST + CHECK_RATE * (time.monotonic() - begun) + 1
    assert viewer.ask("POST", "/stop")[0] == 204


def test_stops_of_some_cars_are_merged_and_each_is_answered(stage: ServerStage) -> None:
    begun: list[str] = []
    subscribed: Any = stage.fleet.bus.subscribe("fleet/red/event/command", lambda sample: note_stop(sample, begun))
    with stage.device("merger").socket() as page:
        for number in range(STOPS_AT_ONCE):
            cars = ["red", f"ghost{number}"]  # no two are alike
            page.send(json.dumps({"t": "do", "id": number, "verb": "stop", "cars": cars}))
        answered: dict[int, set[str]] = {}
        while len(answered) < STOPS_AT_ONCE:
            message = json.loads(page.recv(30))
            if message["t"] == "done":
                answered[message["id"]] = {outcome["car"] for outcome in message["outcomes"]}
    subscribed.undeclare()
    assert answered == {number: {"red", f"ghost{number}"} for number in range(STOPS_AT_ONCE)}
    assert 1 <= len(begun) <= STOPS_AT_ONCE / 4


def test_page_that_goes_before_its_take_is_answered_leaves_no_lease(stage: ServerStage) -> None:
    device, phases = stage.device("mia"), list[str]()
    stage.person.ask(resume_request(), ["red"])
    subscribed = stage.fleet.bus.subscribe("fleet/red/event/command", partial(note_lease, phases=phases))
    with device.socket() as other:  # her client stays as long as she has a page
        with device.socket() as page:
            page.recv()
            page.send('{"t":"take","id":1,"cars":["red"]}')
        wait_for(lambda: phases, "the gateway has got the take")
        wait_for(lambda: not stage.fleet.state("safety").HasField("lease"), "nobody has red")
        assert next_message(other, "tick")
    subscribed.undeclare()


@pytest.mark.parametrize(
    "fields",
    [
        {"t": "stop", "id": 5},
        {"t": "stop", "id": "x" * 65},
        {"t": "estop", "id": "odd", "why": "x" * 201},
        {"t": "estop", "id": "half", "why": "half \ud83d"},
        {"t": "do", "verb": "stop", "id": 1, "cars": ["red", "Not a car"]},
        {"t": "do", "verb": "stop", "cars": ["red"]},
        {"t": "do", "verb": "estop", "id": 1, "cars": ["red"], "why": 5},
    ],
)
def test_stop_with_wrong_details_stops(stage: ServerStage, fields: dict[str, Any]) -> None:
    with stage.device("stop").socket() as page:
        page.recv()
        stage.drive()
        page.send(json.dumps(fields))
        wait_for(lambda: not stage.judge.driving, "red stands")
    if fields["t"] == "estop" or fields.get("verb") == "estop":
        ids = [each.id for each in wait_for(lambda: stage.fleet.state("safety").estops, "red is e-stopped")]
        stage.person.ask(resume_request(ids), ["red"])
    stage.person.ask(resume_request(), ["red"])


def test_car_that_the_fleet_removed_is_not_lost(stage: ServerStage) -> None:
    def says(boot_id: str, *cars: str) -> None:
        status = pb.Supervision(boot_id=boot_id, colors=dict.fromkeys(cars, "#112233")).SerializeToString()
        bus.put_again("fleet/@supervisor/status", status, encoding_of("fleet.v1.Supervision"), 0, Qos.STATE)

    def until(shown: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        while not shown(cars := {car["name"]: car for car in next_message(page, "state")["cars"]}):
            pass
        return cars

    with Bus.open(stage.fleet.endpoint) as bus, stage.device("viewer").socket() as page:
        says("elsewhere", "black")
        says("here", "first", "old", "gone")
        tokens = [bus.token(car_token("fleet", name)) for name in ("old", "gone")]
        until(lambda cars: all(cars.get(name, {}).get("gateway") for name in ("old", "gone")))
        says("elsewhere", "black", "white")
        says("here", "first", "gone", "new")  # `old` has another name now. Its gateway is still there
        assert {"old", "gone"} <= set(until(lambda cars: True))
        for token in tokens:
            token.undeclare()
        cars = until(lambda cars: "old" not in cars)
        assert not until(lambda cars: not cars["gone"]["gateway"])["gone"]["gateway"], (
            "nobody has removed it: it is lost"
        )
        assert cars["red"]["gateway"]
        says("here", "first")
        until(lambda cars: "gone" not in cars)


LATE_TICKS = 30
"""Ticks after which a command is too late: one and a half times as many as in its maximum age."""


def test_late_command_starts_nothing_and_late_stop_stops(stage: ServerStage) -> None:
    stage.person.ask(resume_request(), ["red"])
    orders: list[dict[str, Any]] = [
        {"t": "do", "verb": "mode", "cars": ["red"], "mode": "tracking"},
        {"t": "do", "verb": "resume", "cars": ["red"]},
        {"t": "take", "cars": ["red"]},
        {"t": "unpause"},
    ]
    with stage.device("mia").socket() as page:
        old = next_message(page, "tick")["n"]
        while next_message(page, "tick")["n"] < old + LATE_TICKS:
            pass
        for number, order in enumerate(orders):
            page.send(json.dumps({**order, "id": number, "n": old}))
            assert "Press again" in next_message(page, "bad")["words"]
        teacher = stage.device("teacher", "--rank", "lead")
        status, text = teacher.ask("POST", f"/plan/set?n={old}", "roles:\n  guide: {mode: tracking}\n")
        assert (status, "Press again" in json.loads(text)["words"]) == (408, True)
        page.send(
            json.dumps({"t": "do", "verb": "whistle", "cars": ["red"], "id": 9, "n": next_message(page, "tick")["n"]})
        )
        assert next_message(page, "done")["outcomes"][0]["ok"]
        assert stage.fleet.state("mode").asked == "manual"
        assert not stage.fleet.state("safety").HasField("lease")
        stage.drive()
        page.send(json.dumps({"t": "do", "verb": "stop", "cars": ["red"], "id": 10, "n": old}))
        wait_for(lambda: not stage.judge.driving, "red stands")
    stage.person.ask(resume_request(), ["red"])


def note_lease(sample: Sample, phases: list[str]) -> None:
    """Note the phase of a command for a lease."""
    event: Any = sample.message()
    if event.verb == "lease":
        phases.append(event.phase)


def note_stop(sample: Sample, begun: list[str]) -> None:
    """Note the person of a stop that a gateway has got."""
    event: Any = sample.message()
    if (event.verb, event.phase) == ("stop", "asked"):
        begun.append(person_of(event.sender))


JUNK_TICKS = 60
PRESS_PAUSE_TICKS = 8
"""Ticks without a press after one that was refused: a gateway wants a pause of 0.5 s."""
JUNK_PER_TICK = 100
"""Names that nobody knows, invented at each tick of the console, of 0.1 s."""
MAX_JUNK_MB = 8.0
"""Maximum growth while five sixths of the names come. It was 1.6 MB."""


def test_invented_cars_on_the_bus_cost_a_real_one_nothing(stage: ServerStage) -> None:
    server, payload = psutil.Process(stage.console.process.pid), pb.Safety(motors="on").SerializeToString()
    encoding, most = encoding_of("fleet.v1.Safety"), 0
    stage.person.ask(resume_request(), ["red"])
    with Bus.open(stage.fleet.endpoint) as bus, stage.device("mia").socket() as page:
        press: dict[str, Any] = {"press": 1, "cars": ["red"], "motion": "forward"}
        ticks, driven, rss_mb, lost, pause, begun = 0, 0, 0.0, [], 0, False
        while ticks < JUNK_TICKS:
            message = json.loads(page.recv(30))
            if message["t"] == "state":
                red = next(car for car in message["cars"] if car["name"] == "red")
                lost += [red] if not red["gateway"] or "silent_s" in red else []
                most = max(most, len(message["cars"]))
            if message["t"] in ("over", "refused"):
                # Before the junk: a lease or a stop of a test before. Later: this thread was late on a busy machine.
                press["press"], pause = press["press"] + 1, PRESS_PAUSE_TICKS
            if message["t"] != "tick":
                continue
            if pause:
                pause -= 1
                begun = False
                continue
            page.send(json.dumps({"t": "echo" if begun else "press", **press, "n": message["n"]}))
            begun = True
            if not ticks and not stage.judge.driving:
                continue
            ticks += 1
            if ticks == JUNK_TICKS // 6:
                rss_mb = server.memory_info().rss / 1e6
            driven += stage.judge.driving
            for number in range(JUNK_PER_TICK):
                name = f"junk{ticks}_{number}"
                bus.put_again(topic_key("fleet", name, "state/safety"), payload, encoding, 0, Qos.STATE)
                if number < JUNK_PER_TICK // 10:
                    bus.token(car_token("fleet", name))
        assert not lost
        assert most == MAX_OTHER_CARS
        assert driven > JUNK_TICKS // 2
        assert server.memory_info().rss / 1e6 < rss_mb + MAX_JUNK_MB
        page.send(json.dumps({"t": "stop", "id": "junk"}))
        wait_for(lambda: not stage.judge.driving, "red stands")
    assert stage.log().count("further cars") == 1


def test_repeated_stops_of_person_take_no_extra_threads(stage: ServerStage) -> None:
    server = psutil.Process(stage.console.process.pid)
    with stage.device("nervous").socket() as page:
        page.recv(30)
        stage.drive()  # after a drive, a stop is over when the car's readings show it: in some seconds
        threads, sent, state = server.num_threads(), 0, ""
        while sent < STOPS_AT_ONCE or state not in ("shown", "sent"):
            message = json.loads(page.recv(30))
            if message["t"] == "tick" and sent < STOPS_AT_ONCE:  # ten a second
                page.send(json.dumps({"t": "stop", "id": f"nervous {sent}"}))
                sent += 1
                threads_now = server.num_threads()
            elif message["t"] == "state" and message["stop"] is not None:  # of all cars, also of those that never were
                state = next(car["state"] for car in message["stop"]["cars"] if car["name"] == "red")
    assert threads_now < threads + STOPS_AT_ONCE / 2


def allowed_commands(since: float) -> float:
    """Return how many commands a person may have sent since this time (s, monotonic)."""
    return COMMAND_BURST + COMMAND_RATE * (time.monotonic() - since)


COMMANDS = 3 * int(COMMAND_BURST)
"""Commands of a device that floods gateways."""


@pytest.mark.parametrize("kind", ["take", "do", *only_in_soak(["give_back", "unpause"])])
def test_commands_in_a_flood_reach_gateways_at_a_devices_rate(stage: ServerStage, kind: str) -> None:
    begun: list[str] = []
    giver = f"giver_{kind}"  # late events of the case before are not this device's

    def note(sample: Sample) -> None:
        event: Any = sample.message()
        if event.phase == "asked":
            begun.append(person_of(event.sender))

    subscribed: Any = stage.fleet.bus.subscribe("fleet/red/event/command", note)
    server, since = psutil.Process(stage.console.process.pid), time.monotonic()
    threads_before = server.num_threads()
    with stage.device(giver).socket() as page:
        text = json.dumps({"t": kind, "id": 1, "verb": "whistle", "cars": ["red"]})
        for _ in range(COMMANDS):
            page.send(text)
        answers = answers_so_far(page)
        threads = server.num_threads()
    subscribed.undeclare()
    assert answers["done"] <= allowed_commands(since)
    assert begun.count(giver) <= allowed_commands(since)
    assert threads < threads_before + COMMAND_BURST / 2


def test_device_with_full_flight_takes_no_slot_of_others(stage: ServerStage) -> None:
    """Neither from another device of the same person, nor from another person."""
    held: list[Any] = []
    declared: Any = stage.fleet.bus.queryable(command_key("fleet", "holder", "whistle"), held.append)
    token: Any = stage.fleet.bus.token(car_token("fleet", "holder"))
    to_red = json.dumps({"t": "do", "id": 99, "verb": "whistle", "cars": ["red"]})
    devices = [stage.device(name) for name in ("twoways", "twoways", "calm")]
    with devices[0].socket() as full, devices[1].socket() as tablet, devices[2].socket() as other:
        wait_for(lambda: "holder" in cars_of(full), "the console knows the car")
        for number in range(MAX_OPEN_COMMANDS):
            full.send(json.dumps({"t": "do", "id": number, "verb": "whistle", "cars": ["holder"]}))
        wait_for(lambda: len(held) == MAX_OPEN_COMMANDS, "all are in flight")
        full.send(to_red)
        assert answers_until(full, "bad")["done"] == 0
        for page in (tablet, other):
            page.send(to_red)
            assert answers_until(page, "done")["bad"] == 0
        assert len(held) == MAX_OPEN_COMMANDS
        while held:
            held.pop().drop()
        declared.undeclare()
        token.undeclare()
        for _ in range(MAX_OPEN_COMMANDS):
            answers_until(full, "done")
        full.send(to_red)
        assert answers_until(full, "done")["bad"] == 0, "what has an outcome is in flight no more"


def cars_of(page: ClientConnection) -> set[str]:
    """Return the cars of the next state that a page gets."""
    while (message := json.loads(page.recv(30)))["t"] != "state":
        pass
    return {car["name"] for car in message["cars"]}


@pytest.mark.parametrize("kind", ["take", "give_back", "do"])
def test_unknown_car_is_refused_without_query(stage: ServerStage, kind: str) -> None:
    with stage.device("giver").socket() as page:
        for number in range(10):
            page.send(json.dumps({"t": kind, "id": number, "verb": "whistle", "cars": ["red", f"ghost{number}"]}))
        assert answers_so_far(page)["bad"] == 10


def test_presses_begin_at_a_devices_rate(stage: ServerStage) -> None:
    since, sent, over = time.monotonic(), 0, 0
    with stage.device("presser").socket() as page:
        while sent < COMMANDS:
            message = json.loads(page.recv(30))
            if message["t"] == "tick":
                for _ in range(40):
                    sent += 1
                    motion = ("forward", "back")[sent % 2]
                    press = {"t": "press", "press": sent, "cars": ["red"], "motion": motion, "n": message["n"]}
                    page.send(json.dumps(press))
            over += message["t"] == "over"
        over += answers_so_far(page)["over"]
    assert sent - over <= allowed_commands(since)


def answers_until(page: ClientConnection, last: str) -> Counter[str]:
    """Return how many messages of each kind come until the first one of this kind."""
    found = Counter[str]()
    while not found[last]:
        found[json.loads(page.recv(30))["t"]] += 1
    return found


def answers_so_far(page: ClientConnection) -> Counter[str]:
    """Return how many messages of each kind come before the answer to a press that is refused."""
    found = Counter[str]()
    page.send(json.dumps({"t": "press", "press": 0, "cars": ["ghost"], "motion": "forward", "n": 0}))
    while (message := json.loads(page.recv(30))).get("press") != 0:
        found[message["t"]] += 1
    return found


def test_plot_flood_keeps_one_question_and_newest_wins(stage: ServerStage) -> None:
    held: list[Any] = []
    asked: list[str] = []

    def hold(query: zenoh.Query) -> bool:
        asked.append(str(query.key_expr).split("/")[1])
        held.append(query)
        return True

    declared: Any = [stage.fleet.bus.queryable(f"fleet/{car}/sensor/range", hold) for car in ("first", "last")]
    with stage.device("plotter").socket() as page:
        for car in ("first",) * 50 + ("last",):
            page.send(json.dumps({"t": "plot", "series": [[car, "sensor/range", "range_m"]], "since_s": 600}))
        answers_so_far(page)
        wait_for(lambda: held, "a gateway is asked")
        held.pop().drop()  # the end of its answer
        wait_for(lambda: held, "the gateway gets the question of the newest plot")
        held.pop().drop()
        page.send(json.dumps({"t": "plot", "series": [["last", "sensor/range", "range_m"]], "since_s": 600}))
        wait_for(lambda: held, "the gateway gets the next question")
        held.pop().drop()
    for each in declared:
        each.undeclare()
    assert asked == ["first", "last", "last"]


def test_flood_from_one_device_leaves_other_device_of_person_live(stage: ServerStage) -> None:
    flooder, calm = stage.device("twotab"), stage.device("twotab")
    text = '{"t":"echo","n":1,"press":1}'
    with calm.socket() as page:
        for _ in range(2):  # the second one finds its device locked, or what is left of its budget
            with flooder.socket() as flooding:
                with contextlib.suppress(ConnectionClosed):
                    for _ in range(FLOOD):
                        flooding.send(text)
                assert close_code(flooding) == SENT_TOO_MUCH
        page.send(text)
        assert answers_so_far(page)["tick"]
        with calm.socket() as again:
            assert json.loads(again.recv(30))["t"] == "hello"


def test_command_flood_costs_no_other_device_of_person(stage: ServerStage) -> None:
    with stage.device("giver").socket() as flooding, stage.device("giver").socket() as page:
        for number in range(COMMANDS):
            flooding.send(json.dumps({"t": "do", "id": number, "verb": "whistle", "cars": ["red"]}))
        assert answers_so_far(flooding)["bad"] > 0
        page.send(json.dumps({"t": "do", "id": 1, "verb": "whistle", "cars": ["red"]}))
        assert answers_until(page, "done")["bad"] == 0


def test_request_flood_costs_no_other_device_nor_local_computer(stage: ServerStage) -> None:
    flooder, calm = stage.device("tworeq"), stage.device("tworeq")
    stranger = NetworkDevice(stage.lan_port, source="127.0.0.7")

    def statuses(of: NetworkDevice, path: str, count: int) -> set[int]:
        """Send requests one after the other, up to the first refusal; return the statuses."""
        found: set[int] = set()
        left = count
        while left > 0 and 429 not in found:
            connection = of.connection()
            with contextlib.suppress(http.client.HTTPException, OSError):  # the console ends that of a stranger
                while left > 0 and 429 not in found:
                    connection.request("GET", path, headers={"Cookie": of.cookie} if of.cookie else {})
                    response = connection.getresponse()
                    response.read()
                    found.add(response.status)
                    left -= 1
            connection.close()
        return found

    flood, calmly = 100 * int(REQUEST_BURST), 200
    assert statuses(flooder, "/hello", flood) == {200, 429}
    assert statuses(calm, "/hello", calmly) == {200}
    assert flooder.ask("POST", "/stop")[0] == 204, "STOP has no budget"
    assert statuses(stranger, "/pair", flood) == {200, 429}
    assert statuses(NetworkDevice(stage.lan_port, source="127.0.0.8"), "/pair", calmly) == {200}
    for _ in range(calmly):
        assert answer(stage.console.port, "GET", "/hello")[0] == 200


def test_flood_of_plot_queries_fills_no_log(stage: ServerStage) -> None:
    asked: list[str] = []

    def refuse(query: zenoh.Query) -> bool:
        asked.append(str(query.key_expr))
        return False  # busy

    declared: Any = stage.fleet.bus.queryable("fleet/slow$*/sensor/range", refuse)
    series = [[f"slow{number}", "sensor/range", "range_m"] for number in range(MAX_SERIES)]
    with stage.device("plotter").socket() as page:
        for count in (1, 2):
            page.send(json.dumps({"t": "plot", "series": series, "since_s": 600}))
            wait_for(lambda count=count: len(asked) == count * len(series), "all gateways were asked")
        page.send(json.dumps({"t": "plot", "series": series[:1], "since_s": 600}))
        wait_for(lambda: len(asked) > 2 * len(series), "the answers before have come")
    declared.undeclare()
    assert 1 <= stage.log().count("every gateway answered") <= LOG_BURST + 2


def test_pings_count_as_messages(stage: ServerStage) -> None:
    with stage.device("pinger").socket() as page:
        with contextlib.suppress(OSError), page.protocol_mutex:
            for _ in range(int(PAGE_BURST + 4 * PAGE_RATE)):
                page.protocol.send_ping(b"x" * 125)
            page.socket.sendall(b"".join(page.protocol.data_to_send()))
        assert close_code(page) == SENT_TOO_MUCH


def test_page_that_reads_nothing_is_closed_and_bounded(stage: ServerStage) -> None:
    pinger, server = stage.device("pinger", source="127.0.0.61"), psutil.Process(stage.console.process.pid)
    with socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.bind(("127.0.0.61", 0))
        raw.connect(("127.0.0.1", stage.lan_port))
        with untrusting().wrap_socket(raw, server_hostname="127.0.0.1") as page:
            lines = (
                *("GET /ws HTTP/1.1", f"Host: 127.0.0.1:{stage.lan_port}", f"Origin: {pinger.origin}"),
                *(f"Cookie: {pinger.cookie}", "Upgrade: websocket", "Connection: Upgrade"),
                *("Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "", ""),
            )
            page.sendall("\r\n".join(lines).encode())
            assert b" 101 " in page.recv(100)
            address = page.getsockname()

            def is_open() -> bool:
                return any(each.raddr == address for each in server.net_connections("tcp"))

            assert is_open()
            before_mb = server.memory_info().rss / 1e6
            ping = b"\x89\xfd\0\0\0\0" + b"x" * 125
            for _ in range(40):  # fewer than it may send, and more than the buffers hold
                page.sendall(ping * 100)
            wait_for(lambda: not is_open(), "it is closed", 4 * SEND_TIMEOUT_S)
            assert server.memory_info().rss / 1e6 < before_mb + MAX_UNREAD_MB


def test_192_half_requests_of_one_cookie_lock_nobody_out(stage: ServerStage) -> None:
    greedy, calm = stage.device("greedy", source="127.0.0.20"), stage.device("calm")
    with greedy.socket() as page, contextlib.ExitStack() as kept:
        halves = []
        for _ in range(HALF_REQUESTS):
            with contextlib.suppress(OSError):  # it opens too many at once
                halves.append(half_request(greedy, kept))
        assert len(halves) >= MAX_PER_DEVICE
        assert calm.ask("GET", "/hello")[0] == 200
        assert answer(stage.console.port, "GET", "/hello")[0] == 200
        stage.drive()
        assert calm.ask("POST", "/stop")[0] == 204
        wait_for(lambda: not stage.judge.driving, "red stands")
        stage.drive()
        page.send(json.dumps({"t": "stop", "id": "greedy"}))  # its own page, too
        wait_for(lambda: not stage.judge.driving, "red stands")
        for each in halves:  # the console ends each of them
            each.settimeout(BODY_TIMEOUT_S + 30.0)
            with contextlib.suppress(OSError):
                while each.recv(4096):
                    pass
        kept.close()  # until it has closed them, too, they take the places of its device

        def is_let_in() -> bool:
            with contextlib.suppress(OSError):
                return greedy.ask("GET", "/hello")[0] == 200
            return False

        wait_for(is_let_in, "its own device is let in again")
    assert "Traceback" not in stage.log()


def test_pages_of_one_device_are_limited(stage: ServerStage) -> None:
    greedy, calm = stage.device("mia"), stage.device("calm")
    with contextlib.ExitStack() as pages:
        opened = [pages.enter_context(greedy.socket()) for _ in range(MAX_PAGES_OF_DEVICE)]
        assert all(json.loads(each.recv(30))["t"] == "hello" for each in opened)
        one_more = pages.enter_context(greedy.socket())
        assert close_code(one_more) == TRY_AGAIN_LATER
        other = pages.enter_context(calm.socket())
        assert json.loads(other.recv(30))["t"] == "hello"


def test_stranger_flood_takes_no_stop_behind_same_address(stage: ServerStage) -> None:
    """It asks again and again from several threads, beyond the burst of the address."""
    address, over, refused = "127.0.0.50", threading.Event(), Counter[int]()
    calm = stage.device("calm", source=address)

    def flood() -> None:
        stranger = NetworkDevice(stage.lan_port, source=address)
        while not over.is_set():
            refused[stranger.ask("GET", "/hello")[0]] += 1

    flooders = [threading.Thread(target=flood) for _ in range(4)]
    for each in flooders:
        each.start()
    try:
        wait_for(lambda: refused[403] > ADDRESS_BURST, "it floods")
        for _ in range(3):
            stage.drive()
            assert calm.ask("POST", "/stop")[0] == 204
            wait_for(lambda: not stage.judge.driving, "red stands")
            with calm.socket() as page:
                assert json.loads(page.recv(30))["t"] == "hello"
    finally:
        over.set()
        for each in flooders:
            each.join()
    assert set(refused) == {403}, "it is slowed down, never cut off"


@pytest.mark.soak
def test_floods_and_half_open_connections_stop_no_stop(stage: ServerStage) -> None:
    device = stage.device("calm")
    server = psutil.Process(stage.console.process.popen.pid)
    settled_fds = server.num_fds()
    with device.socket() as page:
        connect_and_leave(stage, WARM_UP)
        before_threads = server.num_threads()
        half_open = [
            socket.create_connection(("127.0.0.1", port), source_address=("127.0.0.7", 0))
            for port in (stage.lan_port, stage.console.port)
            for _ in range(60)
        ]
        for each in half_open[60:]:
            each.sendall(b"POST /stop HTTP/1.1\r\nHost: ")
        stage.drive()
        # A socket that was open before and a new request both work.
        page.send(json.dumps({"t": "stop", "id": "one"}))
        wait_for(lambda: not stage.judge.driving, "red stands")
        stage.drive()
        assert device.ask("POST", "/stop")[0] == 204
        wait_for(lambda: not stage.judge.driving, "red stands")
        # An unpaired connection on the network ends after ten seconds, also if it never began TLS.
        for each in half_open[:60]:
            each.settimeout(30)
            with contextlib.suppress(ConnectionError):
                assert each.recv(1) == b""
        for each in half_open:
            each.close()
        sizes_mb = []
        for number in range(40):
            # Memory depends on the number of open connections. So each hundred waits for the one before.
            wait_for(lambda: server.num_fds() <= settled_fds + 5, "all are closed")
            if number % 10 == 9:
                sizes_mb.append(server.memory_info().rss / 1e6)
            connect_and_leave(stage, 100)
        assert server.num_threads() <= before_threads + 8
    grown_mb = [after - before for before, after in itertools.pairwise(sizes_mb)]
    print(f"\n{settled_fds} descriptors; MB after the warm-up {sizes_mb[0]:.1f}, more after each thousand {grown_mb}")
    assert max(grown_mb) < MAX_GROWTH_MB_PER_THOUSAND
    assert "Traceback" not in stage.log()


def connect_and_leave(stage: ServerStage, times: int) -> None:
    """Connect to both ports in turn and leave at once, in some cases after half a request."""
    for number in range(times):
        port = stage.lan_port if number % 2 else stage.console.port
        with socket.create_connection(("127.0.0.1", port), source_address=("127.0.0.6", 0)) as hasty:
            hasty.sendall((b"", b"GET /hello HT", b"\x16\x03\x01")[number % 3])


def test_http_and_https_ports_refuse_each_other(stage: ServerStage) -> None:
    with socket.create_connection(("127.0.0.1", stage.lan_port), timeout=30) as plain:
        plain.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{stage.lan_port}\r\n\r\n".encode())
        assert b"HTTP" not in plain.recv(4096)
    with socket.create_connection(("127.0.0.1", stage.console.port), timeout=30) as plain, pytest.raises(OSError):
        untrusting().wrap_socket(plain)
    assert answer(stage.console.port, "GET", "/hello")[0] == 200
    assert "Traceback" not in stage.log()


def test_second_console_names_first_and_other_port_works(stage: ServerStage) -> None:
    port = str(stage.console.port)
    done = CliRunner().invoke(cli, ["console", "--port", port], env=stage.fleet.environment)
    assert done.exit_code == 1
    assert f"http://127.0.0.1:{port}." in done.output
    done = CliRunner().invoke(cli, ["up", "--sim", "1", "--console-port", port], env=stage.fleet.environment)
    assert (done.exit_code, f"`fleet up --console-port {int(port) + 1}`" in done.output) == (1, True), done.output
    done = CliRunner().invoke(
        cli, ["console", "--port", "0", "--lan", "--lan-port", str(stage.lan_port)], env=stage.fleet.environment
    )
    assert (done.exit_code, "--lan-port 0" in done.output) == (1, True)
    second = ConsoleProcess(stage.fleet)
    stage.drive()
    assert answer(second.port, "POST", "/stop", Origin=second.address)[0] == 204
    wait_for(lambda: not stage.judge.driving, "red stands")
    assert answer(stage.console.port, "GET", "/hello") == (200, b"fleet console")
    assert second.process.end() == 0


def test_page_starts_plan_if_none_runs(stage: ServerStage) -> None:  # the last test: its coordinator stays
    teacher = stage.device("teacher", "--rank", "lead")
    plan = "roles:\n  guide: {mode: manual}\n"
    status, text = teacher.ask("POST", "/plan/set", plan)
    assert (status, json.loads(text)["ok"]) == (200, True), text
    with teacher.socket() as page:
        while not (shown := next_message(page, "plan"))["running"]:  # the token may arrive after the answer
            pass
    assert (shown["plan"]["text"], shown["plan"]["set_by"].partition("@")[0]) == (plan, "teacher")

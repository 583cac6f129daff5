"""The console's server without a browser: it stops cars and refuses strangers. `make soak` has the browser's tests."""

import http.client
from collections.abc import Iterator

import pytest

from fleet.client.client import Fleet as Client
from tests.support.console import ConsoleProcess
from tests.support.judge import Judge
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for


@pytest.fixture
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetProcesses]:
    processes = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("server"))
    yield processes
    processes.close()


def answer(port: int, verb: str, path: str, **headers: str) -> tuple[int, bytes]:
    """Ask the console; its status and its text."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request(verb, path, headers=headers)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def test_a_stop_stops_and_strangers_are_refused(fleet: FleetProcesses) -> None:
    _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    fleet.gateway(link, car="red", platform="arduino")
    judge = Judge.follow(fleet.bus, "red")
    console = ConsoleProcess(fleet)
    own = console.address
    fleet.ready("red")
    status, page = answer(console.port, "GET", "/")
    assert status == 200
    assert b"<html" in page
    assert answer(console.port, "GET", "/", Host="evil.example")[0] in (400, 403, 421)
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        person.car("red").drive("forward", 10.0, wait=False).check()
        wait_for(lambda: judge.driving, "red drives")
        assert answer(console.port, "POST", "/stop", Origin="http://evil.example")[0] == 403
        assert judge.driving, "a stranger stopped it"
        assert answer(console.port, "POST", "/stop", Origin=own)[0] // 100 == 2
        wait_for(lambda: not judge.driving, "red stands")
    assert console.process.end() == 0

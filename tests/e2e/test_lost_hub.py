"""The hub has ended and its gateways go on: no command may say that nothing is running, as a car may drive."""

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fleet.client.claims import NOT_STOPPED
from fleet.client.client import Fleet as Client
from fleet.client.hub_ended import LostHub
from schemas.bus import NoFleet, accepts
from schemas.running_cars import running_cars
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, GatewayProcess, driving, wait_for
from tests.support.up import fleet_command

NOTHING = "Nothing is running yet"


@contextmanager
def without_hub(fleet: FleetProcesses) -> Iterator[None]:
    """Kill the hub, and keep its port until the end: no gateway can start another hub."""
    host, port = fleet.endpoint.removeprefix("tcp/").split(":")
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of the dead hub have the port yet
        os.kill(fleet.hub.pid, signal.SIGKILL)
        fleet.hub.wait()
        taken.bind((host, int(port)))
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)  # from now on nobody else can bind it
        yield


@pytest.fixture
def sim(fleet: FleetProcesses, monkeypatch: pytest.MonkeyPatch) -> GatewayProcess:
    """Return the simulator of red, which drives by a mode: no lost operator ends that."""
    for name, value in fleet.environment.items():
        monkeypatch.setenv(name, value)
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    gateway = fleet.gateway(link)
    fleet.ready()
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        person.car("red").mode("tracking").check()
    wait_for(lambda: driving(sim), "red drives")
    assert gateway.popen.poll() is None
    return sim


def test_stop_at_hub_of_another_computer_that_does_not_answer_says_not_stopped() -> None:
    where = free_endpoint().replace("127.0.0.1", "0.0.0.0")  # no loopback address by its name
    for words in (["stop"], ["estop", "red"], ["stop", "--json"]):
        done = fleet_command(*words, "--connect", where, environment={})
        assert (done.returncode, done.stdout) == (1, ""), words
        assert NOT_STOPPED in done.stderr, words
        assert NOTHING not in done.stderr, words


def test_stop_without_hub_says_not_stopped_until_hub_returns(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    with without_hub(fleet):
        for words in (["stop"], ["stop", "red"], ["stop", "--json"], ["estop"], ["estop", "red"]):
            done = fleet_command(*words, environment=fleet.environment)
            assert (done.returncode, done.stdout) == (1, ""), words
            assert NOT_STOPPED in done.stderr, words
            assert NOTHING not in done.stderr
            for told in ("red", "go to the cars", "fleet up", fleet.endpoint):
                assert told in done.stderr, words
        assert driving(sim), "it has said the truth"

    def stops() -> bool:
        done = fleet_command("stop", environment=fleet.environment)
        assert done.returncode == 0 or "cars may move" in done.stderr, done.stderr
        return done.returncode == 0

    wait_for(stops, "the hub is back")
    wait_for(lambda: not driving(sim), "red stands")


def test_without_a_hub_no_command_says_that_nothing_is_running(fleet: FleetProcesses, sim: GatewayProcess) -> None:
    with without_hub(fleet):
        for typed in (
            "list",
            "status",
            "drive red forward --for 1s",
            "get red",
            "watch red",
            "doctor",
            "down",
            "reload",
        ):
            done = fleet_command(*typed.split(), environment=fleet.environment)
            assert done.returncode == 1, typed
            assert NOTHING not in done.stdout + done.stderr, typed
            assert "red" in done.stderr, typed
            assert "go to the cars" in done.stderr, typed
        assert driving(sim)
    wait_for(lambda: accepts(fleet.endpoint), "the gateway has started another hub")
    done = fleet_command("status", environment=fleet.environment)
    assert done.returncode == 1
    assert "gateways run here (red): cars may move" in done.stderr


def test_mark_ends_with_its_gateway_however_that_ends(fleet: FleetProcesses, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", fleet.environment["FLEET_STATE_DIR"])
    _, links = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
    red, blue = (fleet.gateway(link, car=car) for link, car in zip(links, ("red", "blue"), strict=True))
    fleet.ready("red")
    fleet.ready("blue")
    assert running_cars(fleet.endpoint) == ["blue", "red"]
    red.popen.kill()
    red.wait()
    assert running_cars(fleet.endpoint) == ["blue"]
    with without_hub(fleet):
        with pytest.raises(LostHub, match="blue"):
            Client(fleet.endpoint)
        blue.popen.kill()
        blue.wait()
        with pytest.raises(NoFleet, match=NOTHING):
            Client(fleet.endpoint)

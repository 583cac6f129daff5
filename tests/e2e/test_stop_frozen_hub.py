"""A STOP while the hub hangs: it stops the car as soon as the hub goes on, and nobody is told otherwise meanwhile."""

import http.client
import os
import signal
import threading
import time

import pytest

from fleet.client.claims import NOT_STOPPED
from fleet.client.client import Fleet as Client
from fleet.client.commands import STOP_TTL_S
from fleet.console.server import STOP_NOT_TAKEN
from tests.support.console import ConsoleProcess
from tests.support.judge import Judge
from tests.support.processes import FleetProcesses, freeze, wait_for
from tests.support.soaks import only_in_soak
from tests.support.up import fleet_command

LEASE_S = 2.0
"""Time after which a session notices that the hub hangs (schemas/bus/endpoint.py)."""


@pytest.fixture
def judge(fleet: FleetProcesses) -> Judge:
    """Return the judge of a car that drives by a mode, which no lost operator ends."""
    _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    fleet.gateway(link)
    judge = Judge.follow(fleet.bus, "red")
    fleet.ready()
    return judge


def drive_by_a_mode(fleet: FleetProcesses, judge: Judge) -> None:
    with Client(fleet.endpoint, sender="mia", kind="person") as person:
        person.car("red").mode("tracking").check()
    wait_for(lambda: judge.driving, "red drives")


def post_stop(port: int, stop_id: str = "") -> int:
    """Send a STOP to the console as its page does; return the status."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("POST", f"/stop?id={stop_id}", headers={"Origin": f"http://127.0.0.1:{port}"})
    response = connection.getresponse()
    status, body = response.status, response.read()
    connection.close()
    assert (NOT_STOPPED.encode() in body) == (status == 503), STOP_NOT_TAKEN
    return status


@pytest.mark.parametrize(
    "frozen_s",
    [*only_in_soak((0.5 * LEASE_S, LEASE_S + 0.5)), 2 * LEASE_S],
)
def test_stop_during_hub_hang_arrives_after_it(fleet: FleetProcesses, judge: Judge, frozen_s: float) -> None:
    console = ConsoleProcess(fleet)
    assert post_stop(console.port) == 204
    drive_by_a_mode(fleet, judge)
    freeze(fleet.hub.pid)
    began = time.monotonic()
    try:
        assert post_stop(console.port, "a") == 503
        assert judge.driving
        wait_for(lambda: time.monotonic() - began >= frozen_s, "the hub stands still")
    finally:
        os.kill(fleet.hub.pid, signal.SIGCONT)
    thawed_ns = time.time_ns()
    assert judge.wait_off(thawed_ns, watched_s=0.5) < STOP_TTL_S - frozen_s
    assert post_stop(console.port, "a") == 204


@pytest.mark.soak
def test_stop_command_waits_for_hung_hub(fleet: FleetProcesses, judge: Judge) -> None:
    drive_by_a_mode(fleet, judge)
    freeze(fleet.hub.pid)
    threading.Timer(0.7 * STOP_TTL_S, os.kill, (fleet.hub.pid, signal.SIGCONT)).start()
    done = fleet_command("stop", "red", environment=fleet.environment)
    assert (done.returncode, done.stdout[:13]) == (0, "red: stopped ")
    assert not judge.driving


def test_stop_command_at_hung_hub_says_not_stopped(fleet: FleetProcesses, judge: Judge) -> None:
    drive_by_a_mode(fleet, judge)
    freeze(fleet.hub.pid)
    try:
        done = fleet_command("stop", "red", environment=fleet.environment)
    finally:
        os.kill(fleet.hub.pid, signal.SIGCONT)
    assert done.returncode == 1
    assert NOT_STOPPED in done.stderr
    assert "go to the car" in done.stderr

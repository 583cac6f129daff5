import subprocess
from collections.abc import Iterator

import pytest
import zenoh

from schemas import keys
from schemas.bus import Bus, Publisher, router_config
from schemas.topics import TOPICS
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

_started: list["subprocess.Popen[str]"] = []


def popen(command: list[str]) -> "subprocess.Popen[str]":
    """Start a process, which ends with the test's hub at the latest, also if the test fails."""
    _started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    return _started[-1]


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Start a hub for one test."""
    where = free_endpoint()
    with zenoh.open(router_config(where)):
        yield where
        while _started:
            with _started.pop() as left:
                left.kill()


@pytest.fixture
def hub_apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start a hub in a process of its own, for large loads.

    All sessions of one process share two receiving threads. If the hub waits on one of them for room towards a
    recorder, and the other one sleeps, the recorder receives nothing. After five seconds the hub closes its link.
    """
    fleet = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("hub"))
    try:
        yield fleet.endpoint
    finally:
        fleet.close()


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    """Open a session before the recorder starts."""
    with Bus.open(endpoint) as opened:
        yield opened


def publisher(bus: Bus, car: str, topic: str) -> Publisher:
    """Declare a publisher. Wait until it has the recorder's subscription. An older session gets it late."""
    made = bus.publisher(keys.topic_key("fleet", car, topic), TOPICS[topic], car)
    with bus._session.declare_publisher(made.key) as plain:  # zenoh.ext's have no such method
        wait_for(lambda: plain.matching_status.matching, f"a subscriber of {made.key}")  # type: ignore[attr-defined]
    return made


def heard(session: zenoh.Session) -> None:
    """Wait until the recorder has this session's publications. A query of the same priority comes behind them."""
    ask = "fleet/@recorder/status"
    wait_for(lambda: any(reply.ok for reply in session.get(ask, timeout=10.0)), "the recorder answers")

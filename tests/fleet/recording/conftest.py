import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh

from schemas import keys
from schemas.bus import Bus, Publisher, router_config
from schemas.topics import TOPICS


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = 30.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > deadline:
            pytest.fail(f"{what}: not within {timeout_s:g} s")
        time.sleep(0.01)


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A hub of this test's own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with zenoh.open(router_config(where)):
        yield where


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    """A session that was there before the recorder."""
    with Bus.open(endpoint) as opened:
        yield opened


def publisher(bus: Bus, car: str, topic: str) -> Publisher:
    """A publisher that knows of the recorder: a session that was there before it is told a moment later."""
    made = bus.publisher(keys.topic_key("fleet", car, topic), TOPICS[topic], car)
    with bus._session.declare_publisher(made.key) as plain:  # zenoh.ext's publishers cannot be asked this
        wait_for(lambda: plain.matching_status.matching, f"a subscriber of {made.key}")
    return made

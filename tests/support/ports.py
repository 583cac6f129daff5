"""Endpoints that nobody else uses: every test that opens Zenoh has one of its own."""

import contextlib
import os
import random
import socket
from collections.abc import Iterator
from itertools import chain

from tests.support.scheduling import SUITE, SUITES

FIRST, LAST = 10_000, 15_999
"""Below those that a system gives to whoever does not name one: until a hub listens seconds may pass, and a port that
was only looked at was given to somebody else meanwhile, in one run of the whole suite out of ten."""


def ports_of(worker: int, workers: int, suite: int = 0, suites: int = 1) -> range:
    """Return the ports of one worker of pytest-xdist. Suites that run at once (`make stress`) share none."""
    return range(FIRST + suite * workers + worker, LAST + 1, workers * suites)


def _turn() -> Iterator[int]:
    """The ports of this worker, over and over; another run on this machine begins elsewhere."""
    worker, workers = os.environ.get("PYTEST_XDIST_WORKER", "gw0"), os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")
    suite, suites = os.environ.get(SUITE, "0"), os.environ.get(SUITES, "1")
    mine = ports_of(int(worker.removeprefix("gw")), int(workers), int(suite), int(suites))
    begun = random.SystemRandom().randrange(len(mine))
    while True:
        yield from chain(mine[begun:], mine[:begun])


_ports = _turn()


def free_port() -> int:
    """A port of loopback that was free a moment ago, and that no other test of this run is given."""
    while True:
        port = next(_ports)
        with socket.socket() as probe, contextlib.suppress(OSError):  # it is taken
            probe.bind(("127.0.0.1", port))
            return port


def free_endpoint() -> str:
    """A loopback endpoint with such a port."""
    return f"tcp/127.0.0.1:{free_port()}"

"""Endpoints for tests: every test that opens Zenoh has one of its own."""

import contextlib
import os
import random
import socket
from collections.abc import Iterator
from itertools import chain

from tests.support.scheduling import SUITE, SUITES

FIRST, LAST = 10_000, 15_999
"""First and last port. They are below the ports that a system assigns by itself.

A hub may take seconds to listen. When the system chose the ports, it gave a probed port to another process meanwhile,
in one of ten runs of the suite."""


def ports_of(worker: int, workers: int, suite: int = 0, suites: int = 1) -> range:
    """Return the ports of one worker of pytest-xdist. Suites that run at once (`make stress`) share none."""
    return range(FIRST + suite * workers + worker, LAST + 1, workers * suites)


def _turn() -> Iterator[int]:
    """Yield the ports of this worker in a circle. Each run on a machine begins at a random one."""
    worker, workers = os.environ.get("PYTEST_XDIST_WORKER", "gw0"), os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")
    suite, suites = os.environ.get(SUITE, "0"), os.environ.get(SUITES, "1")
    mine = ports_of(int(worker.removeprefix("gw")), int(workers), int(suite), int(suites))
    begun = random.SystemRandom().randrange(len(mine))
    while True:
        yield from chain(mine[begun:], mine[:begun])


_ports = _turn()


def free_port() -> int:
    """Return a port of loopback that is free and that no other test of this run gets."""
    while True:
        port = next(_ports)
        with socket.socket() as probe, contextlib.suppress(OSError):  # a process listens there
            probe.bind(("127.0.0.1", port))
            return port


def free_endpoint() -> str:
    """Return a loopback endpoint with a port of `free_port`."""
    return f"tcp/127.0.0.1:{free_port()}"

"""Tests the messages to systemd on a real socket. Time is an argument."""

import os
import socket
import tempfile
from collections.abc import Iterator
from math import inf
from pathlib import Path

import pytest

from schemas.process.service_notifier import (
    FEEDS_PER_WATCHDOG,
    NOTIFY_SOCKET,
    READY_RETRY_S,
    WATCHDOG_PID,
    WATCHDOG_USEC,
    ServiceNotifier,
)

READY = b"READY=1\nWATCHDOG=1"
ALIVE = b"WATCHDOG=1"
SECONDS = str(2 * FEEDS_PER_WATCHDOG * 10**6)  # so one message each 2 s


@pytest.fixture
def manager() -> Iterator[socket.socket]:
    # The path of a socket has at most 107 characters.
    with tempfile.TemporaryDirectory(dir="/tmp") as short, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(Path(short) / "notify"))
        bound.setblocking(False)
        yield bound


def taken(manager: socket.socket) -> list[bytes]:
    found: list[bytes] = []
    while True:
        try:
            found.append(manager.recv(4096))
        except BlockingIOError:
            return found


def test_notifier_sends_ready_then_watchdog_while_fed(manager: socket.socket) -> None:
    notifier = ServiceNotifier({NOTIFY_SOCKET: manager.getsockname(), WATCHDOG_USEC: SECONDS})
    assert taken(manager) == []
    for now in (100.0, 100.1, 101.9, 102.0, 103.9, 104.5):
        notifier.feed(now)
    assert taken(manager) == [READY, ALIVE, ALIVE]
    assert notifier.due_at == 106.5
    notifier.close()
    notifier.feed(200.0)
    assert taken(manager) == []


@pytest.mark.parametrize(
    "watchdog",
    [{}, {WATCHDOG_USEC: "0"}, {WATCHDOG_USEC: "soon"}, {WATCHDOG_USEC: SECONDS, WATCHDOG_PID: "1"}],
    ids=["none", "zero", "no number", "of another process"],
)
def test_without_a_watchdog_it_is_ready_once(watchdog: dict[str, str], manager: socket.socket) -> None:
    notifier = ServiceNotifier({NOTIFY_SOCKET: manager.getsockname(), **watchdog})
    notifier.feed(1.0)
    notifier.feed(1e9)
    assert taken(manager) == [READY]
    assert notifier.due_at == inf
    notifier.close()


def test_process_that_is_named_is_watched(manager: socket.socket) -> None:
    watchdog = {WATCHDOG_USEC: SECONDS, WATCHDOG_PID: str(os.getpid())}
    notifier = ServiceNotifier({NOTIFY_SOCKET: manager.getsockname(), **watchdog})
    notifier.feed(1.0)
    assert notifier.due_at == 3.0
    notifier.close()


def test_abstract_socket_is_one() -> None:
    name = f"fleet-notify-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(f"\0{name}")
        bound.settimeout(10)
        notifier = ServiceNotifier({NOTIFY_SOCKET: f"@{name}"})
        notifier.feed(1.0)
        assert bound.recv(4096) == READY
        notifier.close()


def test_ready_is_sent_again_until_it_has_arrived(manager: socket.socket) -> None:
    path = Path(manager.getsockname())
    notifier = ServiceNotifier({NOTIFY_SOCKET: str(path)})
    away = path.rename(path.with_suffix(".away"))
    notifier.feed(5.0)
    assert notifier.due_at == 5.0 + READY_RETRY_S
    away.rename(path)
    notifier.feed(notifier.due_at)
    assert taken(manager) == [READY]
    assert notifier.due_at == inf
    notifier.close()


@pytest.mark.parametrize("address", ["", "vsock:2:1", "relative"])
def test_without_a_socket_nothing_is_due(address: str) -> None:
    notifier = ServiceNotifier({NOTIFY_SOCKET: address, WATCHDOG_USEC: SECONDS})
    notifier.feed(1.0)
    assert notifier.due_at == inf

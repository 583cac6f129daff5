"""Loses messages on a real bus in three ways, and looks whether what is had again has the key of its publisher.

A sample of `fleet/@supervisor/status` was once recorded under `fleet/status`: a car named status appeared. Each
publisher here writes its own key into its messages.
"""

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from google.protobuf.message import DecodeError

from fleet.recording.reading.session import Session
from schemas import messages
from schemas.bus import Bus
from schemas.topics import TOPICS
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, freeze, wait_for
from tests.support.recording import Recording, kill_hub

SUPERVISOR = "fleet/@supervisor/status"
SENDERS = (("@supervisor", "@coordinator"), ("@sim",), ("red", "blue"), ("green", "status"))
"""Who publishes in one session. A car may be named as the last part of a service's key."""
TIMES = 6
INTERVAL_S = 0.004
"""Time between two messages of a key: a reader that is frozen for a second then has more than a hub keeps for it."""


def publish(endpoint: str, senders: tuple[str, ...], over: threading.Event, sent: set[str]) -> None:
    """Publish on every key of these senders until it is over."""
    with Bus.open(endpoint, timeout_s=30.0) as bus:
        outs = []
        for topic in TOPICS.values():
            if not topic.recorded or not topic.message.startswith("fleet.v1."):
                continue
            service, _, rest = topic.name.partition("/")
            names = (service,) if service in senders else () if service.startswith("@") else senders
            for name in names:
                if service.startswith("@") or not name.startswith("@"):
                    key = f"fleet/{name}/{rest if service.startswith('@') else topic.name}"
                    outs.append((bus.publisher(key, topic, key), messages.message_class(topic.message)()))
                    sent.add(key)
        while not over.wait(INTERVAL_S):
            for out, message in outs:
                out.put(message, time.time_ns())


def paused(pid: int, chance: random.Random) -> None:
    """Freeze a process for a time below or above Zenoh's lease of two seconds, and let it catch up."""
    freeze(pid)
    time.sleep(chance.uniform(1.0, 4.0))  # not a wait: the test is about this time
    os.kill(pid, signal.SIGCONT)
    time.sleep(1 + chance.random())  # not a wait: the time between two losses


LOSSES: dict[str, Callable[[FleetProcesses, Recording, random.Random], None]] = {
    "the hub is killed": lambda fleet, _, chance: kill_hub(fleet, chance),
    "the recorder is frozen": lambda _, recording, chance: paused(recording.process.pid, chance),
    "the hub is frozen": lambda fleet, _, chance: paused(fleet.hub.pid, chance),
}


@pytest.mark.soak
@pytest.mark.parametrize("loss", LOSSES)
def test_key_is_what_was_published(loss: str, tmp_path: Path) -> None:
    chance, over, sent = random.Random(loss), threading.Event(), set[str]()
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    threads = [threading.Thread(target=publish, args=(fleet.endpoint, each, over, sent)) for each in SENDERS]
    try:
        recording = Recording(fleet, tmp_path / "sessions")
        for thread in threads:
            thread.start()
        wait_for(lambda: SUPERVISOR in sent, "they publish")
        for _ in range(TIMES):
            LOSSES[loss](fleet, recording, chance)
        over.set()
        recording.end()
    finally:
        over.set()
        for thread in threads:
            thread.join()
        fleet.close()
    session = Session(recording.session)
    wrong: set[tuple[str, str]] = set()
    seen: set[str] = set()
    count = 0
    for each in session.messages():
        if each.key.startswith("fleet/@recorder/"):
            continue
        count += 1
        seen.add(each.key)
        try:
            said = cast("Any", messages.message_class(each.message).FromString(each.payload)).car
        except (DecodeError, KeyError, AttributeError):
            said = "nothing"
        if said != each.key:
            wrong.add((each.key, said))
    assert wrong == set()
    assert seen == sent
    assert session.description is not None
    recovered = session.description.recovered
    assert recovered, "nothing was missed at first: the test tries nothing"
    print(
        f"\n{loss}: {count} messages on {len(seen)} keys, {sum(recovered.values())} had again, each under its own key"
    )

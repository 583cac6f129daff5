"""Repeats tests/e2e/test_recorder_kills.py many times with more cars, and measures the recorder's memory."""

import random
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.lossless import ends_whole, hub_killed, recorder_killed
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for
from tests.support.recording import Load, Recording

CARS = 20
AWAY_S = 30.0
MESSAGES = 10_000_000
PUBLISHERS = 40
AT_ONCE = 50
LEAD = 4_000
"""Maximum number of messages in transit."""
SETTLED = 1_000_000
GROWN = 1.1
"""Maximum ratio of the memory in the second half to the first. The index of the open file makes it vary in each."""


@pytest.mark.soak
def test_hub_killed_twenty_times(tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        told = hub_killed(fleet, tmp_path / "sessions", cars=CARS, times=20, chance=random.Random())
        assert told.recovered, "no message was missed at first: the test tries nothing"
    finally:
        fleet.close()
    print(f"\n{told.published} published over 20 kills of the hub, {told.recovered} had again; none lost, none twice")


@pytest.mark.soak
def test_backfill_recovers_after_any_hub_outage(tmp_path: Path) -> None:
    """Publishers cache a hundred seconds of a topic with two messages a second."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        recording = Recording(fleet, tmp_path / "sessions")
        with Load(fleet.endpoint, CARS, rate_hz=2.0) as load:
            wait_for(lambda: load.count() > 4 * CARS, "a load")
            recording.process.popen.send_signal(signal.SIGSTOP)  # the recorder would start another hub
            fleet.hub.kill()
            fleet.hub.wait()
            time.sleep(AWAY_S)  # not a wait: the test is about this time without a hub
            recording.process.popen.send_signal(signal.SIGCONT)
            ends_whole(fleet, load, CARS, recording, [recording.session])
    finally:
        fleet.close()
    print(f"\n{load.count()} published, the hub and the recorder away for {AWAY_S:g} s; none lost, none twice")


@pytest.mark.soak
def test_recorder_killed_fifty_times(tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        told = recorder_killed(fleet, tmp_path / "sessions", cars=CARS, times=50, chance=random.Random())
    finally:
        fleet.close()
    times = sorted(told.missing_s)
    print(
        f"\n{told.published} published over 50 kills of the recorder, none lost, none twice; a session lacks "
        f"what came in the last {times[len(times) // 2]:.2f} s (median), {times[-1]:.2f} s at most"
    )


@pytest.mark.soak
def test_memory_is_flat_over_ten_million_messages(tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    began = time.monotonic()
    try:
        recording = Recording(fleet, tmp_path / "sessions")
        out = [
            fleet.bus.publisher(f"fleet/car{number}/sensor/line", TOPICS["sensor/line"], f"car{number}")
            for number in range(PUBLISHERS)
        ]
        line, sent, memory = pb.Line(left_inner=True), 0, []

        def follows(count: int) -> bool:
            (status,) = fleet.get("fleet/@recorder/status")
            return int(status.messages) + sum(status.missed.values()) >= count

        while sent < MESSAGES:
            for _ in range(AT_ONCE):
                for each in out:
                    each.put(line, time.time_ns())
            sent += AT_ONCE * PUBLISHERS
            # Send at the recorder's pace: it drops messages beyond that.
            wait_for(partial(follows, sent - LEAD), "the recorder follows")
            if sent % SETTLED == 0:
                memory.append(recording.process.rss_mb())
        wait_for(partial(follows, sent), "all is recorded")
        found = recording.end()
    finally:
        fleet.close()
    shown = ", ".join(f"{each:.0f}" for each in memory)
    missed = sum(found["missed"].values())
    print(f"\n{found['messages']} messages, {missed} lost by the bus, in {time.monotonic() - began:.0f} s")
    print(f"RSS after each million: {shown} MB")
    # At a rate above any fleet's, the bus itself loses messages. The recorder counts them, and loses none by itself.
    assert found["drops"] == {}
    assert found["messages"] + missed >= MESSAGES
    half = len(memory) // 2
    assert max(memory[half:]) < max(memory[:half]) * GROWN

"""Records of commands and events are not lost if the bus is away at that time."""

import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from fleet.recording.writing import backfill_plan
from fleet.recording.writing.recorder import SHUTDOWN_DRAIN_S, Recorder
from schemas import bus
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.judge import Judge
from tests.support.processes import FleetProcesses, freeze, wait_for
from tests.support.tap import Tap


class Records:
    """Every record of commands and events, as a subscriber gets them."""

    def __init__(self, fleet: FleetProcesses) -> None:
        self.events: list[Any] = []
        self.logs: list[Any] = []
        fleet.bus.subscribe("fleet/red/event/command", lambda sample: self.events.append(sample.message()))
        fleet.bus.subscribe("fleet/red/event/log", lambda sample: self.logs.append(sample.message()))

    def phases(self, identity: str) -> list[str]:
        return [event.phase for event in self.events if event.id == identity]

    def recall(self, fleet: FleetProcesses) -> None:
        """Query the cached records, as a subscriber does that returns to the bus later than the gateway."""
        for sample in fleet.bus.recall("fleet/red/event/log", 30.0):
            self.logs.append(bus.sample_of(sample).message())

    def codes(self) -> list[str]:
        return [log.name.removeprefix("red ") for log in self.logs]


def test_gateway_reports_sleep_longer_than_bus_timeout(fleet: FleetProcesses) -> None:
    records, judge = Records(fleet), Judge.follow(fleet.bus)
    _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    gateway = fleet.gateway(link)
    fleet.ready()
    fleet.ask("drive", motion="forward", duration_s=10, id="drive")
    wait_for(lambda: judge.driving, "it drives")
    freeze(gateway.popen.pid)
    wait_for(lambda: not fleet.bus.tokens("fleet/red"), "the bus has given it up")
    gateway.popen.send_signal(signal.SIGCONT)
    wait_for(lambda: "stalled" in records.codes(), "it says that it slept")
    wait_for(lambda: records.phases("drive")[-1:] == ["expired"], "and what became of the drive")
    wait_for(lambda: not judge.driving, "it stands")  # the car's own answer does not need the bus


def test_events_without_hub_are_published_when_it_returns(fleet: FleetProcesses) -> None:
    _, (link,) = fleet.simulate("red:arduino:tcp")
    tap = Tap(link)
    try:
        fleet.gateway(tap.link)
        fleet.ready()
        records = Records(fleet)
        freeze(fleet.hub.popen.pid)  # the hub delivers no message, and no new hub can use its port
        tap.reset()
        fleet.hub.popen.send_signal(signal.SIGKILL)
        wait_for(lambda: fleet.left() and bus.accepts(fleet.endpoint), "another hub")
        back_ns = time.time_ns()
        wait_for(lambda: "link_lost" in records.codes() or records.recall(fleet), "the loss of the link is told")
        lost = next(log for log in records.logs if log.name == "red link_lost")
        assert lost.timestamp.ToNanoseconds() < back_ns, "with the time at which it happened"
    finally:
        tap.close()


def test_hub_hang_at_end_of_recording_loses_no_message(
    fleet: FleetProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backfill_plan, "QUERY_AFTER_START_S", ())  # a query at the end waits for the hub, too
    key = "fleet/red/sensor/range"
    with bus.Bus.open(fleet.endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        ranges = fleet.bus.publisher(key, TOPICS["sensor/range"], "red")
        freeze(fleet.hub.popen.pid)
        for _ in range(20):
            ranges.put(pb.Range(range_m=1.0), time.time_ns())
        closing = threading.Thread(target=recorder.close)
        closing.start()
        closing.join(3 * SHUTDOWN_DRAIN_S)
        fleet.hub.popen.send_signal(signal.SIGCONT)
        closing.join()
    with (session / "0001.mcap").open("rb") as file:
        assert sum(channel.topic == key for _, channel, _ in make_reader(file).iter_messages()) == 20

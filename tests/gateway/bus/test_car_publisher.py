"""Tests of the messages that a gateway publishes, and of its answers to queries, on a real bus."""

import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from gateway.bus.car_publisher import ANSWERS_PER_SLICE, CarPublisher
from gateway.control.commands import Command, Drive, Find, SetMode, Stop
from gateway.control.control_output import CommandRecord
from gateway.control.link_health import LinkHealth
from gateway.drivers.yahboom.estimate.platform import PlatformDetector
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.wire_events import ImuReading
from schemas import keys, messages
from schemas.bus import Bus, Sample
from schemas.words import Mode, Motion, Phase, Reason
from tests.gateway.control.workbench import PERSON, READING, SCRIPT, Workbench
from tests.support.controls import control
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for


def test_long_history_is_answered_in_slices(tmp_path: Path) -> None:
    """As JSON, a long history takes longer than a gateway may leave its car alone."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        with Bus.open(fleet.endpoint) as opened:
            out = CarPublisher(opened, "fleet", "red", control(parse_platform("arduino")), "tcp://x")
            for number in range(3 * ANSWERS_PER_SLICE + 1):
                out.publish_event(ImuReading(b"", float(number), (number, 0, 0), (0, 0, 0)))
            pauses: queue.Queue[int] = queue.Queue()

            def answer(query: zenoh.Query) -> None:
                pauses.put(len(list(out.answer_query("sensor", query))))

            def ask(parameters: str) -> int:
                return len(list(fleet.bus.query(f"fleet/red/sensor/*?{parameters}", timeout_s=20.0)))

            opened.queryable("fleet/red/sensor/*", answer)
            wait_for(lambda: ask(""), "the queryable is known")
            assert pauses.get(timeout=PATIENCE_S) == 0
            for parameters, count, paused in (
                ("last=1500", 3 * ANSWERS_PER_SLICE + 1, 3),
                ("format=json", 1, 0),
                ("last=x", 1, 0),
            ):
                assert (ask(parameters), pauses.get(timeout=PATIENCE_S)) == (count, paused), parameters
    finally:
        fleet.close()


class Published:
    """The messages that the bus carries about a car on the workbench, on virtual time."""

    def __init__(self, fleet: FleetProcesses, opened: Bus) -> None:
        self.desk = Workbench()
        self.health = LinkHealth()
        self._out = CarPublisher(opened, "fleet", "red", self.desk.control, "tcp://x")
        self._said: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
        self._before: dict[str, dict[str, Any]] = {}
        fleet.bus.subscribe("fleet/red/**", self._take)
        wait_for(lambda: (self._states(), not self._said.empty())[1], "the subscription is known")

    def _take(self, sample: Sample) -> None:
        key = keys.parse(sample.key)
        assert key is not None
        self._said.put((key.topic, messages.to_dict(sample.message())))

    def _states(self) -> None:
        self._out.publish_states(self.desk.control, self.health, self.desk.now, force=True)

    def states(self) -> dict[str, dict[str, Any]]:
        """Publish all states. Return the fields of each, as in JSON."""
        self._states()
        self.record(CommandRecord(Command("end", "find", SCRIPT, Find()), Phase.SENT, self.desk.now))
        return self._before

    def battery(self, frame: bytes) -> dict[str, Any]:
        """Publish the readings of a frame, and then give it to control. Return the fields of its battery."""
        for event in FrameSplitter().feed(frame, self.desk.now):
            self._out.publish_event(event)
        self.desk.hear(frame)
        return next(
            fields
            for topic, fields in iter(lambda: self._said.get(timeout=PATIENCE_S), None)
            if topic == "sensor/battery"
        )

    def told_health(self, platform: PlatformDetector) -> dict[str, Any]:
        """Publish the health of a car of this platform. Return its fields, as in JSON."""
        model = self.desk.control.driver.model
        model.platform = platform
        self._out.publish_health(self.desk.now, loop_lag_s=0.0, bus_drops=0)
        self.record(CommandRecord(Command("end", "find", SCRIPT, Find()), Phase.SENT, self.desk.now))
        return self._before["state/health"]

    def record(self, record: CommandRecord) -> dict[str, Any]:
        """Publish a command's record. Return its fields, as in JSON."""
        self._out.publish_command(record, None)
        while True:
            topic, fields = self._said.get(timeout=PATIENCE_S)
            if topic == "event/command":
                return fields
            self._before[topic] = fields


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Published]:
    fleet = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("published"))
    try:
        with Bus.open(fleet.endpoint) as opened:
            yield Published(fleet, opened)
    finally:
        fleet.close()


def test_platform_contradictions_are_published(published: Published) -> None:
    told = PlatformDetector(parse_platform("raspberry_pi"))
    assert published.told_health(told)["platform_contradictions"] == []
    for _ in range(3):
        for event in FrameSplitter().feed(READING, 0.0):
            told.on_event(event)
    words = list(told.contradictions)
    assert words
    assert published.told_health(told)["platform_contradictions"] == words


def test_level_of_battery_is_that_of_the_log(published: Published) -> None:
    """In most modes a car reports no voltage, so the message with the new level may be the last one for long."""
    desk = published.desk
    levels: list[str] = []
    desk.logs.clear()
    while not any(entry.code == "battery_low" for entry in desk.logs):
        desk.now += 1.0
        levels.append(published.battery(b"$4WD,CSB57.24,PV6.55,GS5,LF0000,HW00,GM00#")["level"])
        assert len(levels) < 20
    assert levels == ["ok"] * (len(levels) - 1) + ["low"]


def test_states_leave_out_what_does_not_apply(published: Published) -> None:
    desk, health = published.desk, published.health
    states = published.states()
    assert "last_rx_s" not in states["state/link"], "nothing was heard"
    assert "evidence_age_s" not in states["state/mode"], "there is no evidence"
    assert "expires_in_s" not in states["state/motion"], "nobody holds a motion"
    assert "worst_stop_s" not in states["state/safety"], "no stop can reach the car: there is no link"
    desk.ready()
    health.on_bytes(9, desk.now - 0.5)
    desk.ask(Drive(Motion.FORWARD, 5.0))
    states = published.states()
    assert states["state/link"]["last_rx_s"] == pytest.approx(0.5)
    assert states["state/mode"]["evidence_age_s"] >= 0
    assert states["state/motion"]["expires_in_s"] == pytest.approx(5.0)
    assert states["state/safety"]["worst_stop_s"] > 0
    desk.control.driver.link_down("unplugged", desk.now)
    assert "worst_stop_s" not in published.states()["state/safety"]


def test_records_leave_out_what_does_not_apply(published: Published) -> None:
    desk = Workbench().ready()
    desk.records.clear()
    desk.ask(SetMode(Mode.TRACKING), SCRIPT, age_s=0.0)
    desk.ask(Stop(), PERSON)
    desk.run(9.0)
    found = {(each["verb"], each["phase"]): each for each in map(published.record, desk.records)}
    queued, opened = found["SetMode", "queued"], found["SetMode", "sent"]
    stop, sent, complete = (found["Stop", phase] for phase in ("queued", "sent", "complete"))
    assert queued["age_s"] == 0, "it said that it was asked just now"
    assert stop["worst_case_s"] > 0
    assert opened["took_s"] == 0, "it was written at once"
    assert complete["took_s"] > 0
    for record, left_out in (
        (queued, {"took_s", "worst_case_s"}),
        (opened, {"worst_case_s"}),
        (stop, {"took_s", "age_s"}),
        (sent, {"age_s", "worst_case_s"}),
        (complete, {"age_s", "worst_case_s"}),
    ):
        assert {"age_s", "worst_case_s", "took_s"} - record.keys() == left_out, record
    refused = desk.ask(Drive(Motion.FORWARD), age_s=9.0)
    assert refused.reason is Reason.STALE
    record = published.record(desk.records[-1])
    assert (desk.records[-1].phase, record["age_s"]) == (Phase.REJECTED, 9.0)
    assert "took_s" not in record

"""The recorder writes messages of the bus unchanged, and counts lost ones. mcap's reader reads the file."""

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
import zenoh
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader

from fleet.client.services import ask_recorder
from fleet.quota import Quota
from fleet.recording.writing.backfill import BACKFILL_POLL_INTERVAL_S, LEASE_POLLS
from fleet.recording.writing.recorder import Recorder
from fleet.recording.writing.recorder_service import AnotherRecorder, RecorderService
from fleet.recording.writing.session_writer import Options
from schemas import keys, messages
from schemas.bus import Bus, Publisher, Sample, router_config
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from schemas.words import RecorderState, RecorderVerb
from tests.fleet.recording.conftest import heard, publisher
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for
from tests.support.tap import Tap


def stock(segment: Path) -> list[Any]:
    with segment.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_messages())


def metadata(segment: Path) -> dict[str, dict[str, str]]:
    with segment.open("rb") as file:
        return {record.name: record.metadata for record in make_reader(file).iter_metadata()}


def test_late_joiner_messages_are_recorded_as_published(endpoint: str, tmp_path: Path) -> None:
    sent: dict[str, list[bytes]] = {}
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        for number in range(10):
            # Each publisher has a session of its own and starts at once, because the recorder is ready.
            with Bus.open(endpoint) as late:
                for topic, message in (
                    ("sensor/range", pb.Range(range_m=1.25)),
                    ("sensor/line", pb.Line(left_inner=True)),
                    ("state/mode", pb.Mode(asked="tracking", inferred="unknown", verdict="assumed")),
                ):
                    out = late.publisher(keys.topic_key("fleet", f"car{number}", topic), TOPICS[topic], f"car{number}")
                    sent[out.key] = [out.put(message, time.time_ns()) for _ in range(20)]
                heard(late._session)
        outcome = recorder.close()
    rows = stock(session / "0001.mcap")
    for key, payloads in sent.items():
        mine = [message for _, channel, message in rows if channel.topic == key]
        assert [message.data for message in mine] == payloads
        assert [message.sequence for message in mine] == list(range(1, 21))
        for message in mine:
            assert message.publish_time <= message.log_time < message.publish_time + 60_000_000_000
    assert outcome.messages == len(rows)
    assert not outcome.drops
    assert not outcome.missed
    description = json.loads((session / "session.json").read_text())
    assert description["closed"] is True
    assert description["messages"] == len(rows)


def test_schemas_decode_standalone_one_per_type(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        for car in ("red", "blue"):
            publisher(bus, car, "sensor/range").put(pb.Range(range_m=2.5), time.time_ns())
        heard(bus._session)
        recorder.close()
    ranges = [
        (schema, message) for schema, channel, message in stock(session / "0001.mcap") if "range" in channel.topic
    ]
    assert len({schema.id for schema, _ in ranges}) == 1
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(ranges[0][0].data).file:
        pool.Add(file)  # fails unless dependencies come first
    stranger: Any = message_factory.GetMessageClass(pool.FindMessageTypeByName("fleet.v1.Range"))
    assert [stranger.FromString(message.data).range_m for _, message in ranges] == [2.5, 2.5]


def test_encodings_that_we_do_not_know_are_recorded_too(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with Bus.open(endpoint) as own, zenoh.open(own_config(endpoint)) as stranger:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        for encoding in ("text/plain", "application/protobuf;other.Thing", "application/json"):
            stranger.put("fleet/red/x", b"\xff\x00", encoding=encoding)
        bus.put_command("fleet/red/@cmd/drive", b'{"motion":"forward"}', "application/json", 1)
        heard(stranger)
        heard(bus._session)
        recorder.close()
    rows = [
        (s, c.message_encoding, c.metadata["zenoh_encoding"])
        for s, c, _ in stock(session / "0001.mcap")
        if "red" in c.topic
    ]
    assert sorted(rows, key=str) == sorted(
        [
            (None, "text/plain", "text/plain"),
            (None, "application/protobuf;other.Thing", "application/protobuf;other.Thing"),
            (None, "json", "application/json"),
            (None, "json", "application/json"),
        ],
        key=str,
    )


def own_config(endpoint: str) -> zenoh.Config:
    return zenoh.Config.from_json5(
        json.dumps(
            {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        )
    )


def test_sequence_gaps_are_counted_and_restart_is_none(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    key = "fleet/red/sensor/range"
    with Bus.open(endpoint) as own, zenoh.open(own_config(endpoint)) as stranger:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        # Publishers without a cache cannot backfill. One skips two numbers, another one begins anywhere and wraps.
        for numbers in ((0, 1, 4, 5), (0xFFFFFFFE, 0xFFFFFFFF, 0)):
            with stranger.declare_publisher(key) as out:
                wait_for(lambda out=out: out.matching_status.matching, "a subscriber")
                for number in numbers:
                    out.put(b"", source_info=zenoh.SourceInfo(out.id, number))
        heard(stranger)
        outcome = recorder.close()
    assert outcome.missed == {key: 2}
    assert not outcome.drops
    assert json.loads(metadata(session / "0001.mcap")["recording"]["missed"]) == {key: 2}
    assert json.loads((session / "session.json").read_text())["missed"] == {key: 2}


class TappedCar:
    """A car whose link to the hub can be cut."""

    key = "fleet/red/sensor/range"

    def __init__(self, bus: Bus, tap: Tap) -> None:
        self.bus = bus
        self._tap = tap

    @cached_property
    def _ranges(self) -> Publisher:
        return publisher(self.bus, "red", "sensor/range")  # waits for the recorder

    def put(self, count: int = 1) -> None:
        for _ in range(count):
            self._ranges.put(pb.Range(range_m=1.0), time.time_ns())

    def put_heard(self) -> None:
        self.put()
        heard(self.bus._session)

    def cut(self) -> None:
        self._tap.reset()
        wait_for(lambda: not self.bus.link, "the car is cut off")

    def mend(self) -> None:
        self._tap.accept()
        wait_for(lambda: self.bus.link, "the car is back")

    def lose(self) -> None:
        """Publish a reading while the link is cut."""
        self.cut()
        self.put()
        self.mend()


@contextmanager
def tapped_car(endpoint: str) -> Iterator[TappedCar]:
    tap = Tap(endpoint.replace("tcp/", "tcp://"))
    with closing(tap), Bus.open(tap.link.replace("tcp://", "tcp/")) as bus:
        yield TappedCar(bus, tap)


def test_messages_of_cut_off_car_are_backfilled(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    """The recorder stays connected, so it hears of the gap only after it, with the next message of the car.

    A command event shows no gap, because none comes after it.
    """
    with Bus.open(endpoint) as own, tapped_car(endpoint) as car:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        car.put()
        events = publisher(car.bus, "red", "event/command")
        events.put(pb.CommandEvent(verb="stop"), time.time_ns())
        heard(car.bus._session)
        car.cut()
        car.put(20)
        events.put(pb.CommandEvent(verb="estop"), time.time_ns())
        time.sleep(2 * LEASE_POLLS * BACKFILL_POLL_INTERVAL_S)  # not a wait: how long it is cut off
        car.mend()
        car.put_heard()
        outcome = recorder.close()
    assert outcome.missed == {}
    held = Counter(channel.topic for _, channel, _ in stock(session / "0001.mcap"))
    assert held["fleet/red/sensor/range"] == 22
    assert held["fleet/red/event/command"] == 2


def recorded_numbers(root: Path, key: str) -> list[list[int]]:
    """Return the numbers of the messages under a key, in each session."""
    found = []
    for session in sorted(root.iterdir()):
        rows = [row for segment in sorted(session.glob("*.mcap")) for row in stock(segment)]
        found.append([message.sequence for _, channel, message in rows if channel.topic == key])
    return found


def test_stop_waits_for_missed_messages(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with Bus.open(endpoint) as own, tapped_car(endpoint) as car:
        recorder = Recorder(own, "fleet", tmp_path)
        recorder.start()
        car.put_heard()
        car.lose()
        car.put_heard()
        found = ask_recorder(bus, "fleet", RecorderVerb.STOP)
        assert found is not None
        assert (found.state, dict(found.missed)) == (RecorderState.STOPPED, {})
        (first,) = recorded_numbers(tmp_path, car.key)
        assert sorted(first) == [1, 2, 3]
        car.lose()
        assert ask_recorder(bus, "fleet", RecorderVerb.START) is not None
        car.put_heard()
        outcome = recorder.close()
    assert outcome.missed == {}, "nobody recorded between the two sessions"
    assert recorded_numbers(tmp_path, car.key) == [first, [5]]


def test_messages_that_are_lost_between_two_sessions_are_backfilled(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with Bus.open(endpoint) as own, tapped_car(endpoint) as car:
        recorder = Recorder(own, "fleet", tmp_path, Options(quota=Quota(session=100_000)))
        recorder.start()
        car.put_heard()
        car.cut()
        car.put()
        bus.put_command("fleet/blue/@cmd/drive", os.urandom(200_000), "application/json", 1)
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2, "the next session")
        car.put()
        car.mend()
        car.put_heard()
        outcome = recorder.close()
    assert outcome.missed == {}
    first, second = recorded_numbers(tmp_path, car.key)
    assert (first, sorted(second)) == ([1], [2, 3, 4])


def test_missed_messages_of_a_full_session_go_to_the_next_one(
    endpoint: str, bus: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fleet.recording.writing.backfill.BACKFILL_POLL_INTERVAL_S", 60.0)  # asks only at the end
    with Bus.open(endpoint) as own, tapped_car(endpoint) as car:
        recorder = Recorder(own, "fleet", tmp_path, Options(quota=Quota(session=100_000)))
        first = recorder.start()
        car.put_heard()
        car.lose()
        car.put()
        wait_for(lambda: recorder._session.missed, "the gap")
        bus.put_command("fleet/blue/@cmd/drive", os.urandom(200_000), "application/json", 1)
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2, "the next session")
        car.put_heard()
        outcome = recorder.close()
    assert outcome.missed == {}
    assert recorded_numbers(tmp_path, car.key) == [[1, 3], [4, 2]]
    descriptions = [json.loads((each / "session.json").read_text()) for each in (first, outcome.session)]
    assert [each["closed"] for each in descriptions] == [True, True]
    assert descriptions[0]["missed"] == descriptions[1]["recovered"] == {car.key: 1}


@pytest.mark.parametrize("limits", [{"max_messages": 20}, {"max_bytes": 1000}])
def test_queue_overflow_is_counted_by_key_and_never_blocks(
    limits: dict[str, Any], endpoint: str, bus: Bus, tmp_path: Path
) -> None:
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path, **limits)
        statuses: list[Any] = []
        dropping = threading.Event()

        def look(sample: Sample) -> None:
            statuses.append(sample.message())
            if statuses[-1].drops:
                dropping.set()

        bus.subscribe("fleet/@recorder/status", look)
        session = recorder.start()
        out = publisher(bus, "red", "sensor/range")
        sent = 0
        while not dropping.is_set() or sent < 1000:  # the publisher caches some of these for the backfill
            for _ in range(50):
                out.put(pb.Range(range_m=1.0), time.time_ns())
            sent += 50
            time.sleep(0.01)  # a rate that the hub passes without loss, so only the queue loses messages
        heard(bus._session)
        outcome = recorder.close()
    held = Counter(channel.topic for _, channel, _ in stock(session / "0001.mcap"))[out.key]
    dropped, missed = outcome.drops.get(out.key, 0), outcome.missed.get(out.key, 0)
    assert held + dropped + missed == sent, "also of those that the backfill restored"
    assert held > 0
    assert json.loads((session / "session.json").read_text())["recovered"].get(out.key, 0) > 0
    assert json.loads(metadata(session / "0001.mcap")["recording"]["drops"]) == dict(outcome.drops)


def test_huge_message_is_recorded_and_oversized_one_counted(hub_apart: str, tmp_path: Path) -> None:
    payload = os.urandom(20_000_000)
    with Bus.open(hub_apart) as own, zenoh.open(own_config(hub_apart)) as stranger:
        recorder = Recorder(own, "fleet", tmp_path, max_bytes=30_000_000)
        session = recorder.start()
        # By default, Zenoh drops messages that it cannot send at once: on a busy machine, most of the large ones.
        whole: Any = {"congestion_control": zenoh.CongestionControl.BLOCK}
        stranger.put("fleet/red/map", payload, **whole)
        wait_for(lambda: recorder._session.bytes > len(payload), "it is in the file")
        stranger.put("fleet/red/larger", bytes(30_000_001), **whole)
        stranger.put("fleet/red/note", b"still there", **whole)
        wait_for(lambda: recorder._session.drops, "it has come, and is counted")
        heard(stranger)
        outcome = recorder.close()
    held = {channel.topic: message.data for _, channel, message in stock(session / "0001.mcap")}
    assert held["fleet/red/map"] == payload
    assert held["fleet/red/note"] == b"still there"
    assert "fleet/red/larger" not in held
    assert outcome.drops == {"fleet/red/larger": 1}
    assert json.loads((session / "session.json").read_text())["drops"] == {"fleet/red/larger": 1}


def test_status_is_published_answered_and_recorded(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    seen: list[Any] = []
    bus.subscribe("fleet/@recorder/status", lambda sample: seen.append(sample.message()))
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        publisher(bus, "red", "sensor/range").put(pb.Range(range_m=1.0), time.time_ns())
        wait_for(lambda: any(status.messages > 1 for status in seen), "a status that counts")
        (answer,) = bus.query("fleet/@recorder/status", timeout_s=10.0)
        (as_json,) = bus.query("fleet/@recorder/status?format=json", timeout_s=10.0)
        assert isinstance(answer, Sample)
        assert isinstance(as_json, Sample)
        assert answer.message().session == json.loads(as_json.payload)["session"] == str(session)  # type: ignore[attr-defined]
        recorder.close()
    last = wait_for(lambda: seen[-1].state == "closed" and seen[-1], "the closed status")
    assert last.bytes == (session / "0001.mcap").stat().st_size
    assert last.free_bytes > 0
    recorded = [m for _, c, m in stock(session / "0001.mcap") if c.topic == "fleet/@recorder/status"]
    assert [pb.Recording.FromString(m.data).state for m in recorded] == ["recording"] * len(recorded) != []


def test_second_recorder_is_refused_and_told_of_the_first(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        with pytest.raises(AnotherRecorder, match=str(session)):
            Recorder(bus, "fleet", tmp_path).start()
        other = Recorder(bus, "other", tmp_path)  # another fleet may have its own recorder
        other.start()
        other.close()
        recorder.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_of_two_recorders_that_start_at_once_one_goes_on(
    endpoint: str, bus: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither saw the token of the other, so both recorded, and a command reached one of them by chance."""
    both_have_looked, look = threading.Barrier(2), RecorderService.refuse_a_second

    def look_at_once(service: RecorderService) -> None:
        look(service)
        both_have_looked.wait(30.0)

    monkeypatch.setattr(RecorderService, "refuse_a_second", look_at_once)
    with Bus.open(endpoint) as one, Bus.open(endpoint) as other:
        buses = sorted((one, other), key=lambda each: each.boot_id)
        recorders = [Recorder(each, "fleet", tmp_path) for each in buses]
        with ThreadPoolExecutor() as pool:
            first, second = pool.map(Recorder.start, recorders)
        assert recorders[1].ended.wait(30.0)
        with pytest.raises(AnotherRecorder, match=str(first)):
            recorders[1].close()
        assert not recorders[0].ended.is_set()
        found = ask_recorder(bus, "fleet", RecorderVerb.STATUS)
        assert found is not None
        assert (found.session, found.state) == (str(first), RecorderState.RECORDING)
        recorders[0].close()
    description = json.loads((second / "session.json").read_text())
    assert description["closed"]
    assert str(first) in description["error"]


def test_flush_each_second_reaches_disk(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    from fleet.recording.reading.session import Session

    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        out = publisher(bus, "red", "sensor/range")
        out.put(pb.Range(range_m=1.0), time.time_ns())

        def held() -> list[str]:
            return [message.key for message in Session(session).messages() if message.key == out.key]

        def damage() -> str:
            opened = Session(session)
            opened.check()
            return opened.damage_words

        assert wait_for(held, "the reading in the file") == [out.key]
        assert "is cut" in damage()
        recorder.close()
        assert not damage()


def test_topics_that_are_recorded_match_the_subscriptions() -> None:
    for topic in TOPICS.values():
        key = keys.topic_key(
            "fleet", *(topic.name.split("/", 1) if topic.name.startswith("@") else ("red", topic.name))
        )
        matching = [e for e in keys.recorded_keys("fleet") if zenoh.KeyExpr(e).includes(zenoh.KeyExpr(key))]
        assert len(matching) == int(topic.recorded), key


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_wall_clock_step_keeps_message_order(endpoint: str, tmp_path: Path, step_s: int) -> None:
    key, step_ns = "fleet/red/sensor/range", [0]
    with Bus.open(endpoint) as own, Bus.open(endpoint) as cars:
        recorder = Recorder(own, "fleet", tmp_path, wall_ns=lambda: time.time_ns() + step_ns[0])
        session = recorder.start()
        ranges = cars.publisher(key, TOPICS["sensor/range"], "red")
        for number in range(40):
            if number == 20:
                heard(cars._session)
                step_ns[0] = step_s * 1_000_000_000
            ranges.put(pb.Range(range_m=1.0), time.time_ns())
            time.sleep(0.01)  # the messages come in several batches
        heard(cars._session)
        recorder.close()
    mine = [message for _, channel, message in stock(session / "0001.mcap") if channel.topic == key]
    assert [message.sequence for message in mine] == list(range(1, 41)), "stock readers sort by log_time"
    description = json.loads((session / "session.json").read_text())
    assert description["closed"]
    assert description["ended"] >= description["started"]


def test_backfilled_message_keeps_published_key(tmp_path: Path) -> None:
    from fleet.recording.reading.session import Session

    topics = {
        "fleet/@supervisor/status": "@supervisor/status",
        "fleet/@coordinator/assignment": "@coordinator/assignment",
        "fleet/@sim/world": "@sim/world",
        "fleet/red/state/mode": "state/mode",
        "fleet/status/state/mode": "state/mode",
    }
    where = free_endpoint()
    hub = zenoh.open(router_config(where))
    with Bus.open(where) as own, Bus.open(where) as one, Bus.open(where) as other:
        recorder = Recorder(own, "fleet", tmp_path)
        session = recorder.start()
        outs = [
            (bus.publisher(key, TOPICS[topic], key), messages.message_class(TOPICS[topic].message)())
            for (key, topic), bus in zip(topics.items(), cycle((one, other)), strict=False)
        ]

        def put(count: int) -> None:
            for _ in range(count):
                for out, message in outs:
                    out.put(message, time.time_ns())

        def lacking() -> set[tuple[str, int]]:
            numbers = {(each.key, each.sequence) for each in Session(session).messages()}
            return {(out.key, number) for out, _ in outs for number in range(1, out.sequence + 1)} - numbers

        put(10)
        wait_for(lambda: not lacking(), "what was published with a hub")
        hub.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        wait_for(lambda: not (own.connected or one.connected or other.connected), "no link is left")
        put(20)  # the bus loses all of these
        with zenoh.open(router_config(where)):
            wait_for(lambda: not lacking(), "the backfill has what was lost")
            recorder.close()
    said = Counter(
        (channel.topic, getattr(messages.message_class(schema.name).FromString(message.data), "car", None))
        for schema, channel, message in stock(session / "0001.mcap")
        if "/@recorder/" not in channel.topic
    )
    assert said == {(key, key): 30 for key in topics}

"""A bus that goes on in a second session: nothing is lost, and nothing comes twice. Real Zenoh sessions."""

import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from schemas import topics
from schemas.bus import Bus, BusError, Sample, SampleChannel, accepts, messages_of, sample_of
from schemas.bus.overlap import TWIN_S, Overlap
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos
from tests.support import processes
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for

RANGE = "fleet/red/sensor/range"
TOPIC = topics.TOPICS["sensor/range"]
RATE_HZ = 500.0
QUICK = {"overlap_s": 0.1, "answers_s": 0.1}


@pytest.fixture
def hub() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    where = free_endpoint()
    process = subprocess.Popen([sys.executable, "-m", "schemas.bus.hub", "--endpoint", where])
    wait_for(lambda: accepts(where), "the hub listens")
    yield where, process
    process.terminate()
    process.wait(processes.PATIENCE_S)


@pytest.fixture
def endpoint(hub: tuple[str, subprocess.Popen[bytes]]) -> str:
    return hub[0]


class Publishing:
    """A thread that publishes numbers, one after the other."""

    def __init__(self, bus: Bus) -> None:
        self.publisher = bus.publisher(RANGE, TOPIC, "red")
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self.over.wait(1 / RATE_HZ):
            self.publisher.put(pb.Range(range_m=1.0), time.time_ns())


@contextmanager
def publishing(bus: Bus) -> Iterator[Publishing]:
    made = Publishing(bus)
    made.thread.start()
    try:
        yield made
    finally:
        made.over.set()
        made.thread.join()


def _drain(channel: SampleChannel, into: list[Sample]) -> bool:
    while (sample := channel.try_recv()) is not None:
        into.append(sample_of(sample))
    return bool(into)


def numbers(samples: list[Sample]) -> list[int]:
    return [message.seq for message in messages_of(samples)]


def test_reopened_reader_gets_each_message_once(endpoint: str) -> None:
    with Bus.open(endpoint) as sender, Bus.open(endpoint) as reader:
        got: list[Sample] = []
        reader.subscribe("fleet/**", got.append)
        channel = reader.subscribe_channel("fleet/**", 4096)
        with publishing(sender) as sent:
            wait_for(lambda: got, "the first")
            before = reader.id
            reader.reopen(**QUICK)
            assert reader.id != before
            last = sent.publisher.sequence + 20
            wait_for(lambda: numbers(got)[-1] > last, "it goes on")
        wait_for(lambda: numbers(got)[-1] == sent.publisher.sequence, "the last")
        seen = numbers(got)
        assert Counter(seen) == Counter(range(seen[0], sent.publisher.sequence + 1))
        read: list[Sample] = []
        wait_for(lambda: _drain(channel, read) and numbers(read)[-1] == sent.publisher.sequence, "the last is read")
        assert Counter(numbers(read)) == Counter(seen)


def test_reopened_publisher_loses_nothing(endpoint: str) -> None:
    with Bus.open(endpoint) as sender, Bus.open(endpoint) as reader:
        got: list[Sample] = []
        reader.subscribe("fleet/**", got.append)
        with publishing(sender) as sent:
            wait_for(lambda: got, "the first")
            for _ in range(3):
                sender.reopen(**QUICK)
        wait_for(lambda: sent.publisher.sequence in numbers(got)[-20:], "the last")
        seen = numbers(got)
        assert sorted(seen) == list(range(seen[0], sent.publisher.sequence + 1))
        assert len({message.boot_id for message in messages_of(got)}) == 1


def test_each_command_is_carried_out_once_and_answered_once(endpoint: str) -> None:
    with Bus.open(endpoint) as car, Bus.open(endpoint) as asker:
        carried_out: list[bytes] = []

        def answer(query: zenoh.Query) -> None:
            with query:
                assert query.payload is not None
                carried_out.append(query.payload.to_bytes())
                query.reply("fleet/red/@cmd/stop", query.payload.to_bytes())

        car.queryable("fleet/red/@cmd/*", answer)
        moving = threading.Thread(target=car.reopen, kwargs={"overlap_s": 0.3, "answers_s": 0.1})
        sent, answered = 0, 0
        wait_for(lambda: list(asker.query("fleet/red/@cmd/stop", payload=b"first")), "it is known")
        moving.start()
        while moving.is_alive():
            for _ in range(2):  # two that are equal are two
                sent += 1
                answers = list(asker.query("fleet/red/@cmd/stop", payload=b"%d" % (sent // 2), qos=Qos.COMMAND))
                answered += len(answers)
        moving.join()
        assert sent > 50
        assert answered == sent
        assert sum(1 for each in carried_out if each != b"first") == sent


def test_token_lasts_and_a_watcher_hears_of_no_change(endpoint: str) -> None:
    with Bus.open(endpoint) as car, Bus.open(endpoint) as watcher:
        came: list[tuple[str, bool]] = []
        car.token("fleet/red")
        blue = car.token("fleet/blue")
        watcher.watch_tokens("fleet/*", lambda key, alive: came.append((key, alive)))
        wait_for(lambda: len(came) == 2, "both")
        car.reopen(**QUICK)
        watcher.reopen(**QUICK)
        blue.undeclare()
        wait_for(lambda: len(came) == 3, "blue has gone")
        assert came[2] == ("fleet/blue", False)
        assert watcher.tokens("fleet/*") == ["fleet/red"]


def test_declarations_after_reopening(endpoint: str) -> None:
    with Bus.open(endpoint) as reader, Bus.open(endpoint) as sender:
        got: list[str] = []
        ended = reader.subscribe("fleet/red/**", lambda sample: got.append("ended"))
        ended.undeclare()
        reader.reopen(**QUICK)
        reader.subscribe("fleet/red/**", lambda sample: got.append("new"))
        publisher = sender.publisher(RANGE, TOPIC, "red")

        def put() -> bool:
            publisher.put(pb.Range(range_m=1.0), time.time_ns())
            return bool(got)

        wait_for(put, "it arrives")
        assert set(got) == {"new"}


def test_without_a_hub_the_first_session_goes_on(
    hub: tuple[str, subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, process = hub
    monkeypatch.setattr("schemas.bus.zenoh_session.REOPEN_TIMEOUT_S", 0.2)
    with Bus.open(endpoint) as car:
        before = car.id
        process.kill()
        process.wait()
        wait_for(lambda: not car.connected, "the link is lost")
        with pytest.raises(BusError):
            car.reopen(**QUICK)
        assert car.id == before


def test_twin_is_counted_and_the_older_session_is_deaf_in_the_end() -> None:
    found = Overlap()
    assert [found.is_twin("a", 1.0, newer=side) for side in (False, False, True, True, True)] == [
        False,
        False,
        True,
        True,
        False,
    ]
    assert not found.is_twin("b", 1.0, newer=False)
    found.older_is_deaf = True
    assert found.is_twin("b", 9.0, newer=True), "it came before"
    assert found.is_twin("c", 9.0, newer=False)
    assert not found.is_twin("c", 9.0, newer=True)


def test_equal_query_later_is_no_twin() -> None:
    found = Overlap()
    for _ in range(2):  # before the hub knew the second session
        assert not found.is_twin("stop", 1.0, newer=False, within_s=TWIN_S)
    found.older_is_deaf = True
    assert found.is_twin("stop", 1.0 + TWIN_S, newer=True, within_s=TWIN_S)
    assert not found.is_twin("stop", 1.01 + TWIN_S, newer=True, within_s=TWIN_S)

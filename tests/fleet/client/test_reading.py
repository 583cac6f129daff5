"""Readings made of samples, and the readings that a slow reader of a stream gets."""

import asyncio
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest

from fleet.aio import Watch as AsyncWatch
from fleet.client.reading import READING_QUEUE_LIMIT, Reading, Watch, reading_of
from schemas import messages
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from schemas.local_time import exact

RANGE = "fleet.v1.Range"
KEY = "fleet/red/sensor/range"


def sample(seq: int, payload: bytes | None = None) -> Sample:
    written = pb.Range(seq=seq).SerializeToString() if payload is None else payload
    return Sample(KEY, written, messages.encoding_of(RANGE), 1_700_000_000_000_000_000, seq)


def test_reading_time_is_stamp_or_bus_time() -> None:
    stamped = pb.Range(range_m=0.5)
    stamped.stamp.seconds, stamped.stamp.nanos = 1_600_000_000, 123_456_789
    reading = reading_of(sample(1, stamped.SerializeToString()))
    assert reading.time == datetime.fromtimestamp(1_600_000_000, UTC).replace(microsecond=123_456)
    assert (reading.key, reading.value.range_m) == (KEY, 0.5)
    assert reading_of(sample(1)).time == datetime.fromtimestamp(1_700_000_000, UTC)


def test_reading_repr_has_units_and_unmeasured_fields() -> None:
    at = datetime(2026, 3, 14, 15, 16, 17, 123_456, UTC)
    measured = Reading(KEY, at, pb.Range(range_m=0.25))
    assert (
        repr(measured)
        == f"<fleet/red/sensor/range {exact(round(at.timestamp() * 1e6) * 1000)}: range_m=0.25 m, no_echo=false>"
    )
    nothing = Reading(KEY, at, pb.Range(no_echo=True))
    assert "range_m=not measured, no_echo=true" in repr(nothing)
    rows = re.findall(r"<tr><th[^>]*>(.*?)</th><td[^>]*>(.*?)</td>", nothing._repr_html_())
    assert rows == [("range_m", "<span title='not measured'>\u2014</span>"), ("no_echo", "true")]
    assert "<td style='text-align:left'>0.25 m</td>" in measured._repr_html_()
    hostile = Reading("fleet/red/state/mode", at, pb.Mode(asked="<b>", candidates=["a"]))
    assert "&lt;b&gt;" in hostile._repr_html_()
    assert 'candidates=["a"]' in repr(hostile)
    assert 'rejects={"cut": "2"}' in repr(Reading("fleet/red/state/link", at, pb.Link(rejects={"cut": 2})))


def test_reading_staleness_by_topic_and_never_future() -> None:
    reading = reading_of(sample(1))
    for age_s, stale in ((-5.0, False), (0.0, False), (2.9, False), (3.1, True)):
        now = reading.time + timedelta(seconds=age_s)
        assert (reading.age_s(now), reading.stale(now)) == (max(0.0, age_s), stale)
    event = Reading("fleet/red/event/command", reading.time, reading.value)
    assert not event.stale(reading.time + timedelta(days=1)), "what has happened does not expire"


def test_unmeasured_field_is_left_out_of_reading() -> None:
    assert "range_m" not in reading_of(sample(1)).as_dict()


@pytest.mark.parametrize("encoding", ["", "application/json", "application/protobuf;fleet.v1.Nothing"])
def test_foreign_payload_raises_bad_payload(encoding: str) -> None:
    with pytest.raises((messages.BadPayload, KeyError)):
        reading_of(Sample(KEY, b"", encoding, 0, 0))


def test_slow_reader_loses_oldest_and_learns_count() -> None:
    takes: list[Callable[[Sample], None]] = []

    def subscribe(take: Callable[[Sample], None]) -> Callable[[], object]:
        takes.append(take)
        return takes.clear

    with Watch().begin(subscribe) as readings:
        for seq in range(1, READING_QUEUE_LIMIT + 101):
            takes[0](sample(seq))
        assert readings.dropped == 100
        assert [next(readings).value.seq for _ in range(READING_QUEUE_LIMIT)] == list(
            range(101, READING_QUEUE_LIMIT + 101)
        )
        takes[0](sample(1, b"\xff"))
        takes[0](sample(7))
        assert next(readings).value.seq == 7
        assert (readings.dropped, readings.unreadable) == (100, 1)
    assert takes == [], "closing ends the subscription"
    assert list(readings) == []


async def test_so_does_an_async_reader() -> None:
    readings = AsyncWatch()
    for seq in range(1, READING_QUEUE_LIMIT + 101):
        assert readings.hand_over(sample(seq))
        await asyncio.sleep(0)
    for _ in range(3):
        await asyncio.sleep(0)  # let the loop deliver the last reading
    assert [(await anext(readings)).value.seq for _ in range(READING_QUEUE_LIMIT)] == list(
        range(101, READING_QUEUE_LIMIT + 101)
    )
    assert readings.dropped == 100

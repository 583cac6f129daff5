"""`verify` reports lost, late and duplicate numbers, schemas of other versions, and clocks that jump."""

import random
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import Writer

from fleet.recording.reading.session import Session
from fleet.recording.sequence_tracker import MAX_LISTED_GAPS, PublisherSequence
from fleet.recording.tools.verify import SessionVerdict, verify
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.local_time import exact

START = 1_790_000_000_000_000_000
MS = 1_000_000


class Written:
    """A file that a test writes message by message."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer: Any = Writer(self._file)
        self._writer.start()
        self._ids: dict[str, int] = {}
        self.now = START

    def put(
        self, key: str, seq: int, boot: str = "b1", *, took_ms: int = 1, step_ms: int = 10, schema: bytes | None = None
    ) -> None:
        self.now += step_ms * MS
        if key not in self._ids:
            data = schema or messages.descriptor_set("fleet.v1.Range")
            self._ids[key] = self._writer.register_channel(
                key, "protobuf", self._writer.register_schema("fleet.v1.Range", "protobuf", data)
            )
        payload = pb.Range(car="red", seq=seq, boot_id=boot, range_m=1).SerializeToString()
        self._writer.add_message(self._ids[key], self.now, payload, self.now - took_ms * MS, seq)

    def raw(self, key: str, payload: bytes, sequence: int, *, took_ms: int = 0) -> None:
        self.now += 10 * MS
        if key not in self._ids:
            self._ids[key] = self._writer.register_channel(key, "json", 0)
        self._writer.add_message(self._ids[key], self.now, payload, self.now - took_ms * MS, sequence)

    def verdict(self) -> SessionVerdict:
        self._writer.finish()
        self._file.close()
        return verify(Session(Path(self._file.name)))


@pytest.fixture
def written(tmp_path: Path) -> Written:
    return Written(tmp_path / "x.mcap")


RANGE = "fleet/red/sensor/range"


def gaps(verdict: SessionVerdict) -> list[tuple[str, str, int, int, int]]:
    return [(one["key"], one["publisher"], one["first"], one["last"], one["count"]) for one in verdict.missing]


def test_session_that_lacks_nothing_is_whole(written: Written) -> None:
    for seq in range(1, 50):
        written.put(RANGE, seq)
        written.raw("fleet/note", b"{}", seq)
    verdict = written.verdict()
    assert verdict.whole
    assert (verdict.messages, verdict.missing_count) == (98, 0)
    assert list(verdict.words()) == [
        f"{verdict.session}: whole, 98 messages, {exact(START + 10 * MS)} to {exact(START + 980 * MS)} (1.0s)"
    ]


def test_gap_is_named_with_publisher_numbers_and_time(written: Written) -> None:
    for seq in (5, 6, 9, 10):
        written.put(RANGE, seq)
    for seq in (1, 3):
        written.put(RANGE, seq, "b2")  # the gateway was restarted
    for seq in (1, 2, 5):
        written.raw("fleet/note", b"{}", seq)
    verdict = written.verdict()
    assert gaps(verdict) == [
        ("fleet/note", "", 3, 4, 2),
        (RANGE, "b1", 7, 8, 2),
        (RANGE, "b2", 2, 2, 1),
    ]
    assert not verdict.whole
    assert verdict.missing_count == 5
    assert (verdict.missing[1]["after_ns"], verdict.missing[1]["before_ns"]) == (START + 20 * MS, START + 30 * MS)
    lacks = f"  missing: {RANGE} lacks 2 of publisher b1: "
    (missing,) = (line for line in verdict.words() if line.startswith(lacks))
    assert " 7 to 8, " in missing
    assert missing.endswith(f"{exact(START + 20 * MS)} and {exact(START + 30 * MS)}")


def test_late_message_is_not_missing_and_duplicate_is_told(written: Written) -> None:
    for seq in (3, 4, 8, 6, 5, 7, 2, 1, 9, 9, 4):
        written.put(RANGE, seq)
    verdict = written.verdict()
    assert not verdict.missing
    assert [(one["key"], one["publisher"], one["count"]) for one in verdict.twice] == [(RANGE, "b1", 2)]
    assert not verdict.whole


def test_numbers_that_may_begin_again_are_no_gap(written: Written) -> None:
    for seq in (1, 2, 3, 1, 2, 3, 0, 0):
        written.raw("fleet/note", b"{}", seq)
    assert written.verdict().whole


def test_backfill_from_before_first_message_is_no_restart(written: Written) -> None:
    for seq, took_ms in ((5, 0), (3, 500), (4, 400), (6, 0), (1, 900), (7, 0)):
        written.raw("fleet/note", b"{}", seq, took_ms=took_ms)
    verdict = written.verdict()
    assert gaps(verdict) == [("fleet/note", "", 2, 2, 1)]
    assert not verdict.twice


def test_any_order_and_any_loss_is_counted_right() -> None:
    for seed in range(300):
        chance = random.Random(seed)
        sent = list(range(1, chance.randint(2, 60)))
        kept = [number for number in sent if chance.random() < 0.8] or sent
        twice = [chance.choice(kept) for _ in range(chance.randint(0, 3))]
        chance.shuffle(heard := kept + twice)
        stream = PublisherSequence()
        for at, number in enumerate(heard):
            stream.add(number, at, number)
        assert stream.missing == max(kept) - min(kept) + 1 - len(kept), seed
        assert stream.duplicates == len(twice), seed
        listed = {number for gap in stream.gaps for number in range(gap.first, gap.last + 1)}
        assert listed == set(range(min(kept), max(kept))) - set(kept), seed


def test_more_gaps_than_are_listed_are_counted() -> None:
    stream = PublisherSequence()
    for number in range(1, 4 * MAX_LISTED_GAPS, 2):
        stream.add(number, number, number)
    assert len(stream.gaps) == MAX_LISTED_GAPS
    assert stream.missing == 2 * MAX_LISTED_GAPS - 1


def test_clocks_that_are_wrong_are_said_and_make_nothing_missing(written: Written) -> None:
    for seq in range(1, 5):
        written.put(RANGE, seq)
        written.put("fleet/blue/sensor/range", seq, took_ms=-2000)
        written.put("fleet/green/sensor/range", seq, took_ms=1 + (seq == 3) * 700)
    written.put(RANGE, 5, step_ms=-5000, took_ms=1)
    verdict = written.verdict()
    assert verdict.whole
    clocks = {line.split("'")[0].split()[-1]: line for line in verdict.words() if "clock: " in line}
    assert f" 5.000 s at {exact(START - 4_880 * MS)}" in clocks["recorder"]
    assert " 2.000 s ahead " in clocks["blue"]
    assert " 1 times, by 0.670 s " in clocks["green"]
    assert " 1 times" in clocks["red"]
    assert (verdict.first_ns, verdict.last_ns) == (START - 4880 * MS, START + 120 * MS)


def changed(fields: int) -> bytes:
    """Return today's schema of a range, with an unknown field and without the last one."""
    files = FileDescriptorSet.FromString(messages.descriptor_set("fleet.v1.Range"))
    message = next(one for file in files.file for one in file.message_type if one.name == "Range")
    del message.field[-1]
    message.field.add(name="sonar_c", number=77, type=1, label=1)
    return files.SerializeToString()


def test_schema_of_another_version_and_invalid_schema_are_told(written: Written) -> None:
    written.put(RANGE, 1, schema=changed(1))
    verdict = written.verdict()
    assert verdict.schemas == {"fleet.v1.Range": "has more: sonar_c; lacks: no_echo"}
    assert verdict.whole


def test_schema_that_makes_no_sense_is_said(written: Written) -> None:
    written.put(RANGE, 1, schema=b"\xff\xff")
    written.put(RANGE, 2)
    verdict = written.verdict()
    assert list(verdict.schemas) == ["fleet.v1.Range"]
    assert "stay bytes" in verdict.schemas["fleet.v1.Range"]
    assert verdict.messages == 2

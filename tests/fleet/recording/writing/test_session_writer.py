"""Rollover of files by size and time, of sessions by size, the quota, and clocks that go back. Without a bus."""

import json
import os
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from fleet.quota import Quota
from fleet.recording import session_dir
from fleet.recording.reading.session import Session
from fleet.recording.selection import EVERYTHING
from fleet.recording.sequence_tracker import MAX_TRACKED_SOURCES
from fleet.recording.session_dir import SessionInfo
from fleet.recording.time_spec import format_utc
from fleet.recording.tools.merge_cut_recover import cut
from fleet.recording.tools.summary import SessionState, of_session
from fleet.recording.tools.verify import verify
from fleet.recording.writing.disk_space import MB
from fleet.recording.writing.session_writer import Options, SessionWriter, Sync
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb

BEGUN_NS = 1_790_000_000_000_000_000
SECOND_NS = 1_000_000_000
JSON = zenoh.Encoding("application/json")
RANGE_KEY = "fleet/red/sensor/range"


def alone() -> zenoh.Config:
    """Return the configuration of a session that looks for no other."""
    settings = {"scouting": {"multicast": {"enabled": False}}, "timestamping": {"enabled": True}}
    return zenoh.Config.from_json5(json.dumps(settings))


def feed(tape: SessionWriter, at_ns: int, count: int = 10, size: int = 1000) -> None:
    for number in range(count):
        tape.add("fleet/red/note", os.urandom(size).hex().encode(), JSON, None, None, at_ns + number)


def payloads(paths: Iterable[Path]) -> int:
    return sum(message.key == "fleet/red/note" for path in paths for message in Session(path).messages())


@pytest.mark.parametrize("sync", list(Sync))
def test_writer_segment_ends_at_size_and_none_is_empty(tmp_path: Path, sync: Sync) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(segment_bytes=100_000, sync=sync), BEGUN_NS)
    for second in range(20):
        feed(tape, BEGUN_NS + second * SECOND_NS, count=20)
        tape.tick(BEGUN_NS + second * SECOND_NS)
    tape.close(BEGUN_NS + 20 * SECOND_NS)
    session = Session(tape.path)
    assert 3 < len(session.segments) == tape.segments < 10
    assert all(segment.stat().st_size < 200_000 for segment in session.segments)
    verdict = verify(session)
    assert verdict.whole, list(verdict.words())
    assert verdict.messages == tape.messages == 400
    assert tape.bytes == sum(segment.stat().st_size for segment in session.segments)


def test_file_ends_at_its_time(tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(segment_s=5.0), BEGUN_NS)
    for second in range(12):
        feed(tape, BEGUN_NS + second * SECOND_NS)
        tape.tick(BEGUN_NS + second * SECOND_NS)
    tape.close(BEGUN_NS + 12 * SECOND_NS)
    assert tape.segments == 3
    assert verify(Session(tape.path)).whole


def test_index_says_what_each_file_has(tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(segment_s=5.0), BEGUN_NS)
    for second in range(12):
        feed(tape, BEGUN_NS + second * SECOND_NS)
        tape.tick(BEGUN_NS + second * SECOND_NS)
    tape.close(BEGUN_NS + 12 * SECOND_NS)
    found = json.loads((tape.path / session_dir.INDEX_FILE).read_text())["segments"]
    assert [one["file"] for one in found] == [path.name for path in Session(tape.path).segments]
    assert [one["bytes"] for one in found] == [path.stat().st_size for path in Session(tape.path).segments]
    for one in found:
        rows = [(m.recorded_ns, m.key) for m in Session(tape.path / one["file"]).messages()]
        assert (one["first_ns"], one["last_ns"]) == (rows[0][0], rows[-1][0])
        assert one["messages"] == one["keys"]["fleet/red/note"]["count"] == len(rows)


def test_clock_that_goes_back_loses_nothing_and_is_told(tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    for second in (0, 1, 2, -3600, -3599):
        feed(tape, BEGUN_NS + second * SECOND_NS)
        tape.tick(BEGUN_NS + second * SECOND_NS)
    tape.close(BEGUN_NS - 3598 * SECOND_NS)
    verdict = verify(Session(tape.path))
    assert verdict.whole
    assert verdict.messages == 50
    assert [round(one["step_s"]) for one in verdict.backwards] == [3602]
    (one,) = json.loads((tape.path / session_dir.INDEX_FILE).read_text())["segments"]
    assert (one["first_ns"], one["last_ns"]) == (BEGUN_NS - 3600 * SECOND_NS, BEGUN_NS + 2 * SECOND_NS + 9)


def test_session_that_lacks_messages_is_whole_to_nobody(tmp_path: Path) -> None:
    """`fleet sessions` called it whole, while `fleet sessions verify` said NOT whole, with exit code 1."""
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    feed(tape, BEGUN_NS)
    tape.drop_received("fleet/red/note", None, 0, 3)
    tape.close(BEGUN_NS + SECOND_NS)
    session = Session(tape.path)
    about = of_session(session)
    assert (about.state, about.lost) == (SessionState.GAPS, 3)
    assert about.words.startswith("3 messages were lost: `fleet sessions verify ")
    assert not verify(session).whole


def test_messages_that_waited_for_backfilled_ones_are_no_step_of_the_clock(tmp_path: Path) -> None:
    """`fleet sessions verify` and `doctor` said after each restart of a recorder that its clock had gone back."""
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    for at_ns in (0, SECOND_NS, SECOND_NS - 40_000_000):
        feed(tape, BEGUN_NS + at_ns)
    tape.close(BEGUN_NS + 2 * SECOND_NS)
    assert verify(Session(tape.path)).backwards == []


def test_session_that_has_enough_says_so(tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(quota=Quota(session=100_000)), BEGUN_NS)
    feed(tape, BEGUN_NS)
    tape.tick(BEGUN_NS)
    assert not tape.over
    feed(tape, BEGUN_NS, count=200)
    tape.tick(BEGUN_NS)
    assert tape.over
    tape.close(BEGUN_NS)


@pytest.mark.parametrize("limit", [Quota(session=100_000), Quota(MB)])
def test_session_that_has_enough_begins_no_other_file(limit: Quota, tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(segment_bytes=100_000, quota=limit), BEGUN_NS)
    feed(tape, BEGUN_NS, count=200)
    tape.tick(BEGUN_NS)
    assert tape.over
    tape.close(BEGUN_NS)
    assert [path.name for path in sorted(tape.path.glob("*.mcap"))] == ["0001.mcap"]
    assert verify(Session(tape.path)).whole


def session(root: Path, number: int, *, closed: bool = True) -> Path:
    """Write a session of half a megabyte, an hour after the one before."""
    now = BEGUN_NS + number * 3600 * SECOND_NS
    tape = SessionWriter(root, "fleet", Options(), now)
    feed(tape, now, count=400)
    tape.tick(now)
    if closed:
        tape.close(now)
    return tape.path


def test_quota_removes_oldest_unmarked_sessions_only(tmp_path: Path) -> None:
    paths = [session(tmp_path, number) for number in range(6)]
    marked = SessionInfo.read(paths[1])
    assert marked is not None
    marked.kept = True
    marked.write(paths[1])
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_bytes(b"x" * MB)
    one = sum(path.stat().st_size for path in paths[0].iterdir())
    tape = SessionWriter(tmp_path, "fleet", Options(quota=Quota(4 * one)), BEGUN_NS + 7 * 3600 * SECOND_NS)
    tape.tick(BEGUN_NS + 7 * 3600 * SECOND_NS)
    assert len(tape.quota_news) == 3
    assert not tape.warning
    assert (tmp_path / "notes" / "mine.txt").exists()
    assert [path.exists() for path in paths] == [False, True, False, False, True, True]
    tape.close(BEGUN_NS + 7 * 3600 * SECOND_NS)


def test_quota_exceeded_by_marked_sessions_is_told(tmp_path: Path) -> None:
    tape = SessionWriter(tmp_path, "fleet", Options(quota=Quota(100_000)), BEGUN_NS)
    tape.mark("keep this", "me", BEGUN_NS)
    feed(tape, BEGUN_NS, count=400)
    tape.tick(BEGUN_NS)
    tape.close(BEGUN_NS)
    after = SessionWriter(tmp_path, "fleet", Options(quota=Quota(100_000)), BEGUN_NS + SECOND_NS)
    after.tick(BEGUN_NS + SECOND_NS)
    assert "has more than its quota, by 0." in after.warning
    assert "MB that are marked, pinned, in use or not to be removed" in after.warning
    assert after.quota_news == []
    after.close(BEGUN_NS + SECOND_NS)
    assert payloads([tape.path]) == 400


def test_files_are_copied_into_each_session(tmp_path: Path) -> None:
    plan = tmp_path / "my.yaml"
    plan.write_text("roles: {}\n")
    tape = SessionWriter(tmp_path / "out", "fleet", Options(copied={session_dir.PLAN_FILE: plan}), BEGUN_NS)
    tape.close(BEGUN_NS)
    assert (tape.path / "plan.yaml").read_text() == "roles: {}\n"
    plan.unlink()
    after = SessionWriter(
        tmp_path / "out", "fleet", Options(copied={session_dir.PLAN_FILE: plan}), BEGUN_NS + SECOND_NS
    )
    assert after.uncopied == [f"{plan} could not be copied into {after.path}: No such file or directory"]
    after.close(BEGUN_NS + SECOND_NS)
    assert verify(Session(after.path)).whole


def test_gap_of_a_sender_begins_at_its_own_last_message(tmp_path: Path) -> None:
    """While two sites are cut off from each other, the recorder of each publishes the status of the fleet."""
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    with zenoh.open(alone()) as one:
        senders = [one.declare_publisher("fleet/@recorder/status").id for _ in range(2)]
    assert senders[0].eid != senders[1].eid
    for second, (sender, number) in enumerate([(0, 1), (1, 1), (1, 2), (1, 3), (0, 4), (1, 5)]):
        source = zenoh.SourceInfo(senders[sender], number)
        tape.add("fleet/@recorder/status", b"{}", JSON, None, source, BEGUN_NS + second * SECOND_NS)
        gaps = dict(tape.gaps)
        if second == 4:
            assert gaps == {"fleet/@recorder/status": BEGUN_NS}
            tape.gaps.clear()
    assert gaps == {"fleet/@recorder/status": BEGUN_NS + 3 * SECOND_NS}
    assert tape.missed == {"fleet/@recorder/status": 3}
    tape.close(BEGUN_NS + 9 * SECOND_NS)


@pytest.mark.parametrize("interrupted", [False, True])
def test_first_event_of_a_car_that_answered_at_once_asks_for_its_key_alone(interrupted: bool, tmp_path: Path) -> None:
    """The first stop of all cars, half an hour later, called up all that all cars had cached, twice."""
    if interrupted:
        killed = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS - 5 * SECOND_NS)
        assert killed._segment is not None
        killed._segment.cut()
        os.utime(session_dir.segment(killed.path, 1), ns=(BEGUN_NS, BEGUN_NS))
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    assert bool(tape.description.continues) is interrupted
    with zenoh.open(alone()) as red, zenoh.open(alone()) as blue:
        state, *events = (each.declare_publisher("fleet/note").id for each in (red, red, blue))
        stamp = red.new_timestamp()
    source = zenoh.SourceInfo(state, 7)
    tape.add("fleet/red/state/link", b"{}", JSON, None, source, BEGUN_NS + SECOND_NS // 2)
    assert tape.newcomers == ({"fleet/red/state/link": "fleet/red"} if interrupted else {})
    tape.newcomers.clear()
    answer: Any = SimpleNamespace(
        key_expr="fleet/red/state/link", payload=zenoh.ZBytes(b"{}"), encoding=JSON, timestamp=stamp, source_info=source
    )
    assert not tape.add_backfilled(answer, BEGUN_NS + SECOND_NS, is_of_all=True)
    after = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS + SECOND_NS, after=tape)
    tape.close(BEGUN_NS + SECOND_NS)
    for car, sender in zip(("red", "blue"), events, strict=True):
        source = zenoh.SourceInfo(sender, 4)
        after.add(f"fleet/{car}/event/command", b"{}", JSON, None, source, BEGUN_NS + 1800 * SECOND_NS)
    asked = {"fleet/red/event/command": "fleet/red/event/command", "fleet/blue/event/command": "fleet/blue"}
    assert after.newcomers == asked
    after.close(BEGUN_NS + 1801 * SECOND_NS)


def test_senders_that_share_a_key_are_new_only_once(tmp_path: Path) -> None:
    """With more senders than are remembered, the recorder asked again and again, and wrote each answer again."""
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    with zenoh.open(alone()) as one:
        senders = [one.declare_publisher("fleet/note").id for _ in range(MAX_TRACKED_SOURCES + 2)]
    for turn in (1, 2, 3):
        for sender in senders:
            source = zenoh.SourceInfo(sender, turn)
            tape.add("fleet/note", b"{}", JSON, None, source, BEGUN_NS + 10 * SECOND_NS)
        assert bool(tape.newcomers) is (turn == 1)
        tape.newcomers.clear()
    tape.close(BEGUN_NS + 11 * SECOND_NS)


def published(count: int) -> list[zenoh.Sample]:
    """Return samples of one publisher, numbered from 1."""
    samples: list[zenoh.Sample] = []
    with zenoh.open(alone()) as one, one.declare_subscriber("fleet/red/note") as subscriber:
        out = one.declare_publisher("fleet/red/note", encoding=JSON)
        for number in range(count):
            out.put(str(number + 1), source_info=zenoh.SourceInfo(out.id, number))
            samples.append(subscriber.recv())
    return samples


def numbers(path: Path) -> list[int]:
    return [message.sequence for message in Session(path).messages()]


def test_next_session_notices_what_is_lost_between_two(tmp_path: Path) -> None:
    samples = published(6)
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    for at in (0, 2):
        tape.add("fleet/red/note", b"{}", JSON, samples[at].timestamp, samples[at].source_info, BEGUN_NS)
    after = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS + SECOND_NS, after=tape)
    assert after.gaps == {"fleet/red/note": BEGUN_NS}, "the gap of the first session is still requested"
    after.gaps.clear()
    last = samples[5]
    after.add("fleet/red/note", b"{}", JSON, last.timestamp, last.source_info, BEGUN_NS + 2 * SECOND_NS)
    assert after.gaps == {"fleet/red/note": BEGUN_NS}
    assert (tape.missed, after.missed) == ({"fleet/red/note": 1}, {"fleet/red/note": 2})
    tape.close(BEGUN_NS + 2 * SECOND_NS)
    assert [after.add_backfilled(each, BEGUN_NS) for each in samples] == [False, True, False, True, True, False]
    assert after.missed == {}
    assert after.recovered == {"fleet/red/note": 3}
    after.close(BEGUN_NS + 9 * SECOND_NS)
    assert (numbers(tape.path), numbers(after.path)) == ([1, 3], [6, 2, 4, 5])
    assert after.description.continues == tape.path.name


@pytest.mark.parametrize("other", ["cut", "renamed", "of the future", "without a time"])
def test_interrupted_session_is_continued_whatever_lies_beside_it(tmp_path: Path, other: str) -> None:
    """One `fleet sessions cut --out sessions/part`, and no recorder ever continued an interrupted session again."""
    now_ns = time.time_ns()
    closed = SessionWriter(tmp_path, "fleet", Options(), now_ns - 60 * SECOND_NS)
    feed(closed, now_ns - 60 * SECOND_NS)
    closed.close(now_ns - 59 * SECOND_NS)
    info = SessionInfo.read(closed.path)
    assert info is not None
    if other == "cut":
        cut(Session(closed.path), tmp_path / "part", EVERYTHING)
    elif other == "of the future":
        replace(info, started=format_utc(datetime(2099, 1, 1, tzinfo=UTC))).write(closed.path)
    elif other == "without a time":
        replace(info, started="yesterday").write(closed.path)
    closed.path.rename(tmp_path / "zoo")
    killed = SessionWriter(tmp_path, "fleet", Options(), now_ns - SECOND_NS)
    feed(killed, now_ns - SECOND_NS)
    killed.tick(now_ns)
    after = SessionWriter(tmp_path, "fleet", Options(), now_ns)
    for tape in (killed, after):
        tape.close(now_ns)
    assert after.description.continues == killed.path.name


def test_message_of_a_slow_clock_closes_its_gap(tmp_path: Path) -> None:
    first, second, third = published(3)
    assert first.timestamp is not None
    late_ns = first.timestamp.get_time_as_ntp64().as_nanos() + 3600 * SECOND_NS
    tape = SessionWriter(tmp_path / "late", "fleet", Options(), late_ns)
    for each in (first, third):
        tape.add("fleet/red/note", b"{}", JSON, each.timestamp, each.source_info, late_ns)
    assert tape.missed == {"fleet/red/note": 1}
    assert tape.add_backfilled(second, late_ns)
    assert not tape.add_backfilled(second, late_ns)
    assert not tape.add_backfilled(first, late_ns)
    assert tape.missed == {}
    tape.close(late_ns)


def readings(count: int) -> list[zenoh.Sample]:
    """Return readings of one gateway, numbered from 1, as its cache has them."""
    samples: list[zenoh.Sample] = []
    encoding = zenoh.Encoding(messages.encoding_of("fleet.v1.Range"))
    with zenoh.open(alone()) as one, one.declare_subscriber(RANGE_KEY) as subscriber:
        out = one.declare_publisher(RANGE_KEY, encoding=encoding)
        for number in range(count):
            reading = pb.Range(car="red", boot_id="one start", seq=number + 1, range_m=1.0)
            out.put(reading.SerializeToString(), source_info=zenoh.SourceInfo(out.id, number))
            samples.append(subscriber.recv())
    return samples


def hear(tape: SessionWriter, sample: zenoh.Sample, stamp: zenoh.Timestamp | None, received_ns: int) -> None:
    """Add a message as it was heard. Zenoh replaces the time of a fast clock, which the publisher's cache keeps."""
    tape.add(RANGE_KEY, sample.payload.to_bytes(), sample.encoding, stamp, sample.source_info, received_ns)


def test_message_of_a_fast_clock_is_not_written_again_when_it_arrives(tmp_path: Path) -> None:
    """Every hub that ended made the messages of a gateway whose clock is a second ahead appear twice."""
    cached = readings(5)
    tape = SessionWriter(tmp_path, "fleet", Options(), BEGUN_NS)
    hear(tape, cached[0], cached[1].timestamp, BEGUN_NS)
    assert all(tape.add_backfilled(each, BEGUN_NS) for each in cached[1:4])
    for each in cached[1:]:
        hear(tape, each, cached[0].timestamp, BEGUN_NS + SECOND_NS)
    tape.close(BEGUN_NS + SECOND_NS)
    assert numbers(tape.path) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("behind_s", [0, 3600])
def test_next_session_takes_what_the_interrupted_one_lacks_whatever_the_clock(tmp_path: Path, behind_s: int) -> None:
    """The messages of a slow clock were lost between two sessions, and those of a fast clock were in both."""
    cached = readings(6)
    assert cached[0].timestamp is not None
    began_ns = cached[0].timestamp.get_time_as_ntp64().as_nanos() + behind_s * SECOND_NS
    killed = SessionWriter(tmp_path, "fleet", Options(), began_ns - SECOND_NS // 100)
    for each in cached[1:4]:
        hear(killed, each, each.timestamp if behind_s else cached[0].timestamp, began_ns)
    killed.tick(began_ns)
    os.utime(killed.path / "0001.mcap", ns=(began_ns, began_ns))
    after = SessionWriter(tmp_path, "fleet", Options(), began_ns + SECOND_NS)
    assert after.description.continues == killed.path.name
    assert [after.add_backfilled(each, began_ns + SECOND_NS) for each in cached[1:]] == [False] * 3 + [True] * 2
    for tape in (killed, after):
        tape.close(began_ns + SECOND_NS)
    assert sorted(numbers(killed.path) + numbers(after.path)) == [2, 3, 4, 5, 6]


def test_message_of_a_slow_clock_before_the_interrupted_session_is_in_none(tmp_path: Path) -> None:
    early, first = readings(1), readings(1)
    (began,) = (each.timestamp for each in first)
    assert began is not None
    began_ns = began.get_time_as_ntp64().as_nanos() + 3600 * SECOND_NS
    killed = SessionWriter(tmp_path, "fleet", Options(), began_ns)
    hear(killed, first[0], began, began_ns)
    killed.tick(began_ns)
    os.utime(killed.path / "0001.mcap", ns=(began_ns, began_ns))
    after = SessionWriter(tmp_path, "fleet", Options(), began_ns + SECOND_NS)
    assert not after.add_backfilled(early[0], began_ns + SECOND_NS)
    for tape in (killed, after):
        tape.close(began_ns + SECOND_NS)

"""Several recordings of one fleet as one: everything once, in order, and what is lost of one is named."""

import random
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest
from click.testing import CliRunner

from fleet.cli import cli
from fleet.recording import session_dir, time_spec
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import EVERYTHING, Selection
from fleet.recording.tools.merge_cut_recover import Exists, cut, merge
from fleet.recording.tools.summary import SessionState, of_session
from fleet.recording.tools.verify import verify
from tests.fleet.replay.make_session import make


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Return a session of some minutes."""
    directory = tmp_path_factory.mktemp("whole")
    count = make(directory / "0001.mcap").total()
    session_dir.SessionInfo("fleet", "2026-11-26T09:00:00Z", "", {}, closed=True, messages=count).write(directory)
    return Session(directory)


def part_of(
    session: Session,
    out: Path,
    rows: list[Row],
    drops: Mapping[str, int] = MappingProxyType({}),
    missed: Mapping[str, int] = MappingProxyType({}),
) -> Session:
    """Write a session of some of its messages, with what its recorder has dropped and missed, by key."""
    out.mkdir()
    with McapCopy(session_dir.segment(out, 1)) as copy:
        for row in rows:
            copy.add(row)
    assert session.description is not None
    first, last = (time_spec.iso(rows[at][2]) for at in (0, -1))
    info = session_dir.SessionInfo(session.description.fleet, first, "", {}, ended=last, closed=True)
    info.messages, info.drops, info.missed = len(rows), dict(drops), dict(missed)
    info.marks = [{"time": session.description.started, "text": out.name, "by": "ann"}]
    info.write(out)
    return Session(out)


def told(session: Session) -> Counter[tuple[str, int, int, bytes]]:
    return Counter((row[0].channel.topic, row[1], row[3], row[4]) for row in session.rows())


@pytest.mark.parametrize("seed", range(5))
def test_two_halves_with_something_in_common_are_the_whole(seed: int, whole: Session, tmp_path: Path) -> None:
    chance, rows = random.Random(seed), sorted(whole.rows(), key=lambda row: row[2])
    where = [chance.choice(("one", "other", "both")) for _ in rows]
    halves = [
        part_of(whole, tmp_path / name, [row for row, each in zip(rows, where, strict=True) if each in (name, "both")])
        for name in ("one", "other")
    ]
    count, twice, lost = merge(halves, tmp_path / "out")
    made = Session(tmp_path / "out")
    assert (count, lost) == (len(rows), "")
    assert twice == where.count("both")
    assert told(made) == told(whole)
    times = [row[2] for row in made.rows()]
    assert times == sorted(times)
    assert made.description is not None
    assert made.description.closed
    assert made.description.messages == count
    assert {mark["text"] for mark in made.description.marks} == {"one", "other"}
    assert made.description.origin["by"] == "merge"


def test_message_that_two_recorders_gave_different_times_is_written_once(whole: Session, tmp_path: Path) -> None:
    """If the clock of a car is half a second ahead, Zenoh replaces its publish times at each receiver."""
    rows = sorted(whole.rows(), key=lambda row: row[2])
    other = [(info, number, log_ns, publish_ns + 1000, payload) for info, number, log_ns, publish_ns, payload in rows]
    parts = [part_of(whole, tmp_path / "one", rows), part_of(whole, tmp_path / "two", other)]
    count, twice, lost = merge(parts, tmp_path / "both")
    named = sum(bool(row[1]) and row[0].schema is not None for row in rows)
    assert named
    assert (count, twice, lost) == (2 * len(rows) - named, named, "")


def test_merge_names_what_damaged_session_lost(whole: Session, tmp_path: Path) -> None:
    rows = list(whole.rows())
    one, other = (part_of(whole, tmp_path / name, rows[at::2]) for at, name in enumerate(("one", "other")))
    segment = session_dir.segment(one.path, 1)
    data = segment.read_bytes()
    segment.write_bytes(data[: len(data) // 4])
    count, _, lost = merge([Session(one.path), other], tmp_path / "out")
    assert len(rows) // 2 <= count < len(rows)
    assert lost.startswith("one: ")
    made = Session(tmp_path / "out").description
    assert made is not None
    assert "one: " in made.origin["lost"]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize(
    ("has", "drops", "missed"),
    [("all", 0, 0), ("the lost ones too late", 1, 2), ("half of the time", 1, 2), ("one of the lost ones", 0, 2)],
)
def test_losses_remain_only_if_no_recorder_has_the_messages(
    has: str, drops: int, missed: int, order: tuple[int, int], whole: Session, tmp_path: Path
) -> None:
    """One recorder dropped the first of three messages, and missed the others."""
    rows = sorted(whole.rows(), key=lambda row: row[2])
    key = rows[len(rows) // 4][0].channel.topic
    lost = [row for row in rows if row[0].channel.topic == key][-4:-1]
    end_ns = rows[-1][2]
    late = [(info, number, log_ns + end_ns, publish_ns, data) for info, number, log_ns, publish_ns, data in rows]
    others = {
        "all": rows,
        "the lost ones too late": late,
        "half of the time": rows[: len(rows) // 2],
        "one of the lost ones": [row for row in rows if row not in lost[1:]],
    }
    parts = [
        part_of(whole, tmp_path / "a", [row for row in rows if row not in lost], drops={key: 1}, missed={key: 2}),
        part_of(whole, tmp_path / "b", others[has]),
    ]
    merge([parts[at] for at in order], tmp_path / "out")
    made = Session(tmp_path / "out").description
    assert made is not None
    assert (made.drops.get(key, 0), made.missed.get(key, 0)) == (drops, missed)


def test_losses_of_two_recorders_of_one_time_count_once(whole: Session, tmp_path: Path) -> None:
    rows = sorted(whole.rows(), key=lambda row: row[2])
    key = rows[len(rows) // 4][0].channel.topic
    lost = [row for row in rows if row[0].channel.topic == key][-3:-1]
    there = [row for row in rows if row not in lost]
    day_ns = 86_400_000_000_000
    later = [(info, number, log_ns + day_ns, publish_ns, data) for info, number, log_ns, publish_ns, data in there]
    both = [part_of(whole, tmp_path / name, there, missed={key: 2}) for name in ("a", "b")]
    third = part_of(whole, tmp_path / "c", later, missed={key: 2})
    merge(both, tmp_path / "two")
    merge([*both, third], tmp_path / "three")
    halves = [
        part_of(whole, tmp_path / name, part, missed={key: 2}) for name, part in (("d", there[:40]), ("e", there[60:]))
    ]
    middle = part_of(whole, tmp_path / "f", there[30:70], missed={key: 3})
    merge([halves[0], middle, halves[1]], tmp_path / "chain")
    found = [Session(tmp_path / name).description for name in ("two", "three", "chain")]
    assert [each and each.missed for each in found] == [{key: 2}, {key: 4}, {key: 4}]


def test_part_has_only_losses_that_may_be_in_it(whole: Session, tmp_path: Path) -> None:
    rows = sorted(whole.rows(), key=lambda row: row[2])
    counts = {"fleet/red/sensor/line": 2, "fleet/green/sensor/line": 3}
    lossy = part_of(whole, tmp_path / "a", rows, missed=counts, drops=counts)
    cut(lossy, tmp_path / "time", Selection(None, rows[1][2], None))
    cut(lossy, tmp_path / "car", EVERYTHING, ["red"])
    found = [session_dir.SessionInfo.read(tmp_path / name) for name in ("time", "car")]
    of_red = {"fleet/red/sensor/line": 2}
    assert [each and (each.missed, each.drops) for each in found] == [({}, {}), (of_red, of_red)]


def test_part_counts_the_messages_that_a_backfill_brought_after_it(whole: Session, tmp_path: Path) -> None:
    """`fleet sessions` called such a part whole, and `fleet sessions verify` listed what it lacks."""
    rows = sorted(whole.rows(), key=lambda row: row[2])
    key = rows[len(rows) // 2][0].channel.topic
    late = [row for row in rows if row[0].channel.topic == key][1:3]
    end_ns = rows[-1][2] + 1_000_000_000
    moved = [(info, number, end_ns, publish_ns, data) for info, number, _, publish_ns, data in late]
    session = part_of(whole, tmp_path / "a", [*(row for row in rows if row not in late), *moved])
    assert session.description is not None
    session.description.recovered = {key: 2}
    bounds = (None, end_ns), (end_ns, None)
    parts = []
    for name, (start, end) in zip(("first", "second"), bounds, strict=True):
        cut(session, tmp_path / name, Selection(None, start, end))
        parts.append(Session(tmp_path / name))
    found = [(of_session(each).state, verify(each).missing_count, verify(each).missed) for each in parts]
    assert found == [(SessionState.GAPS, 2, {key: 2}), (SessionState.WHOLE, 0, {})]
    assert [each.description and each.description.recovered for each in parts] == [{}, {}]
    merge(parts, tmp_path / "both")
    assert of_session(Session(tmp_path / "both")).state is SessionState.WHOLE


@pytest.mark.parametrize("lost", [0, 1])
def test_what_the_next_session_has_fetched_is_not_lost(lost: int, whole: Session, tmp_path: Path) -> None:
    """A recorder failed, and the next one fetched what it had dropped: merged, all was there and counted as dropped."""
    rows = sorted(whole.rows(), key=lambda row: row[2])
    key = rows[len(rows) // 2][0].channel.topic
    late = [row for row in rows if row[0].channel.topic == key][1:4]
    half_ns = rows[len(rows) // 2][2]
    assert late[-1][2] < half_ns
    before = [row for row in rows if row[2] < half_ns and row not in late]
    fetched = [(info, number, half_ns, publish_ns, data) for info, number, _, publish_ns, data in late[lost:]]
    after = [*fetched, *(row for row in rows if row[2] >= half_ns)]
    failed = part_of(whole, tmp_path / "failed", before, drops={key: 2}, missed={key: 1})
    following = part_of(whole, tmp_path / "following", after)
    assert following.description is not None
    following.description.continues = failed.name
    following.description.write(following.path)
    merge([failed, Session(following.path)], tmp_path / "both")
    found = of_session(Session(tmp_path / "both"))
    assert (found.lost, verify(Session(tmp_path / "both")).missing_count) == (lost, lost)


def test_sessions_of_two_fleets_are_refused(whole: Session, tmp_path: Path) -> None:
    cut(whole, tmp_path / "other", EVERYTHING)
    info = session_dir.SessionInfo.read(tmp_path / "other")
    assert info is not None
    info.fleet = "lions"
    info.write(tmp_path / "other")
    with pytest.raises(NoSession, match="lions"):
        merge([whole, Session(tmp_path / "other")], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(whole: Session, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(Exists):
        merge([whole, whole], tmp_path / "out")


def test_command(whole: Session, tmp_path: Path) -> None:
    cut(whole, tmp_path / "again", EVERYTHING)
    arguments = ["sessions", "merge", str(whole.path), str(tmp_path / "again"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    assert told(Session(tmp_path / "out")) == told(whole)
    assert CliRunner().invoke(cli, ["sessions", "verify", str(tmp_path / "out")]).exit_code == 0
    assert CliRunner().invoke(cli, [*arguments[:3], str(whole.path), *arguments[4:]]).exit_code == 2

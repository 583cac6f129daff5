"""Several recordings of one fleet as one: everything once, in order, and what is lost of one is named."""

import random
from collections import Counter
from pathlib import Path

import pytest
from click.testing import CliRunner

from fleet.cli import cli
from fleet.recording import session_dir
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import EVERYTHING
from fleet.recording.tools.merge_cut_recover import Exists, cut, merge
from tests.fleet.replay.make_session import make


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Return a session of some minutes."""
    directory = tmp_path_factory.mktemp("whole")
    count = make(directory / "0001.mcap").total()
    session_dir.SessionInfo("fleet", "2026-11-26T09:00:00Z", "", {}, closed=True, messages=count).write(directory)
    return Session(directory)


def part_of(session: Session, out: Path, rows: list[Row]) -> Session:
    """Write a session of some of its messages."""
    out.mkdir()
    with McapCopy(session_dir.segment(out, 1)) as copy:
        for row in rows:
            copy.add(row)
    assert session.description is not None
    info = session_dir.SessionInfo(session.description.fleet, session.description.started, "", {}, closed=True)
    info.messages = len(rows)
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

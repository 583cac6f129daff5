"""`recover`, `cut` and `rescue` copy attachments and metadata, and say which are lost."""

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType

from fleet.recording.reading.session import Session
from fleet.recording.selection import Selection
from fleet.recording.tools.merge_cut_recover import cut, recover
from tests.support.random_session import RANGE, START_NS, Mixed

ABOUT = {"robot": "ann", "ROS_DISTRO": "jazzy"}
PICTURE = bytes(range(256)) * 8


def write(path: Path, **options: Any) -> None:
    """Write a file of another program, with an attachment and metadata between its messages."""
    made = Mixed(path, **options)
    made.own(RANGE, 2)
    made.writer.add_metadata("rosbag2", ABOUT)
    made.own(RANGE, 2)
    made.writer.add_attachment(5, 6, "floor.png", "image/png", PICTURE)
    made.own(RANGE)
    made.close()


def found_in(path: Path) -> tuple[list[Any], list[Any]]:
    """Return the metadata and attachments, read by the mcap library."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        named = [(each.name, dict(each.metadata)) for each in reader.iter_metadata() if each.name != "session"]
        kept = [
            (one.name, one.media_type, one.create_time, one.log_time, one.data) for one in reader.iter_attachments()
        ]
    return named, kept


WHOLE = ([("rosbag2", ABOUT)], [("floor.png", "image/png", 5, 6, PICTURE)])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"index_types": IndexType.CHUNK},
    ],
)
def test_recover_cut_and_rescue_keep_attachments_and_metadata(tmp_path: Path, options: dict[str, Any]) -> None:
    write(path := tmp_path / "x.mcap", **options)
    assert recover(Session(path), tmp_path / "recovered") == (5, "")
    assert found_in(tmp_path / "recovered" / "0001.mcap") == WHOLE
    assert cut(Session(path), tmp_path / "part", Selection(None, None, START_NS + 2_000_000)) == 1
    assert found_in(tmp_path / "part" / "0001.mcap") == WHOLE
    Session(path).rescue(tmp_path / "rescued.mcap")
    assert found_in(tmp_path / "rescued.mcap") == WHOLE


def test_copy_of_a_copy_has_each_once(tmp_path: Path) -> None:
    write(tmp_path / "0001.mcap")
    write(tmp_path / "0002.mcap")
    recover(Session(tmp_path), tmp_path / "once")
    recover(Session(tmp_path / "once"), tmp_path / "twice")
    assert found_in(tmp_path / "twice" / "0001.mcap") == WHOLE


def test_cut_file_keeps_what_is_whole(tmp_path: Path) -> None:
    write(path := tmp_path / "x.mcap", chunk_size=1)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(PICTURE) + len(PICTURE) + 4])
    count, _ = recover(Session(path), tmp_path / "recovered")
    assert count == 4
    assert found_in(tmp_path / "recovered" / "0001.mcap") == WHOLE


def test_damaged_attachment_is_named_and_not_copied(tmp_path: Path) -> None:
    write(path := tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    data[data.index(PICTURE) + 3] ^= 1
    path.write_bytes(data)
    session = Session(path)
    count, words = recover(session, tmp_path / "recovered")
    assert (count, found_in(tmp_path / "recovered" / "0001.mcap")) == (5, (WHOLE[0], []))
    assert str(path) in words
    session.check()
    assert path in session.damage

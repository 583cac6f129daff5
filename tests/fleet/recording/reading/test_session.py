"""The files of a session, and faults of the whole session. test_mcap_reader.py tests damage within a file."""

import io
import os
from pathlib import Path

import pytest
from mcap.writer import Writer

from fleet.recording.left_out import LeftOutCause
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.analysis import NoTable
from tests.support.random_session import RANGE, Mixed


def mcap(*sequences: int) -> bytes:
    """Return a whole file with messages of these numbers."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    channel = writer.register_channel("fleet/red/x", "json", 0)
    for sequence in sequences:
        writer.add_message(channel, sequence, b"{}", sequence, sequence)
    writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
    return out.getvalue()


def test_file_that_is_none_hides_no_other(tmp_path: Path) -> None:
    (tmp_path / "0001.mcap").write_bytes(mcap(1, 2))
    (tmp_path / "0002.mcap").write_bytes(b"")
    (tmp_path / "0003.mcap").mkdir()
    (tmp_path / "0005.mcap").write_bytes(mcap(3)[:-20])
    session = Session(tmp_path)
    assert [message.sequence for message in session.messages()] == [1, 2, 3]
    rescued = session.rescue(tmp_path / "rescued.mcap")
    assert [message.sequence for message in rescued.messages()] == [1, 2, 3]
    rescued.check()
    assert not rescued.damage
    words = session.damage_words
    assert "\n" not in words
    for part in (
        "0002.mcap is empty",
        "0003.mcap is not a regular file",
        "lacks 1 of its files, the first is 0004.mcap",
    ):
        assert part in words
    assert f"{tmp_path / '0005.mcap'} is cut" in words
    assert "0001.mcap" not in words


def test_session_without_whole_part_is_refused_with_cause(tmp_path: Path) -> None:
    (tmp_path / "0001.mcap").write_bytes(mcap(1)[:40])
    with pytest.raises(NoSession, match=r"has no intact message: .*0001\.mcap is cut .*: byte 8: "):
        Session(tmp_path).rescue(tmp_path / "rescued.mcap")


WRONG = [
    f'{{"fleet": "f", "started": "", "host": "", "versions": {{}}, {more}}}'
    for more in (
        '"drops": 7',
        '"missed": {"a": "b"}',
        '"marks": [1]',
        '"marks": [{"time": 5}]',
        '"pins": [{"from": [], "to": ""}]',
        '"ended": 5',
        '"origin": []',
        '"messages": "x"',
    )
]
DEEP = "[" * 200_000


@pytest.mark.parametrize(
    "text", ["", "[]", "null", "7", '{"format": "2"}', '{"format": null}', "\0", '{"fleet": 1}', DEEP, *WRONG]
)
def test_description_that_cannot_be_read_hides_no_message(tmp_path: Path, text: str) -> None:
    (tmp_path / "0001.mcap").write_bytes(mcap(1))
    (tmp_path / "session.json").write_text(text)
    session = Session(tmp_path)
    assert session.description is None
    assert [message.sequence for message in session.messages()] == [1]


def test_description_that_is_a_device_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "0001.mcap").write_bytes(mcap(1))
    os.mkfifo(tmp_path / "session.json")
    assert Session(tmp_path).description is None


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "There is no session at"), (b"", "is empty"), (b"not an mcap file", "is not an MCAP file")],
)
def test_no_session_error_names_path_and_reason(content: bytes | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "0001.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(NoSession, match=words) as caught:
        Session(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_empty_directory_and_a_newer_format_are_refused(tmp_path: Path) -> None:
    with pytest.raises(NoSession, match=r"no 0001\.mcap"):
        Session(tmp_path)
    (tmp_path / "0001.mcap").write_bytes(mcap(1))
    (tmp_path / "session.json").write_text(
        '{"fleet": "fleet", "started": "", "host": "", "versions": {}, "format": 99}'
    )
    with pytest.raises(NoSession, match=r"format 99.*update zenoh-car-fleet.* as .*0001\.mcap"):
        Session(tmp_path)
    # A description of a later format is not read, either.
    (tmp_path / "session.json").write_text('{"format": 99, "messages": {"red": 3}}')
    with pytest.raises(NoSession, match="format 99"):
        Session(tmp_path)
    assert len([*Session(tmp_path / "0001.mcap").messages()]) == 1


def test_unknown_session_name_suggests_likely_one(tmp_path: Path) -> None:
    (tmp_path / "0001.mcap").write_bytes(mcap(1, 2))
    session = Session(tmp_path / "0001.mcap")
    with pytest.raises(NoTable, match=r"has no messages of sensor/rnge\. Did you mean sensor/range"):
        session.messages("sensor/rnge")
    with pytest.raises(NoTable, match=r"has no messages of red/sensor/rnge\."):
        session.messages("red/sensor/rnge", decode=True)
    assert len(list(session.messages("fleet/red/x"))) == 2, "recorded, but not ours"
    for none in ("sensor/range", "red/sensor/range", "Range", "blue/**", "*/x/y"):
        assert list(session.messages(none)) == [], none
    (tmp_path / "0002.mcap").write_bytes(mcap(3)[:-20])
    assert list(Session(tmp_path).messages("sensor/rnge")) == [], "without an index it is not known"


def test_undecodable_messages_are_counted_by_cause(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "0001.mcap")
    made.own(RANGE, 3)
    made.put(RANGE, "fleet.v1.Range", b"\xff")
    made.put(RANGE, "", b"{}", "json")
    made.close()
    session = Session(path)
    for _ in range(2):
        assert len(list(session.messages(decode=True))) == 3
        assert session.left_out.counts == {(RANGE, LeftOutCause.UNREADABLE): 1, (RANGE, LeftOutCause.NOT_PROTOBUF): 1}

"""`info` and `verify` say the same of a file, whatever its writer left out of its index."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap.writer import IndexType

from fleet.cli import cli
from fleet.commands.sessions import sessions
from fleet.recording.reading.session import Session
from fleet.recording.tools.summary import SessionState, of_session
from fleet.recording.tools.verify import verify
from tests.support.random_session import LOG, RANGE, START_NS, Mixed

WRITERS: list[dict[str, Any]] = [
    {},
    {"repeat_channels": False},
    {"repeat_schemas": False},
    {"use_statistics": False},
    {"use_summary_offsets": False},
    {"index_types": IndexType.NONE},
    {"use_chunking": False},
    {"enable_crcs": False},
]


def write(path: Path, **options: Any) -> Path:
    made = Mixed(path, **options)
    made.own(RANGE, 10)
    made.close()
    return path


def asked(command: str, path: Path) -> tuple[int, dict[str, Any]]:
    result = CliRunner().invoke(sessions, [command, str(path), "--json"])
    return result.exit_code, json.loads(result.stdout)


@pytest.mark.parametrize("options", WRITERS)
def test_file_without_an_index_is_whole(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path / "x.mcap", **options)
    (code, info), (verified, verdict) = asked("info", path), asked("verify", path)
    assert (code, info["state"], info["messages"], info["keys"]) == (0, SessionState.WHOLE, 10, {RANGE: 10})
    assert (verified, verdict["whole"], verdict["messages"]) == (0, True, 10)


@pytest.mark.parametrize("options", WRITERS)
def test_cut_file_is_cut_for_both(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path / "x.mcap", chunk_size=100, **options)
    path.write_bytes(path.read_bytes()[:-9])
    session = Session(path)
    assert of_session(session).state is SessionState.CUT
    assert not verify(session).whole
    assert path in session.unended


@pytest.mark.parametrize("options", WRITERS)
def test_bytes_after_the_end_are_not_a_cut(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path / "x.mcap", **options)
    path.write_bytes(path.read_bytes() + b"\0" * 5)
    session = Session(path)
    about = of_session(session)
    verdict = verify(session)
    assert (about.state, about.messages) == (SessionState.DAMAGED, 10)
    assert (verdict.whole, verdict.messages) == (False, 10)
    assert not session.unended


def test_statistics_that_differ_from_the_file_are_named(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    made.own(RANGE, 10)
    made.writer._Writer__statistics.message_count += 2
    made.close()
    session = Session(path)
    verdict = verify(session)
    assert (verdict.messages, set(verdict.damage)) == (10, {"x.mcap"})
    assert of_session(session).messages == 10, "its counts by channel contradict the sum, so it is read"


def test_exit_codes_say_whether_anything_was_read(tmp_path: Path) -> None:
    made = Mixed(nothing := tmp_path / "nothing.mcap")
    made.close()
    lost = write(tmp_path / "lost.mcap")
    lost.write_bytes(lost.read_bytes()[:40])
    for path in (nothing, lost):
        result = CliRunner().invoke(sessions, ["export", str(path), "--csv", str(tmp_path / "out")])
        assert (result.exit_code, (tmp_path / "out").exists()) == (1, False), path
    assert CliRunner().invoke(sessions, ["info", str(lost)]).exit_code == 1
    assert CliRunner().invoke(sessions, ["info", str(nothing)]).exit_code == 0, "it is whole"
    some = write(tmp_path / "some.mcap", chunk_size=1)
    some.write_bytes(some.read_bytes()[:-300])
    assert CliRunner().invoke(sessions, ["info", str(some)]).exit_code == 0


def test_words_of_a_message_reach_the_terminal_escaped(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    log: Any = Log(message="\x1b]0;pwn\x07", name="red \x9b2J")
    log.timestamp.FromNanoseconds(START_NS)
    made.put(LOG, "foxglove.Log", log.SerializeToString())
    made.close()
    result = CliRunner().invoke(cli, ["why", "red", "--session", str(path), "--at", "0s"])
    assert result.exit_code == 0, result.output
    assert all(each.isprintable() or each == "\n" for each in result.output)
    assert "pwn" in result.output


def test_nothing_of_a_file_reaches_the_terminal_raw(tmp_path: Path) -> None:
    endless = "fleet/red/" + "x" * 5000
    made = Mixed(path := tmp_path / "x.mcap")
    for key in ("fleet/red/\x1b]0;pwn\x07x", "fleet/\x9b2Jred/x", endless):
        for sequence in (1, 5):
            made.counts[key] = sequence - 1
            made.put(key, "\x1b[31mJ", b"{}", "json")
            made.put(key, "fleet.v1.Range", b"\xff")
    made.close()
    for command in (["info"], ["verify"], ["export", "--csv", str(tmp_path / "csv")], ["list", str(tmp_path)]):
        arguments = command if command[0] == "list" else [command[0], str(path), *command[1:]]
        result = CliRunner().invoke(sessions, arguments)
        assert all(each.isprintable() or each == "\n" for each in result.output), command
        assert max(map(len, result.output.splitlines())) < 500, command

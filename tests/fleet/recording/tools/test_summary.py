"""Summaries of unusual sessions: made of others, empty at their end, or with a clock that went back."""

import itertools
import json
import os
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from msgspec.structs import replace

from fleet.cli import cli
from fleet.recording import session_dir
from fleet.recording.reading.session import Session
from fleet.recording.tools.summary import SessionState, SessionSummary, growth_check, overview
from fleet.recording.writing.segment_writer import Segment
from tests.support.text_parts import has_parts

START = 1_790_000_000_000_000_000
S = 1_000_000_000


def write(path: Path, at_s: list[list[float]], *, closed: bool = True, cut: bool = True) -> Segment:
    """Write a session with one chunk per list. Its segment has an end if `closed`."""
    path.mkdir(parents=True, exist_ok=True)
    segment = Segment(path / "0001.mcap", {})
    channel = segment.channel("fleet/red/x", "application/json")
    numbers = itertools.count(1)
    for chunk in at_s:
        for at in chunk:
            ns = START + int(at * S)
            segment.add(channel, ns, b"{}" * 100, ns, next(numbers))
        segment.flush()
    if closed:
        segment.finish({})
    elif cut:
        segment.cut()
    count = sum(map(len, at_s))
    session_dir.SessionInfo("fleet", "2026-09-21T14:13:20Z", "here", {}, closed=closed, messages=count).write(path)
    return segment


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["sessions", *map(str, arguments)])


def test_recovered_session_says_how_much_is_missing(tmp_path: Path) -> None:
    old, new, again = tmp_path / "old", tmp_path / "new", tmp_path / "again"
    write(old, [[1, 2], [3, 4, 5], [6]])
    data = bytearray((old / "0001.mcap").read_bytes())
    index = Session(old).indexes()[old / "0001.mcap"]
    assert index is not None
    place = index.chunks[1]
    data[place.at + place.length - 2] ^= 1
    (old / "0001.mcap").write_bytes(data)
    assert run("recover", old, "--out", new).exit_code == 0
    assert run("recover", new, "--out", again).exit_code == 0  # a second recovery changes nothing
    for path in (new, again):
        result = run("verify", path)
        assert result.exit_code == 1
        assert "NOT whole" in result.output
        assert "3 messages are missing" in result.output
        found = overview(path)
        assert (found.state, found.lost) == (SessionState.RECOVERED, 3)
        assert "3 messages are missing" in found.words


def test_recovered_session_without_loss_is_whole(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    write(old, [[1, 2], [3]])
    (old / "0001.mcap").write_bytes((old / "0001.mcap").read_bytes()[:-8])
    assert run("recover", old, "--out", new).exit_code == 0
    assert overview(new).state is SessionState.WHOLE
    assert run("verify", new).exit_code == 0


def test_file_in_which_nothing_was_recorded_cuts_no_session(tmp_path: Path) -> None:
    path = tmp_path / "s"
    write(path, [[1, 2], [3]])
    Segment(path / "0002.mcap", {}).finish({})
    found = overview(path)
    assert (found.state, found.words, found.length_s) == (SessionState.WHOLE, "", 2.0)


def end(path: Path, **fields: object) -> SessionSummary:
    """Return the summary of a session that was last written a minute ago, with these fields in its description."""
    info = session_dir.SessionInfo.read(path)
    assert info is not None
    replace(info, **fields).write(path)
    os.utime(path / "0001.mcap", (time.time() - 60, time.time() - 60))
    return overview(path)


@pytest.mark.parametrize("has_messages", [False, True])
def test_repair_is_proposed_only_where_there_is_a_message(tmp_path: Path, has_messages: bool) -> None:
    write(tmp_path / "one", [[1, 2]] if has_messages else [], closed=False)
    killed, ended = end(tmp_path / "one"), end(tmp_path / "one", closed=True)
    assert (killed.state, ended.state) == (SessionState.CUT, SessionState.CUT)
    for found in (killed, ended):
        assert ("fleet sessions recover" in found.words) == has_messages, found.words
    assert (run("recover", tmp_path / "one").exit_code == 0) == has_messages


def test_session_that_dropped_everything_lacks_messages(tmp_path: Path) -> None:
    write(tmp_path, [], closed=False)
    found = end(tmp_path, closed=True, drops={"fleet/red/x": 45})
    assert (found.state, found.lost) == (SessionState.GAPS, 45)
    assert "45 messages were lost" in found.words
    assert run("info", tmp_path).exit_code == 1


def test_recorder_killed_in_a_pause_is_not_said_to_wait(tmp_path: Path) -> None:
    write(tmp_path, [[1, 2]], closed=False)
    found = end(tmp_path, error="disk: No space left on device. Recording pauses until there is room.")
    assert has_parts(found.words, "the recorder did not close it … No space left … fleet sessions recover"), found
    failed = end(tmp_path, error="recording failed: Input/output error", ended="2026-09-21T14:14:00Z")
    assert failed.words == "recording failed: Input/output error"


def test_clock_that_went_back_makes_no_hour(tmp_path: Path) -> None:
    times: tuple[list[list[float]], ...] = (
        [[0, 1], [2, 3], [-3596, -3595], [-3594]],
        [[0, 1], [2, 3, -3596.5], [-3595.5], [-3594.5]],
    )
    for number, at_s in enumerate(times):
        for closed in (True, False):
            path = tmp_path / f"{number}{closed}"
            write(path, at_s, closed=closed)
            found = overview(path)
            assert found.length_s == 5.0, at_s
            assert found.clock_back_s in (3599.0, 3599.5)
    assert "the recorder's clock went back by 3599.0 s" in run("info", tmp_path / "0True").output


def test_session_being_recorded_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "s"
    segment = write(path, [[1, 2]], closed=False, cut=False)
    ended = threading.Event()

    def record() -> None:
        at_ns = START + 3 * S
        while not ended.wait(0.02):
            at_ns += 1
            segment.add(1, at_ns, b"{}", at_ns, 0)
            segment.flush()

    recorder = threading.Thread(target=record)
    recorder.start()
    try:
        result = run("verify", path)
    finally:
        ended.set()
        recorder.join()
        segment.cut()
    assert "is being recorded, nothing is missing so far" in result.output
    assert "damage" not in result.output
    assert result.exit_code == 0
    assert not growth_check(Session(path))()
    killed = run("verify", path)
    assert killed.exit_code == 1
    assert "the recorder did not close it" in killed.output
    assert json.loads(run("verify", path, "--json").output)["recording"] is False

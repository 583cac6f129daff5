"""The command `fleet sessions`: every subcommand, and all kinds of wrong arguments."""

import csv
import json
import random
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from fleet.recording import session_dir, time_spec
from fleet.recording.reading.mcap_scan import MAGIC
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.merge_cut_recover import recover
from fleet.recording.tools.verify import verify
from schemas.local_time import of_iso
from tests.fleet.recording.damaged import Original, written
from tests.fleet.recording.tools import every_type
from tests.support import in_process


def fleet(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `fleet sessions`. Return its exit code and output, and check that it prints no traceback."""
    done = in_process.fleet("sessions", *arguments, cwd=cwd)
    assert "Traceback" not in done.stderr, done.stderr
    return done


def describe(path: Path, **more: object) -> None:
    values = {"fleet": "fleet", "started": "2026-09-21T14:13:20Z", "host": "here", "versions": {"python": "3"}, **more}
    (path / "session.json").write_text(json.dumps(values))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "all" / "20260921T141320Z-fleet"
    path.mkdir(parents=True)
    every_type.make(path / "0001.mcap")
    describe(path, closed=True, marks=[{"time": "2026-09-21T14:13:21Z", "text": "here it slips", "by": "ann"}])
    (path / "fleet.yaml").write_text("cars: {}\n")
    return path


def test_session_list_shows_state_of_each(session: Path) -> None:
    root = session.parent
    for name, closed in (("cut", False), ("damaged", True), ("newer", True)):
        shutil.copytree(session, root / name)
        describe(root / name, closed=closed, ended="" if closed else "2026-09-21T14:14:00Z", drops={"fleet/red/x": 3})
    (root / "damaged" / "0002.mcap").write_bytes(b"")
    describe(root / "newer", format=99)
    (root / "empty").mkdir()
    (root / "foreign.mcap").write_bytes((session / "0001.mcap").read_bytes())
    (root / "notes.txt").write_text("no session")
    done = fleet(root, "--json")
    assert done.returncode == 0
    found = {one["name"]: one for one in map(json.loads, done.stdout.splitlines())}
    states = {name: one["state"] for name, one in found.items()}
    assert states == {
        session.name: "whole",
        "cut": "cut",
        "damaged": "damaged",
        "newer": "unreadable",
        "foreign": "whole",
    }
    assert found[session.name]["cars"] == ["red"]
    assert found[session.name]["messages"] == 4 * len(every_type.keys_and_types())
    assert found["cut"]["lost"] == 3
    assert "format 99" in found["newer"]["words"]
    assert found["newer"]["bytes"] == (session / "0001.mcap").stat().st_size
    listed = fleet(root)
    assert {line.partition(": ")[0] for line in listed.stderr.splitlines()} == {"cut", "damaged", "newer"}
    lines = listed.stdout.splitlines()
    assert " ".join(lines[0].split()) == "session start state length size messages lost stops marks cars"
    assert len(lines) == 6
    then = of_iso("2026-09-21T14:13:20Z").split()[1]
    ran = {json.loads(line)["name"] for line in fleet("at", then, root, "--json").stdout.splitlines()}
    assert ran == {name for name, one in found.items() if one["messages"]}
    never = fleet("at", "2020-01-01 12:00", root)
    assert (never.returncode, never.stdout) == (1, "")
    assert fleet("at", "90s", root).returncode == 2
    assert fleet("at", "soon", cwd=root.parent).returncode == 2
    nothing = fleet(cwd=root.parent)
    assert (nothing.returncode, nothing.stdout) == (0, "")
    assert "(in sessions)" in nothing.stderr
    root.rename(root.parent / "sessions")
    assert session.name in fleet(cwd=root.parent).stdout


@pytest.mark.parametrize("name", ["my lesson", "-v", "$(date); x"])
def test_proposed_command_opens_a_session_of_any_name(session: Path, name: str) -> None:
    """The name stood there without quotes, for a shell to carry out what is in it."""
    root = session.parents[1]
    session.parent.rename(root / "sessions")
    (root / "sessions" / session.name).rename(root / "sessions" / name)
    then = of_iso("2026-09-21T14:13:20Z").split()[1]
    for directory in ((), (root / "sessions",), ("sessions",)):
        _, proposed, _ = fleet("at", then, *directory, cwd=root).stderr.splitlines()[-1].split("`")
        words = shlex.split(proposed)
        assert words[:2] == ["fleet", "replay"]
        assert not words[2].startswith("-")
        assert fleet("info", words[2], cwd=root).stdout.startswith(name)


@pytest.mark.parametrize("seed", range(12))
def test_session_list_includes_damaged_sessions(seed: int, session: Path) -> None:
    rng = random.Random(seed)
    data, about = (session / "0001.mcap").read_bytes(), (session / "session.json").read_bytes()
    for number in range(8):
        path = session.with_name(f"damaged{number}")
        shutil.copytree(session, path)
        name, whole = rng.choice([("0001.mcap", data), ("session.json", about)])
        broken = bytearray(whole[: rng.randrange(len(whole))] if rng.random() < 0.5 else whole)
        for _ in range(rng.randrange(1, 40)):
            if broken:
                broken[rng.randrange(len(broken))] = rng.randrange(256)
        (path / name).write_bytes(broken)
    found = {one["name"]: one for one in map(json.loads, fleet(session.parent, "--json").stdout.splitlines())}
    assert len(found) == 9
    assert all(one["words"] for one in found.values() if one["state"] != "whole")
    assert (found[session.name]["state"], found[session.name]["stops"]) == ("whole", 0)
    assert len(fleet(session.parent).stdout.splitlines()) == 10


def test_info_has_versions_keys_and_marks(session: Path) -> None:
    words = fleet("info", session).stdout
    assert f"mark: {of_iso('2026-09-21T14:13:21Z')} 'here it slips' by ann" in words
    assert "recorded on here; python 3" in words
    assert "fleet/@coordinator/decision" in words
    about = json.loads(fleet("info", session, "--json").stdout)
    assert about["keys"]["fleet/red/@cmd/drive"] == every_type.EACH


def test_cut_part_is_session_of_its_own(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "part"
    done = fleet("cut", session, "--from", "50ms", "--to=-20ms", "--car", "red", "--out", out)
    assert done.returncode == 0, done.stderr
    expected = [
        one
        for one in Session(session).messages()
        if one.recorded_ns >= 1_790_000_000_001_000_001 + 50_000_000
        and one.recorded_ns < 1_790_000_000_000_000_000 + len(every_type.keys_and_types()) * 4 * 1_000_001 - 20_000_000
    ]
    assert expected
    assert list(Session(out).messages()) == expected
    assert (out / "fleet.yaml").exists()
    assert "cut of 20260921T141320Z-fleet" in fleet("info", out).stdout
    with (out / "0001.mcap").open("rb") as file:  # mcap's reader accepts the file
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(expected)
    again = fleet("cut", session, "--out", out)
    assert (again.returncode, "already exists" in again.stderr) == (2, True)
    began = of_iso("2026-09-21T14:13:20Z")
    for arguments, words in (
        (("--from", "1h"), "is outside the session"),
        (("--from", "2s", "--to", "1s"), "is not before"),
        (("--from", "soon"), f"is not a time. Write {time_spec.RULE}. The session is from {began} to "),
        (("--from", "12:34"), "are written as 12m34s"),
        (("--car", "pink"), "pink is not in"),
        (("--to", "2026-09-21T14:13:19Z"), "is outside the session"),
    ):
        wrong = fleet("cut", session, *arguments, "--out", tmp_path / "other")
        assert (wrong.returncode, words in wrong.stderr) == (2, True), wrong.stderr
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(("at", "words"), [("soon", "is not a time. Write "), ("2026-09-21T14:14:00Z", "it is from ")])
def test_why_refuses_a_time_that_is_not_in_the_session(at: str, words: str, session: Path) -> None:
    done = in_process.fleet("why", "red", "--session", session, "--at", at)
    assert done.returncode == 2
    assert words in done.stderr
    assert f"from {of_iso('2026-09-21T14:13:20Z')} to " in done.stderr


def test_files_that_went_are_told_also_the_last(session: Path) -> None:
    shutil.copy(session / "0001.mcap", session / "0002.mcap")
    each = 4 * len(every_type.keys_and_types())
    describe(session, closed=True, messages=2 * each)
    assert f"NOT whole, {2 * each} messages" in fleet("verify", session).stdout  # the second file repeats all messages
    (session / "0002.mcap").unlink()
    told = f"session.json says that there were {2 * each} messages: {each} are not here"
    assert told in fleet("verify", session).stdout
    assert told in fleet(session.parent).stderr
    noted = [{"file": name} for name in ("0001.mcap", "0002.mcap", "../x.mcap", 3)]
    (session / "index.json").write_text(json.dumps({"segments": noted}))
    assert "lacks 1 of its files, " in fleet("verify", session).stdout
    assert "0002.mcap" in fleet("verify", session).stdout
    assert "; lost: " in fleet("recover", session).stdout
    for text in ("[]", '{"segments": 3}', "{", '{"segments": [3]}'):
        (session / "index.json").write_text(text)  # only a cache
        assert told in fleet("verify", session).stdout


@pytest.mark.parametrize("text", [None, "", '{"fleet": 3}'])
def test_missing_session_description_is_reported(session: Path, text: str | None) -> None:
    (session / "session.json").unlink()
    if text is not None:
        (session / "session.json").write_text(text)
    broken = fleet("verify", session)
    assert broken.returncode == 1
    assert "damage: session.json " in broken.stdout
    told = fleet("info", session).stdout.splitlines()[0]
    assert told.startswith(f"{session.name}: damaged (session.json ")
    assert f"{session.name}: session.json is missing" in fleet(session.parent).stderr
    assert f"{session.name}: " in in_process.fleet("find", "range_m < 0.3", session.parent).stderr
    assert fleet("recover", session).returncode == 0
    assert session_dir.SessionInfo.read(session.with_name(f"{session.name}-recovered")) is not None


def test_truncated_session_is_recovered(session: Path, tmp_path: Path) -> None:
    path = session / "0001.mcap"
    path.write_bytes(path.read_bytes()[:-8])
    describe(session)
    broken = fleet("verify", session)
    assert broken.returncode == 1
    assert "0001.mcap is cut" in broken.stdout
    assert "not close it" in broken.stdout
    done = fleet("recover", session)
    out = session.with_name(f"{session.name}-recovered")
    assert done.returncode == 0
    assert "; lost: " in done.stdout
    assert list(Session(out).messages()) == list(Session(session).messages())
    description = session_dir.SessionInfo.read(out)
    assert description is not None
    assert description.closed
    assert description.origin["by"] == "recover"
    assert "is cut" in description.origin["lost"]
    assert "recover of" in fleet("info", out).stdout
    verdict = json.loads(fleet("verify", out, "--json").stdout)
    assert (verdict["damage"], verdict["closed"]) == ({}, True)


@pytest.mark.parametrize(
    ("content", "words"), [(None, "no 0001.mcap in it"), (b"", "is empty"), (b"a picture", "is not an MCAP file")]
)
@pytest.mark.parametrize("command", ["info", "verify", "recover", "export", "cut"])
def test_sessions_commands_refuse_no_session_in_one_line(
    command: str, content: bytes | None, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "x"
    path.mkdir()
    if content is not None:
        (path / "0001.mcap").write_bytes(content)
    more = {"export": ["--csv", tmp_path / "out"], "cut": ["--out", tmp_path / "out"]}.get(command, [])
    done = fleet(command, path, *more)
    assert done.returncode == 1
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(one.name for one in tmp_path.iterdir()) == ["x"]


def test_foreign_recording_is_shown_and_exported(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"float64 x")
        ros = writer.register_channel("/imu/data", "cdr", schema)
        note = writer.register_channel("/note", "json", 0)
        for number in range(10):
            writer.add_message(ros, number, bytes([0xFF, number]), number, number)
            writer.add_message(note, number, b'{"a": "x,\\"y"}', number, number)
        writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
    assert fleet("verify", path).returncode == 0
    assert "/imu/data" in fleet("info", path).stdout
    done = fleet("export", path, "--csv", tmp_path / "csv")
    assert "20 messages in 1 tables" in done.stdout
    with (tmp_path / "csv" / "other.csv").open(newline="") as rows:
        found = list(csv.DictReader(rows))
    assert [row["data"] for row in found if row["key"] == "/imu/data"] == [f"ff{number:02x}" for number in range(10)]
    assert {row["text"] for row in found if row["key"] == "/note"} == {'{"a": "x,\\"y"}'}


def test_undecodable_messages_are_kept_as_bytes(session: Path, tmp_path: Path) -> None:
    (session / "0001.mcap").unlink()
    original = written(session / "0001.mcap")
    source = Session(session)
    out = tmp_path / "bent.mcap"
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for lane, sequence, log_ns, publish_ns, data in source.rows():
            schema = lane.schema
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema is not None else 0
            channel = writer.register_channel(lane.channel.topic, lane.channel.message_encoding, schema_id)
            bent = b"\xff\xff" if schema is not None and log_ns % 4 == 0 else data
            writer.add_message(channel, log_ns, bent, publish_ns, sequence)
        writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
    done = fleet("export", out, "--csv", tmp_path / "csv")
    assert f"{len(original.messages)} messages" in done.stdout
    assert "their schema" in done.stderr
    assert fleet("verify", out).returncode == 1


def test_parquet_without_its_package_says_how_to_have_it(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from click.testing import CliRunner

    from fleet.cli import cli

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = CliRunner().invoke(cli, ["sessions", "export", str(session), "--parquet", str(tmp_path / "p")])
    assert done.exit_code == 1
    assert "pip install 'zenoh-car-fleet[analysis]'" in done.output
    assert not (tmp_path / "p").exists()


def test_unwritable_output_is_one_line(session: Path, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    for command, option in (("export", "--csv"), ("export", "--parquet"), ("cut", "--out"), ("recover", "--out")):
        done = fleet(command, session, option, blocked / "out")
        assert done.returncode == 1
        assert "cannot be written" in done.stderr
        assert done.stderr.count("\n") == 1
    assert fleet("export", session).returncode == 2


def test_interrupted_recover_leaves_no_partial_output(session: Path, tmp_path: Path) -> None:
    def interrupted(rows: object) -> object:
        yield from list(rows)[:50]  # type: ignore[call-overload]  # any iterable
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recover(Session(session), tmp_path / "out", interrupted)  # type: ignore[arg-type]  # the same
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all"]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    return written(tmp_path_factory.mktemp("original") / "0001.mcap")


@given(data=st.data())
@settings(max_examples=150)
def test_cut_or_damaged_anywhere_every_whole_chunk_is_recovered(
    original: Original, tmp_path: Path, data: st.DataObject
) -> None:
    whole = original.data
    at = data.draw(st.integers(0, len(whole) - 1))
    broken = whole[:at] if data.draw(st.booleans()) else whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]
    path, out = tmp_path / "x", tmp_path / "out"
    for old in (path, out):
        shutil.rmtree(old, ignore_errors=True)
    path.mkdir()
    (path / "0001.mcap").write_bytes(broken)
    if at < len(MAGIC) and len(broken) < len(whole):
        with pytest.raises(NoSession, match=re.escape(str(path))):
            Session(path)
        return
    session = Session(path)
    verdict = verify(session)
    if not verdict.messages:
        assert at < original.chunks[0][1]
        with pytest.raises(NoSession, match=re.escape(str(path))):
            recover(session, out)
        return
    count, words = recover(session, out)
    assert not verdict.whole
    recovered = Session(out)
    recovered.check()
    assert not recovered.damage
    shown = list(recovered.messages())
    assert len(shown) == count
    hit = {
        number
        for number, (begin, end) in enumerate(original.chunks)
        if end > at and (begin <= at or len(broken) < len(whole))
    }
    assert [one for one in original.messages if original.chunk_of(one) not in hit] == [
        one for one in shown if original.chunk_of(one) not in hit
    ]
    assert count == len(original.messages) or words

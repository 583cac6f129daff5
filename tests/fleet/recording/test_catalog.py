"""Questions in SQL to all sessions, and the tables that are kept beside them."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer

from fleet import Catalog
from fleet.commands.output import MAX_CELL
from fleet.quota import Quota
from fleet.recording.catalog import BadQuery, QueryFailed, view_name
from fleet.recording.left_out import LeftOutCause
from fleet.recording.reading.session import NoSession
from fleet.recording.session_dir import TABLES_PREFIX, SessionInfo
from fleet.recording.tools import table_cache
from fleet.recording.tools.table_cache import STALE_PART_S, tables_of
from fleet.recording.writing.quota_removal import enforce
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb
from schemas.keys import name_of
from schemas.topics import TOPICS
from tests.fleet.replay.make_session import START_NS, Made
from tests.support import in_process
from tests.support.disk import MAY_MOUNT, disk
from tests.support.no_superuser import no_superuser
from tests.support.processes import wait_for
from tests.support.soaks import only_in_soak
from tests.support.terminal import Terminal
from tests.support.text_parts import has_parts

OLD_SESSION = Path(__file__).parents[2] / "vectors" / "session-0.1"


def make(path: Path, car: str, distances: list[float]) -> None:
    """Make a session: one distance a second, in tracking from the third second on, driven by ann."""
    path.mkdir()
    SessionInfo("fleet", "2026-01-01T00:00:00Z", "h", {}, closed=True).write(path)
    made = Made(path / "0001.mcap", Writer)
    for second, distance in enumerate(distances):
        made.put(f"fleet/{car}/state/mode", pb.Mode(asked="tracking" if second >= 2 else "manual"), second)
        made.put(f"fleet/{car}/state/motion", pb.Motion(motion="forward", owner=f"ann@desk-{second}"), second)
        made.put(
            f"fleet/{car}/state/safety", pb.Safety(motors="on", lease=pb.Lease(holder=f"ann@desk-{second}")), second
        )
        made.put(f"fleet/{car}/sensor/range", pb.Range(range_m=distance), second + 0.1)
    made.put(f"fleet/{car}/sensor/range", pb.Range(range_m=9.0), 60)
    made.close()


@pytest.fixture
def sessions(tmp_path: Path) -> Path:
    place = tmp_path / "sessions"
    place.mkdir()
    make(place / "one", "red", [1.0, 0.5, 0.25])
    make(place / "two", "blue", [2.0, 3.0])
    return place


def asked(sessions: Path, sql: str) -> list[dict[str, object]]:
    """Return the rows of an answer."""
    return list(Catalog(sessions).query(sql).to_pylist())


def test_query_reaches_every_session_and_names_it(sessions: Path) -> None:
    rows = asked(
        sessions, "SELECT session, car, count(*) n, min(range_m) nearest FROM sensor_range GROUP BY ALL ORDER BY 1"
    )
    assert rows == [
        {"session": "one", "car": "red", "n": 4, "nearest": 0.25},
        {"session": "two", "car": "blue", "n": 3, "nearest": 2.0},
    ]


def test_context_is_of_that_moment_and_stale_states_do_not_count(sessions: Path) -> None:
    rows = asked(
        sessions,
        "SELECT range_m, mode, motion, owner, driver FROM sensor_range_context WHERE car = 'red' ORDER BY publish_time",
    )
    driven = {"motion": "forward", "owner": "ann", "driver": "ann"}
    assert rows[0] == {"range_m": 1.0, "mode": "manual", **driven}
    assert rows[2] == {"range_m": 0.25, "mode": "tracking", **driven}
    assert rows[3] == {"range_m": 9.0, "mode": None, **dict.fromkeys(driven)}, "57 s later nothing is known"


def test_driver_column_names_person_without_process(sessions: Path) -> None:
    for column in ("driver", "owner"):
        rows = asked(
            sessions, f"SELECT {column}, count(*) n FROM sensor_range_context WHERE mode = 'manual' GROUP BY ALL"
        )
        assert rows == [{column: "ann", "n": 4}], "each drive is of another process"


def test_person_of_sender_in_sql_is_name_of(sessions: Path) -> None:
    catalog = Catalog(sessions)
    for sender in ("tom@vm-535", "tom", "tom@a@b", "@vm-535", "Zoë@x", None, ""):
        (row,) = catalog.query("SELECT person_of(?) AS person", [sender]).to_pylist()
        assert row["person"] == (name_of(sender) if sender else None)


def test_view_exists_for_topic_without_messages(sessions: Path) -> None:
    catalog = Catalog(sessions)
    found = catalog.tables()
    assert {view_name(name) for name in TOPICS} <= set(found)
    for name in found:
        assert catalog.query(f'SELECT count(*) n FROM "{name}"').num_rows == 1
    assert "session" in found["sensor_wheels"]


def test_directory_that_cannot_be_listed_has_no_answers(sessions: Path) -> None:
    for wrong in (sessions / "nowhere", sessions / "one" / "0001.mcap"):
        with pytest.raises(OSError, match=wrong.name):
            Catalog(wrong)


@pytest.mark.parametrize("sql", ["SELECT nothing FROM sensor_range", "nonsense", "SELECT * FROM nowhere", ""])
def test_bad_query_is_refused_in_one_line(sessions: Path, sql: str) -> None:
    if not sql:
        assert Catalog(sessions).query("SELECT 1 WHERE false").num_rows == 0
        return
    with pytest.raises(BadQuery) as refused:
        Catalog(sessions).query(sql)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("sensor_rnage", "Did you mean sensor_range?"),
        ("sensor_range_contxt", "Did you mean sensor_range_context?"),
        ("nowhere", "fleet query --tables"),
    ],
)
def test_misspelled_table_is_named_with_the_likely_one(sessions: Path, wrong: str, words: str) -> None:
    with pytest.raises(BadQuery) as refused:
        Catalog(sessions).query(f"SELECT * FROM {wrong}")
    assert has_parts(str(refused.value), f"{wrong} … {words}")


def test_quote_in_session_name_is_no_sql(sessions: Path) -> None:
    make(sessions / "it's; DROP", "green", [7.0])
    assert {"it's; DROP"} == {
        row["session"] for row in asked(sessions, "SELECT session FROM sensor_range WHERE car = 'green'")
    }


def test_tables_are_made_once_and_again_for_grown_session(sessions: Path) -> None:
    first = tables_of(sessions / "one").directory
    assert first.is_dir()
    assert tables_of(sessions / "one").directory == first
    make(sessions / "more", "red", [5.0])
    shutil.copy(sessions / "more" / "0001.mcap", sessions / "one" / "0002.mcap")
    second = tables_of(sessions / "one").directory
    assert second != first
    assert [each.name for each in (sessions / "one").glob(f"{TABLES_PREFIX}*")] == [second.name], (
        "the old ones are gone"
    )
    shutil.rmtree(second)
    assert asked(sessions, "SELECT count(*) n FROM sensor_range WHERE session = 'one'") == [{"n": 6}]


def test_damaged_session_is_named_and_others_are_read(sessions: Path) -> None:
    file = sessions / "two" / "0001.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    (sessions / "broken").mkdir()
    (sessions / "broken" / "0001.mcap").write_bytes(b"no MCAP at all")
    catalog = Catalog(sessions)
    assert set(catalog.damage) >= {"two"}
    assert catalog.query("SELECT count(*) n FROM sensor_range WHERE car = 'red'").to_pylist() == [{"n": 4}]


def describe(session: Path, **values: Any) -> None:
    whole = json.loads((session / "session.json").read_text())
    (session / "session.json").write_text(json.dumps({**whole, **values}))


@pytest.mark.parametrize("asked_before", [False, True])
def test_session_that_lacks_messages_is_named_as_by_find(sessions: Path, *, asked_before: bool) -> None:
    if asked_before:
        assert not Catalog(sessions).damage
    describe(sessions / "one", messages=9000)
    shutil.copytree(sessions / "two", sessions / "cut", ignore=shutil.ignore_patterns(".*"))
    describe(sessions / "cut", closed=False, ended="2026-01-01T00:00:00Z")
    catalog = Catalog(sessions)
    assert set(catalog.damage) == {"one", "cut"}
    assert "9000" in catalog.damage["one"]
    assert named(query("FROM sensor_range", sessions), sessions) == {"one", "cut"}
    assert named(find(sessions), sessions) == {"one", "cut"}
    describe(sessions / "one", messages=0)
    assert set(Catalog(sessions).damage) == {"cut"}


def test_session_asked_while_recording_is_named_once_cut(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    describe(sessions / "one", closed=False)
    os.utime(sessions / "one" / "0001.mcap")
    assert not Catalog(sessions).damage
    (tables,) = (sessions / "one").glob(f"{TABLES_PREFIX}*")
    now_s = time.time()
    monkeypatch.setattr(time, "time", lambda: now_s + 60)
    assert set(Catalog(sessions).damage) == {"one"}
    assert tables.exists()


def test_mark_keeps_cached_tables(sessions: Path) -> None:
    before = tables_of(sessions / "one").directory
    describe(sessions / "one", marks=[{"time": "2026-01-01T00:00:00Z", "text": "a cat", "by": "mia"}])
    assert tables_of(sessions / "one").directory == before


def test_session_descriptions_are_read_once(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def noting(session: Path) -> str:
        read.append(session)
        return described(session)

    described = table_cache._described
    monkeypatch.setattr(table_cache, "_described", noting)
    one, two = sessions / "one", sessions / "two"
    for _ in range(3):
        Catalog(sessions)
    assert read == [one, two]
    describe(one, marks=[{"time": "2026-01-01T00:00:00Z", "text": "a cat", "by": "mia"}])
    for _ in range(3):
        Catalog(sessions)
    assert read == [one, two, one]
    describe(two, error="the disk was full")
    for _ in range(3):
        Catalog(sessions)
    assert read == [one, two, one, two], "its tables were made anew"


def test_session_deleted_during_query_is_left_out(sessions: Path) -> None:
    catalog = Catalog(sessions)
    shutil.rmtree(sessions / "two")
    assert catalog.query("SELECT DISTINCT car FROM sensor_range").to_pylist() == [{"car": "red"}]
    with pytest.raises((NoSession, OSError)):
        tables_of(sessions / "two")


def test_two_questions_at_once_make_whole_tables(sessions: Path) -> None:
    answers: list[int] = []
    threads = [
        threading.Thread(target=lambda: answers.append(Catalog(sessions).query("FROM sensor_range").num_rows))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert answers == [7] * 4
    left = [each.name for each in (sessions / "one").iterdir() if each.name.startswith(TABLES_PREFIX)]
    assert len(left) == 1


def test_tables_of_a_folder_that_is_read_only_go_elsewhere(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = sessions.parent / "tmp"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    made = table_cache._made

    def refuses(session: Path, place: Path, stamp: str) -> table_cache.CachedTables:
        if place.parent == session:  # root may write everywhere, so the answer of the system is given here
            raise PermissionError(13, "Permission denied", str(place))
        return made(session, place, stamp)

    monkeypatch.setattr(table_cache, "_made", refuses)
    assert tables_of(sessions / "one").directory.is_relative_to(elsewhere)
    assert asked(sessions, "SELECT DISTINCT session FROM sensor_range ORDER BY 1") == [
        {"session": "one"},
        {"session": "two"},
    ]


def query(*arguments: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    return in_process.fleet("query", *arguments, cwd=cwd)


def test_query_command_prints_table_csv_and_json(sessions: Path) -> None:
    sql = "SELECT car, range_m FROM sensor_range WHERE range_m < 0.6 ORDER BY range_m"
    assert query(sql, sessions).stdout.split() == ["car", "range_m", "red", "0.25", "red", "0.5"]
    assert query(sql, sessions, "--csv").stdout.splitlines() == ["car,range_m", "red,0.25", "red,0.5"]
    assert json.loads(query(sql, sessions, "--json").stdout.splitlines()[0]) == {"car": "red", "range_m": 0.25}
    listed = {
        json.loads(line)["table"] for line in query("--tables", "--json", cwd=sessions.parent).stdout.splitlines()
    }
    assert {"sensor_range", "sensor_range_context", "event_command"} <= listed
    elsewhere = query("--tables", "--json", sessions, cwd=sessions / "one").stdout
    assert {json.loads(line)["table"] for line in elsewhere.splitlines()} == listed


@pytest.mark.parametrize("arguments", [(), ("SELECT 1", "--tables"), ("SELECT 1", "--csv", "--json"), ("SELEKT",)])
def test_wrong_use_is_code_2(sessions: Path, arguments: tuple[str, ...]) -> None:
    assert query(*arguments, cwd=sessions.parent).returncode == 2


def test_query_without_sessions_has_no_traceback(tmp_path: Path) -> None:
    assert query("SELECT 1", tmp_path / "nowhere").returncode == 1
    (tmp_path / "empty").mkdir()
    assert query("SELECT count(*) FROM sensor_range", tmp_path / "empty").stdout.split()[-1] == "0"


def find(place: Path) -> "subprocess.CompletedProcess[str]":
    return in_process.fleet("find", "range_m < 5", place)


def named(done: "subprocess.CompletedProcess[str]", sessions: Path) -> set[str]:
    """Return the sessions that stderr names."""
    return {line.partition(":")[0] for line in done.stderr.splitlines()} & {each.name for each in sessions.iterdir()}


def test_query_exit_code_is_that_of_find(sessions: Path) -> None:
    file = sessions / "two" / "0001.mcap"
    whole = file.read_bytes()
    (sessions / "broken").mkdir()
    (sessions / "broken" / "0001.mcap").write_bytes(b"no MCAP at all")
    for damaged, bad in ((whole[: len(whole) * 2 // 3], {"two", "broken"}), (b"", {"two", "broken"})):
        file.write_bytes(damaged)
        for done in (query("FROM sensor_range", sessions), find(sessions)):
            assert (done.returncode, named(done, sessions)) == (0, bad)
            assert done.stdout
    (sessions / "one" / "0001.mcap").write_bytes(b"")
    for done in (query("FROM sensor_range", sessions), find(sessions)):
        assert (done.returncode, named(done, sessions)) == (1, {"one", "two", "broken"}), "nothing could be read"


@pytest.mark.parametrize("closed", [".", ".."])
@pytest.mark.parametrize(
    "arguments", [("query", "FROM sensor_range"), ("find", "range_m < 5"), ("sessions",), ("sessions", "at", "14:05")]
)
def test_unlistable_directory_is_one_line(sessions: Path, arguments: tuple[str, ...], closed: str) -> None:
    in_process.fleet(*arguments, sessions)  # without rights, Python could perhaps not import what this imports
    place, locked = sessions, sessions
    if closed == "..":
        place = sessions / "of" / "mia"
        place.mkdir(parents=True)
        locked = place.parent
    locked.chmod(0o311 if closed == "." else 0)
    try:
        with no_superuser(sessions.parent):
            done = in_process.fleet(*arguments, place)
    finally:
        locked.chmod(0o755)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert str(place) in line
    assert os.strerror(errno.EACCES) in line


def no_tables(place: Path) -> bool:
    """Return True if nothing is left of tables, whole or half made."""
    return not [*place.rglob(f"{TABLES_PREFIX}*")]


@pytest.mark.parametrize("count", [60, *only_in_soak([300])])
def test_damaged_sessions_of_many_are_named_and_rest_counts(tmp_path: Path, count: int) -> None:
    damaged = range(0, count, count // 10)
    for number in range(count):
        make(tmp_path / f"s{number:03d}", "red", [1.0])
    for number in damaged:
        file = tmp_path / f"s{number:03d}" / "0001.mcap"
        file.write_bytes(file.read_bytes()[:-200] if number % (count // 5) else b"noise")
    catalog = Catalog(tmp_path)
    assert sorted(catalog.damage) == [f"s{number:03d}" for number in damaged]
    found = catalog.query("SELECT session FROM sensor_range GROUP BY ALL").num_rows
    assert found == count - 5, "five are noise"


def old_schema(session: Path, kind: int, words: str = "0.75", *, echo: str = "echo_us") -> None:
    """Make a session of an older version: another type of range_m, a field that we have not, and none that is newer."""
    file = descriptor_pb2.FileDescriptorProto(name="old.proto", package="fleet.v1", syntax="proto3")
    message = file.message_type.add(name="Range")
    for number, (name, of) in enumerate((("range_m", kind), (echo, message.field.add().TYPE_INT64))):
        message.field.add(name=name, number=number + 1, type=of, label=1)
    del message.field[0]
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made: Any = message_factory.GetMessageClass(pool.FindMessageTypeByName("fleet.v1.Range"))()
    setattr(made, echo, 7)
    made.range_m = words if kind == message.field[0].TYPE_STRING else 3
    session.mkdir()
    with (session / "0001.mcap").open("wb") as out:
        writer: Any = Writer(out)
        writer.start()
        files = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
        schema = writer.register_schema("fleet.v1.Range", "protobuf", files)
        channel = writer.register_channel("fleet/old/sensor/range", "protobuf", schema)
        writer.add_message(channel, START_NS, made.SerializeToString(), START_NS, 1)
        writer.finish()


@pytest.mark.parametrize(
    ("encoding", "schema", "payload", "cause"),
    [
        ("json", b"", b"{}", LeftOutCause.NOT_PROTOBUF),
        ("protobuf", b"garbage", b"", LeftOutCause.BAD_SCHEMA),
        ("protobuf", messages.descriptor_set("fleet.v1.Range"), b"\xff\xff", LeftOutCause.UNREADABLE),
    ],
    ids=["json", "schema", "payload"],
)
def test_messages_that_cannot_be_decoded_are_named(
    sessions: Path, encoding: str, schema: bytes, payload: bytes, cause: LeftOutCause
) -> None:
    key = "fleet/red/sensor/range"
    (sessions / "odd").mkdir()
    with (sessions / "odd" / "0001.mcap").open("wb") as out:
        writer: Any = Writer(out)
        writer.start()
        number = writer.register_schema("fleet.v1.Range", "protobuf", schema) if schema else 0
        channel = writer.register_channel(key, encoding, number)
        for at in range(7):
            writer.add_message(channel, START_NS + at, payload, START_NS + at, at)
        writer.finish()
    for _ in ("made", "kept"):
        catalog = Catalog(sessions)
        assert catalog.query("SELECT count(*) n FROM sensor_range").to_pylist() == [{"n": 7}]
        assert {name: dict(each.counts) for name, each in catalog.left_out().items()} == {"odd": {(key, cause): 7}}
    assert f"7 of {key}: {cause}" in query("FROM sensor_range", sessions).stderr
    assert key not in query("FROM sensor_line", sessions).stderr, "the question was about another topic"


@pytest.mark.parametrize("others", [True, False])
def test_session_of_other_schema_has_our_columns(sessions: Path, *, others: bool) -> None:
    if not others:
        shutil.rmtree(sessions / "one")
        shutil.rmtree(sessions / "two")
    old_schema(sessions / "words", 9)
    old_schema(sessions / "whole numbers", 3)
    rows = asked(
        sessions, "SELECT session, range_m, no_echo, echo_us, mode FROM sensor_range_context WHERE car = 'old'"
    )
    assert sorted(rows, key=lambda row: str(row["session"])) == [
        {"session": "whole numbers", "range_m": 3.0, "no_echo": None, "echo_us": "7", "mode": None},
        {"session": "words", "range_m": 0.75, "no_echo": None, "echo_us": "7", "mode": None},
    ]
    assert asked(sessions, "SELECT count(*) n FROM sensor_range WHERE range_m < 0.6") == [{"n": 2 if others else 0}]


@pytest.mark.parametrize("name", ["session", "Range_M", "RANGE_m_1"])
def test_columns_of_one_name_are_two_columns(sessions: Path, name: str) -> None:
    """DuckDB refused them for each topic of which two versions have sessions, with a traceback for `--tables`."""
    old_schema(sessions / "a", 3, echo=name)
    old_schema(sessions / "b", 9, echo=name)
    title = name if name == "RANGE_m_1" else f"{name}_1"
    rows = asked(sessions, f"SELECT session, range_m, {title} AS other FROM sensor_range WHERE car = 'old' ORDER BY 1")
    assert rows == [
        {"session": "a", "range_m": 3.0, "other": "7"},
        {"session": "b", "range_m": 0.75, "other": "7"},
    ]


def test_sessions_of_two_versions_have_all_tables(sessions: Path) -> None:
    """A message of the recorder and one of the supervisor have a field `session`, too."""
    shutil.copytree(OLD_SESSION, sessions / "old")
    (sessions / "new").mkdir()
    made = Made(sessions / "new" / "0001.mcap", Writer)
    made.put("fleet/@supervisor/status", pb.Supervision(session="sessions/new"), 0)
    made.close()
    done = query("--tables", sessions)
    assert (done.returncode, "supervisor_status" in done.stdout) == (0, True), done.stderr
    rows = asked(sessions, "SELECT DISTINCT session, session_1 FROM supervisor_status ORDER BY session")
    assert rows == [{"session": "new", "session_1": "sessions/new"}, {"session": "old", "session_1": None}]


def test_value_null_for_its_type_is_named(sessions: Path) -> None:
    old_schema(sessions / "words", 9, "far away")
    old_schema(sessions / "numbers", 9)
    done = query("SELECT count(*) n FROM sensor_range WHERE range_m IS NULL", "--csv", sessions)
    assert (done.returncode, done.stdout.split()) == (0, ["n", "1"])
    assert [line for line in done.stderr.splitlines() if "null" in line] == [
        "words: null in the tables: 1 of sensor/range range_m: not DOUBLE"
    ]
    assert "null" not in query("SELECT count(*) FROM sensor_line", sessions).stderr, "nobody asked for it"


@pytest.mark.parametrize("name", ["it's", 'a"b', "s[12]", "s*", "s?", "ü {x}", "-- x; DROP"])
def test_any_name_is_a_name(sessions: Path, name: str) -> None:
    make(sessions / name, "green", [7.0])
    make(sessions / "s1", "white", [7.0])
    rows = asked(sessions, "SELECT DISTINCT session FROM sensor_range WHERE car = 'green'")
    assert rows == [{"session": name}]


def test_single_file_is_session_of_its_name(sessions: Path) -> None:
    (sessions / "two" / "0001.mcap").rename(sessions / "lone.mcap")
    shutil.rmtree(sessions / "two")
    assert asked(sessions, "SELECT DISTINCT session FROM sensor_range WHERE car = 'blue'") == [{"session": "lone.mcap"}]


def test_interrupted_session_may_grow_during_query(sessions: Path) -> None:
    whole = (sessions / "one" / "0001.mcap").read_bytes()
    live = sessions / "live"
    live.mkdir()
    file = live / "0001.mcap"
    file.write_bytes(whole[:-50])
    catalogs = [Catalog(sessions), Catalog(sessions)]
    before = catalogs[0].query("FROM sensor_range").num_rows
    shutil.copy(sessions / "one" / "0001.mcap", live / "0002.mcap")
    after = Catalog(sessions).query("FROM sensor_range").num_rows
    assert (before, after) == (11, 15)
    # The first two find their tables gone, and ask again.
    assert [catalog.query("FROM sensor_range").num_rows for catalog in catalogs] == [after, after]
    assert len([*live.glob(f"{TABLES_PREFIX}*")]) == 1


def test_table_cache_does_not_recreate_deleted_session(sessions: Path) -> None:
    shutil.rmtree(sessions / "two")
    with pytest.raises(NoSession):
        tables_of(sessions / "two")
    with pytest.raises(FileNotFoundError):  # it was there a moment ago
        table_cache._made(sessions / "two", sessions / "two" / f"{TABLES_PREFIX}x", "x")
    assert [each.name for each in sessions.iterdir()] == ["one"]


def test_tables_of_a_file_that_is_gone_go_too(sessions: Path) -> None:
    lone = shutil.copy(sessions / "two" / "0001.mcap", sessions / "lone.mcap")
    Catalog(sessions)
    assert [*(sessions / ".lone.mcap").glob(f"{TABLES_PREFIX}*")]
    lone.unlink()
    Catalog(sessions)
    assert not (sessions / ".lone.mcap").exists()


def test_quota_deletes_session_while_tables_are_made(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SessionInfo("fleet", "2026-01-01T00:00:00Z", "h", {}, closed=True).write(sessions / "two")
    rmtree, meanwhile = shutil.rmtree, [sessions / "two" / f"{TABLES_PREFIX}x.part"]

    def and_a_question(path: Path, **more: Any) -> None:
        if not meanwhile:
            rmtree(path, **more)
            return
        for each in path.iterdir():
            each.unlink()
        meanwhile.pop().mkdir()
        path.rmdir()

    monkeypatch.setattr(shutil, "rmtree", and_a_question)
    assert enforce(Quota(total=1), sessions, sessions / "one").removed == [sessions / "two"]
    assert not (sessions / "two").exists()


@pytest.mark.parametrize("age_s", [0.0, STALE_PART_S + 60])
def test_old_partial_tables_of_killed_query_are_removed(sessions: Path, age_s: float) -> None:
    part = sessions / "one" / f"{TABLES_PREFIX}0123-abc.part"
    part.mkdir()
    (part / "fleet.v1.Range.parquet").write_bytes(b"half")
    for each in (part / "fleet.v1.Range.parquet", part):
        os.utime(each, (time.time() - age_s, time.time() - age_s))
    tables_of(sessions / "one")
    assert part.exists() == (not age_s)


def test_ctrl_c_leaves_nothing_half_made(tmp_path: Path) -> None:
    place = tmp_path / "all"
    place.mkdir()
    make(place / "long", "red", [1.0] * 60_000)
    command = [sys.executable, "-m", "fleet", "query", "FROM sensor_range LIMIT 1", str(place)]
    asking = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: [*place.rglob("*.parquet*")] or asking.poll() is not None, "the tables are being made")
    asking.send_signal(signal.SIGINT)
    out, err = asking.communicate(timeout=60)
    assert (asking.returncode, out) == (130, ""), err
    assert "Traceback" not in err
    assert no_tables(place)


@pytest.mark.skipif(not MAY_MOUNT, reason="needs the right to mount")
@pytest.mark.parametrize("both", [False, True])
def test_full_disk_costs_no_row_of_query(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, both: bool) -> None:
    with disk("really full", tmp_path) as full:
        elsewhere = full.root / ".tmp" if both else tmp_path / "tmp"
        elsewhere.mkdir(parents=True)
        monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
        full.root.mkdir(exist_ok=True)
        make(full.root / "one", "red", [1.0] * 3000)
        make(full.root / "two", "blue", [1.0, 2.0])
        recorded = (full.root / "one" / "0001.mcap").read_bytes()
        tables_of(full.root / "two")
        full.fill(but=16_384)
        done = query("SELECT car, count(*) n FROM sensor_range GROUP BY ALL ORDER BY 1", full.root, "--csv")
        if both:
            assert (done.returncode, done.stdout) == (1, "")
            assert "one" in done.stderr
            assert os.strerror(errno.ENOSPC) in done.stderr
        else:
            assert (done.returncode, done.stdout.splitlines()) == (0, ["car,n", "blue,3", "red,3001"])
        assert no_tables(full.root / "one")
        assert (full.root / "one" / "0001.mcap").read_bytes() == recorded
        full.free()
        assert asked(full.root, "SELECT count(*) n FROM sensor_range") == [{"n": 3004}]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES, errno.EFBIG])
@pytest.mark.parametrize("places", [1, 2])
def test_tables_that_can_be_written_nowhere_are_no_answer(
    sessions: Path, monkeypatch: pytest.MonkeyPatch, code: int, places: int
) -> None:
    elsewhere = sessions.parent / "tmp"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    add = table_cache._Sink.add

    def fails(sink: table_cache._Sink, values: Any) -> None:
        if "two" in sink._path.parts and (places == 2 or not sink._path.is_relative_to(elsewhere)):
            raise OSError(code, os.strerror(code))
        add(sink, values)

    monkeypatch.setattr(table_cache._Sink, "add", fails)
    done = query("SELECT count(*) n FROM sensor_range", sessions)
    assert (done.returncode, done.stdout.split()) == ((0, ["n", "7"]) if places == 1 else (1, []))
    if places == 2:
        assert "two" in done.stderr
        assert no_tables(sessions / "two")


def test_missing_temporary_directory_is_one_line(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(sessions / "nowhere"))
    done = query("SELECT count(*) n FROM sensor_range", sessions)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)


def test_tables_that_another_question_deletes_are_made_again(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drop, meanwhile = table_cache._drop_others, [shutil.rmtree]

    def and_another_question(place: Path) -> None:
        drop(place)
        while meanwhile:
            meanwhile.pop()(place)

    monkeypatch.setattr(table_cache, "_drop_others", and_another_question)
    assert asked(sessions, "SELECT count(*) n FROM sensor_range") == [{"n": 7}]


@pytest.mark.skipif(not MAY_MOUNT, reason="needs the right to mount")
def test_read_only_disk_can_be_queried(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = sessions.parent / "tmp"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    subprocess.run(["mount", "--bind", sessions, sessions], check=True)
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", sessions], check=True)
        assert asked(sessions, "SELECT count(*) n FROM sensor_range") == [{"n": 7}]
    finally:
        subprocess.run(["umount", "-l", sessions], check=True)
    assert no_tables(sessions)


@pytest.mark.soak
def test_million_rows_are_written_in_blocks(sessions: Path) -> None:
    sql = "SELECT range AS n FROM range(1000000)"
    for format_option in ("--csv", "--json"):
        command = [sys.executable, "-c", LIMITED, "query", sql, str(sessions), format_option]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("\n") == 1_000_000 + (format_option == "--csv")


LIMITED = (
    "import resource; resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30));from fleet.cli import main; main()"
)
"""Runs `fleet` with a GB of memory."""


def test_cells_of_strangers_never_reach_a_terminal_raw(sessions: Path) -> None:
    sql = "SELECT 'a' || chr(27) || ']0;x' || chr(10) || chr(155) || repeat('y', 100000) AS \"c\x1b[2J\""
    shown = query(sql, sessions).stdout
    assert "\x1b" not in shown
    assert "\x9b" not in shown
    assert len(shown.splitlines()) == 2
    assert "y" * 100_000 in shown, "a pipe gets all of a cell"
    wrong = query("SELECT CAST(chr(27) || ']0;x' AS INTEGER)", sessions)
    assert wrong.returncode == 2
    assert "\x1b" not in wrong.stderr
    columns = query("--tables", cwd=sessions.parent).stdout
    assert "voltage_v, charge, charge_error, level" in columns
    short = Terminal("fleet", "query", f"{sql}, 'the end' AS z", str(sessions), environment={}, directory=sessions)
    try:
        assert "y" * (MAX_CELL + 1) not in short.until("the end")
    finally:
        short.close()
    on_terminal = Terminal("fleet", "query", sql, str(sessions), "--csv", environment={}, directory=sessions)
    try:
        assert "\\x1b]0;x" in on_terminal.until("yyy")
        assert b"\x1b]" not in on_terminal._shown
        assert b"\x1b[2J" not in on_terminal._shown
    finally:
        on_terminal.close()


def test_numbers_that_are_none_are_null(sessions: Path) -> None:
    sql = "SELECT 'nan'::DOUBLE a, 'inf'::DOUBLE b, NULL c, [1, NULL] d, {'t': TIMESTAMP '2026-01-01'} e"
    assert json.loads(query(sql, sessions, "--json").stdout) == {
        "a": None,
        "b": None,
        "c": None,
        "d": [1, None],
        "e": {"t": "2026-01-01T00:00:00"},
    }
    assert query(sql, sessions, "--csv").stdout.splitlines()[1].startswith(',,,"[1, null]"')


def test_all_views_are_there_for_a_question_that_lists_them(sessions: Path) -> None:
    for sql in ("SHOW TABLES", "SELECT * FROM information_schema.tables"):
        assert "sensor_range_context" in str(asked(sessions, sql))


def test_too_large_query_fails_without_wrong_use(sessions: Path) -> None:
    catalog = Catalog(sessions)
    with pytest.raises(QueryFailed):
        catalog.query("SELECT list(range) FROM range(2000000000)")

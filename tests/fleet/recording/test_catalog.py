"""Questions in SQL to all sessions, and the tables that are kept beside them."""

import json
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import pytest
from mcap.writer import Writer

from fleet import Catalog
from fleet.recording.catalog import BadQuery, view_name
from fleet.recording.reading.session import NoSession
from fleet.recording.tools import table_cache
from fleet.recording.tools.table_cache import PREFIX, is_cached, tables_of
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.fleet.replay.make_session import Made
from tests.support import in_process


def make(path: Path, car: str, distances: list[float]) -> None:
    """Make a session: one distance a second, in tracking from the third second on, driven by ann."""
    path.mkdir()
    made = Made(path / "0001.mcap", Writer)
    for second, distance in enumerate(distances):
        made.put(f"fleet/{car}/state/mode", pb.Mode(asked="tracking" if second >= 2 else "manual"), second)
        made.put(f"fleet/{car}/state/motion", pb.Motion(motion="forward"), second)
        made.put(f"fleet/{car}/state/safety", pb.Safety(motors="on", lease=pb.Lease(holder="ann@desk")), second)
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


def test_a_question_reaches_every_session_and_says_which(sessions: Path) -> None:
    rows = asked(
        sessions, "SELECT session, car, count(*) n, min(range_m) nearest FROM sensor_range GROUP BY ALL ORDER BY 1"
    )
    assert rows == [
        {"session": "one", "car": "red", "n": 4, "nearest": 0.25},
        {"session": "two", "car": "blue", "n": 3, "nearest": 2.0},
    ]


def test_the_context_is_of_that_moment_and_stale_states_do_not_count(sessions: Path) -> None:
    rows = asked(
        sessions,
        "SELECT range_m, mode, motion, driver FROM sensor_range_context WHERE car = 'red' ORDER BY publish_time",
    )
    driven = {"motion": "forward", "driver": "ann@desk"}
    assert rows[0] == {"range_m": 1.0, "mode": "manual", **driven}
    assert rows[2] == {"range_m": 0.25, "mode": "tracking", **driven}
    assert rows[3] == {"range_m": 9.0, "mode": None, "motion": None, "driver": None}, "57 s later nothing is known"


def test_every_topic_has_a_view_also_without_a_message(sessions: Path) -> None:
    catalog = Catalog(sessions)
    found = catalog.tables()
    assert {view_name(name) for name in TOPICS} <= set(found)
    for name in found:
        assert catalog.query(f'SELECT count(*) n FROM "{name}"').num_rows == 1
    assert "session" in found["sensor_wheels"]


@pytest.mark.parametrize("sql", ["SELECT nothing FROM sensor_range", "nonsense", "SELECT * FROM nowhere", ""])
def test_a_bad_question_is_one_line(sessions: Path, sql: str) -> None:
    if not sql:
        assert Catalog(sessions).query("SELECT 1 WHERE false").num_rows == 0
        return
    with pytest.raises(BadQuery) as refused:
        Catalog(sessions).query(sql)
    assert "\n" not in str(refused.value)


def test_a_quote_in_the_name_of_a_session_is_no_sql(sessions: Path) -> None:
    make(sessions / "it's; DROP", "green", [7.0])
    assert {"it's; DROP"} == {
        row["session"] for row in asked(sessions, "SELECT session FROM sensor_range WHERE car = 'green'")
    }


def test_tables_are_made_once_and_anew_for_a_session_that_grew(sessions: Path) -> None:
    first = tables_of(sessions / "one").directory
    assert is_cached(sessions / "one")
    assert tables_of(sessions / "one").directory == first
    make(sessions / "more", "red", [5.0])
    shutil.copy(sessions / "more" / "0001.mcap", sessions / "one" / "0002.mcap")
    assert not is_cached(sessions / "one")
    second = tables_of(sessions / "one").directory
    assert second != first
    assert [each.name for each in (sessions / "one").glob(f"{PREFIX}*")] == [second.name], "the old ones are gone"
    shutil.rmtree(second)
    assert asked(sessions, "SELECT count(*) n FROM sensor_range WHERE session = 'one'") == [{"n": 6}]


def test_a_damaged_session_is_named_and_its_rest_counts(sessions: Path) -> None:
    file = sessions / "two" / "0001.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    (sessions / "broken").mkdir()
    (sessions / "broken" / "0001.mcap").write_bytes(b"no MCAP at all")
    catalog = Catalog(sessions)
    assert set(catalog.damage) >= {"two"}
    assert catalog.query("SELECT count(*) n FROM sensor_range WHERE car = 'red'").to_pylist() == [{"n": 4}]


def test_a_session_that_is_deleted_meanwhile_is_left_out(sessions: Path) -> None:
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
    left = [each.name for each in (sessions / "one").iterdir() if each.name.startswith(PREFIX)]
    assert len(left) == 1


def test_tables_of_a_folder_that_is_read_only_go_elsewhere(sessions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = sessions.parent / "tmp"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    made = table_cache._made

    def refuses(session: Path, place: Path) -> table_cache.CachedTables:
        if place.parent == session:  # root may write everywhere, so the answer of the system is given here
            raise PermissionError(13, "Permission denied", str(place))
        return made(session, place)

    monkeypatch.setattr(table_cache, "_made", refuses)
    assert tables_of(sessions / "one").directory.is_relative_to(elsewhere)
    assert asked(sessions, "SELECT DISTINCT session FROM sensor_range ORDER BY 1") == [
        {"session": "one"},
        {"session": "two"},
    ]


def query(*arguments: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    return in_process.fleet("query", *arguments, cwd=cwd)


def test_the_command_answers_as_a_table_csv_and_json(sessions: Path) -> None:
    sql = "SELECT car, range_m FROM sensor_range WHERE range_m < 0.6 ORDER BY range_m"
    assert query(sql, sessions).stdout.split() == ["car", "range_m", "red", "0.25", "red", "0.5"]
    assert query(sql, sessions, "--csv").stdout.splitlines() == ["car,range_m", "red,0.25", "red,0.5"]
    assert json.loads(query(sql, sessions, "--json").stdout.splitlines()[0]) == {"car": "red", "range_m": 0.25}
    listed = {
        json.loads(line)["table"] for line in query("--tables", "--json", cwd=sessions.parent).stdout.splitlines()
    }
    assert {"sensor_range", "sensor_range_context", "event_command"} <= listed


@pytest.mark.parametrize("arguments", [(), ("SELECT 1", "--tables"), ("SELECT 1", "--csv", "--json"), ("SELEKT",)])
def test_wrong_use_is_code_2(sessions: Path, arguments: tuple[str, ...]) -> None:
    assert query(*arguments, cwd=sessions.parent).returncode == 2


def test_no_sessions_are_no_traceback(tmp_path: Path) -> None:
    assert query("SELECT 1", tmp_path / "nowhere").returncode == 1
    (tmp_path / "empty").mkdir()
    assert query("SELECT count(*) FROM sensor_range", tmp_path / "empty").stdout.split()[-1] == "0"

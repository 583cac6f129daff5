"""Tables take the type of their key. Stray types, junk and impossible dates take nothing else with them."""

from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq  # type: ignore[import-untyped]  # it has no stubs
import pytest
from click.testing import CliRunner

from fleet.commands.sessions import sessions
from fleet.recording.left_out import LeftOutCause
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools.table_export import export
from fleet.recording.tools.table_formats import FORMATS
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.random_session import LINK, RANGE, START_NS, Mixed, make

MODE, COMMAND = "fleet/red/state/mode", "fleet/red/event/command"
NAMED = r"another type|not protobuf|2262"
IN_9999 = 253_402_300_000


@pytest.fixture
def mixed(tmp_path: Path) -> Session:
    """Return a session with two strays and JSON among 50 messages of a key."""
    made = Mixed(tmp_path / "0001.mcap")
    made.stray(LINK, RANGE)
    made.own(LINK, 25)
    made.stray(LINK, RANGE)
    made.put(LINK, "", b"{}", "json")
    made.own(LINK, 25)
    made.own(RANGE, 3)
    made.close()
    return Session(tmp_path)


@pytest.mark.parametrize("name", ["state/link", "fleet.v1.Link", "Link", "red/state/link"])
def test_table_takes_named_type_and_counts_strays(mixed: Session, name: str) -> None:
    with pytest.warns(UserWarning, match=NAMED) as warned:
        table = mixed.to_arrow(name)
    assert table.num_rows == 50
    assert set(table["state"].to_pylist()) == {"online"}
    assert len(warned) == 2, "the strays, and what is not protobuf"
    with pytest.warns(UserWarning, match=NAMED):
        assert len(mixed.to_pandas(name)) == 50
    assert mixed.to_arrow("sensor/range").num_rows == 3, "no stray of another key"


def test_strays_are_tables_of_their_own(mixed: Session, tmp_path: Path) -> None:
    tables = mixed.stray_tables()
    assert {name: table.num_rows for name, table in tables.items()} == {"stray.fleet.v1.Range": 2, "other": 1}
    assert set(tables["stray.fleet.v1.Range"]["key"].to_pylist()) == {LINK}
    (out := tmp_path / "out").mkdir()
    done = export(mixed.rows(), out, FORMATS["parquet"])
    assert done.rows == {"stray.fleet.v1.Range": 2, "fleet.v1.Link": 50, "other": 1, "fleet.v1.Range": 3}
    assert done.left_out.counts == {(LINK, LeftOutCause.OTHER_TYPE): 2, (LINK, LeftOutCause.NOT_PROTOBUF): 1}
    assert {path.stem: pq.read_table(path).num_rows for path in out.iterdir()} == done.rows


def test_join_takes_named_types(mixed: Session) -> None:
    with pytest.warns(UserWarning, match=NAMED):
        frame = mixed.joined("sensor/range", "state/link")
    assert frame["link.state"].tolist() == ["online"] * 3


def test_strays_alone_give_empty_table_of_own_type(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "0001.mcap")
    made.stray(LINK, RANGE)
    made.close()
    with pytest.warns(UserWarning, match=NAMED):
        table = Session(path).to_arrow("red/state/link")
    assert (table.num_rows, "rx_bytes" in table.column_names) == (0, True)


@pytest.fixture
def dated(tmp_path: Path) -> Path:
    """Return a session with one date in 9999, one that is no date, and a good one."""
    made = Mixed(path := tmp_path / "0001.mcap")
    for seconds in (START_NS // 10**9, IN_9999, 2**62):
        event = pb.CommandEvent(id="1", verb="stop")
        event.stamp.seconds = seconds
        made.put(COMMAND, "fleet.v1.CommandEvent", event.SerializeToString())
    made.own(RANGE, 2)
    made.close()
    return path


def test_date_beyond_2262_is_null_with_warning(dated: Path) -> None:
    with pytest.warns(UserWarning, match=NAMED) as warned:
        table = Session(dated).to_arrow("event/command")
    assert len(warned) == 1
    assert [value is None for value in table["stamp"].to_pylist()] == [False, True, True]
    with pytest.warns(UserWarning, match=NAMED):
        assert Session(dated).to_pandas("event/command")["stamp"].isna().tolist() == [False, True, True]
    assert Session(dated).to_pandas("sensor/range").shape[0] == 2


@pytest.mark.parametrize(("name", "lost"), [("parquet", 2), ("csv", 1)])
def test_date_beyond_2262_breaks_no_other_table(dated: Path, tmp_path: Path, name: str, lost: int) -> None:
    (out := tmp_path / "out").mkdir()
    done = export(Session(dated).rows(), out, FORMATS[name])
    assert done.undated == {"fleet.v1.CommandEvent": lost}, "CSV has text for the year 9999"
    assert {path.name for path in out.iterdir()} == {f"fleet.v1.CommandEvent.{name}", f"fleet.v1.Range.{name}"}
    result = CliRunner().invoke(sessions, ["export", str(dated), f"--{name}", str(tmp_path / "tables")])
    assert result.exit_code == 0
    assert result.stderr


@pytest.mark.parametrize("name", ["parquet", "csv"])
def test_clock_beyond_2262_is_null(tmp_path: Path, name: str) -> None:
    made = Mixed(path := tmp_path / "0001.mcap")
    made.own(RANGE)
    (channel,) = made._channels.values()
    made.writer.add_message(channel, 2**64 - 1, b"", 2**64 - 1, 2)
    made.close()
    (out := tmp_path / "out").mkdir()
    done = export(Session(path).rows(), out, FORMATS[name])
    assert done.rows == {"fleet.v1.Range": 2}
    assert sum(done.undated.values()) == (2 if name == "parquet" else 0), "log_time and publish_time"


@pytest.mark.parametrize("name", ["parquet", "csv"])
def test_no_half_written_file_is_left(tmp_path: Path, dated: Path, name: str) -> None:
    def rows() -> Iterator[Row]:
        yield from Session(dated).rows()
        raise OSError(5, "the disk is gone")

    (out := tmp_path / "out").mkdir()
    with pytest.raises(OSError, match="gone"):
        export(rows(), out, FORMATS[name])
    assert not list(out.iterdir())


def test_rescue_that_fails_leaves_no_file(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "0001.mcap")
    made.own(MODE.replace("red", "blue"))
    made.close()
    session = Session(path)
    path.unlink()
    with pytest.raises(Exception, match="intact"):
        session.rescue(tmp_path / "rescued.mcap")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["parquet", "csv"])
def test_every_message_of_files_of_chance_is_in_a_table(tmp_path: Path, name: str) -> None:
    for seed in range(60):
        make(path := tmp_path / f"{seed}.mcap", seed)
        try:
            session = Session(path)
        except NoSession:
            continue
        recorded = sum(1 for _ in session.rows())
        (out := tmp_path / f"{seed}-{name}").mkdir()
        done = export(session.rows(), out, FORMATS[name])
        assert sum(done.rows.values()) == recorded, seed
        decoded = sum(1 for _ in session.messages(decode=True))
        assert decoded + session.left_out.total == recorded, seed

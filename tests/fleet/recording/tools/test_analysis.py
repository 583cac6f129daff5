"""A session in a script: Arrow and pandas tables, joins, decoded messages, and a plot."""

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import pyarrow.parquet as pq  # type: ignore[import-untyped]  # likewise
import pytest
from mcap.writer import Writer

from fleet import Session
from fleet.examples.programs import distance_over_time
from fleet.recording.reading.session import NoSession
from fleet.recording.session_dir import SessionInfo
from fleet.recording.tools.analysis import NoTable
from fleet.recording.tools.table_export import export
from fleet.recording.tools.table_formats import FormatMissing, ParquetNsSink
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import PROTOBUF, TOPICS
from tests.fleet.recording.tools import every_type
from tests.fleet.replay.make_session import START_NS, Made

OLD = Path(__file__).parents[3] / "vectors" / "session-0.1"
JSON_ENCODING = "application/json"


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return Made(tmp_path / "0001.mcap", Writer)


def modes_and_distances(made: Made) -> None:
    """Write distances of two cars each second, and modes of red at 1.5 s and 3.5 s."""
    for second in range(8):
        for car in ("blue", "red"):
            given: Any = {"no_echo": True} if second == 2 else {"range_m": second + 0.5}
            made.put(f"fleet/{car}/sensor/range", pb.Range(**given), second)
        if second in (1, 3):
            made.put("fleet/red/state/mode", pb.Mode(inferred=f"mode {second}"), second + 0.5)
    made.close()


def test_every_type_is_the_table_that_an_export_writes(tmp_path: Path) -> None:
    every_type.make(tmp_path / "0001.mcap")
    session = Session(tmp_path)
    export(session.rows(), tmp_path, ParquetNsSink)
    for name in {topic.message for topic in TOPICS.values()}:
        table = session.to_arrow(name)
        assert table.equals(pq.read_table(tmp_path / f"{name}.parquet").sort_by("publish_time"))
        assert (
            table.schema.field("log_time").type == table.schema.field("publish_time").type == pa.timestamp("ns", "UTC")
        )
        assert table.num_rows % every_type.EACH == 0 < table.num_rows
        assert session.to_pandas(name).shape == table.shape


@pytest.mark.parametrize("name", ["sensor/range", "fleet.v1.Range", "Range", "*/sensor/range", "fleet/*/sensor/range"])
def test_unmeasured_value_is_null_in_tables(made: Made, tmp_path: Path, name: str) -> None:
    modes_and_distances(made)
    session = Session(tmp_path)
    table = session.to_arrow(name)
    assert table["range_m"].to_pylist() == [None if second == 2 else second + 0.5 for second in range(8) for _ in "br"]
    assert table.schema.field("range_m").metadata == {b"unit": b"m"}
    frame = session.to_pandas(name)
    assert (str(frame["range_m"].dtype), frame["range_m"].isna().sum()) == ("Float64", 2)
    assert frame.attrs["units"] == {"range_m": "m"}
    assert str(frame["log_time"].dtype) == "datetime64[ns, UTC]"
    assert session.to_arrow(name, start_ns=START_NS + 7 * 10**9).num_rows == 2


def test_join_takes_latest_fresh_value_of_same_car(made: Made, tmp_path: Path) -> None:
    modes_and_distances(made)
    session = Session(tmp_path)
    joined = session.joined("sensor/range", "state/mode")
    red = joined[joined["car"] == "red"]
    fresh = ["", "", "mode 1", "mode 1", "mode 3", "mode 3", "mode 3", ""]
    assert list(red["mode.inferred"].fillna("")) == fresh
    assert joined[joined["car"] == "blue"]["mode.inferred"].isna().all()
    assert joined["range_m"].isna().sum() == 2
    short = session.joined("red/sensor/range", "state/mode", tolerance_s=0.5)
    assert list(short["mode.inferred"].dropna()) == ["mode 1", "mode 3"]
    without_limit = session.joined("red/sensor/range", "state/mode", tolerance_s=float("inf"))
    assert without_limit["mode.inferred"].isna().sum() == 2
    assert session.joined("sensor/range", "sensor/arm")["arm.joint_deg"].isna().all()
    with pytest.raises(ValueError, match="tolerance_s -1 is not allowed: at least 0"):
        session.joined("sensor/range", "state/mode", tolerance_s=-1)


def test_request_of_a_command_has_columns(made: Made, tmp_path: Path) -> None:
    requests = [
        (
            "drive",
            pb.DriveCommand(motion="forward", duration_s=2.0).SerializeToString(),
            f"{PROTOBUF};fleet.v1.DriveCommand",
        ),
        ("led", b'{"r": 255, "g": 0, "b": 16}', JSON_ENCODING),
        ("mode", b"tracking", JSON_ENCODING),
        ("arm", b"\xff\xff", PROTOBUF),
        ("dance", b"", ""),
    ]
    for number, (verb, request, encoding) in enumerate(requests):
        event = pb.CommandEvent(verb=verb, phase="asked", request=request, request_encoding=encoding)
        made.put("fleet/red/event/command", event, number)
    made.close()
    rows = Session(tmp_path).to_arrow("event/command").to_pylist()
    assert "request" not in rows[0]
    given = [
        {name.removeprefix("request_"): value for name, value in row.items() if name.startswith("request_") and value}
        for row in rows
    ]
    for row in given:
        row.pop("encoding", None)
    assert given == [
        {"motion": "forward", "duration_s": 2.0},
        {"r": 255, "b": 16},
        {"unreadable": "tracking"},
        {"unreadable": "ffff"},
        {},
    ]
    assert [row["request_g"] for row in rows] == [None, 0, None, None, None]
    assert Session(tmp_path).to_arrow("event/command").schema.field("request_duration_s").metadata == {b"unit": b"s"}


def test_messages_are_decoded_to_readings(made: Made, tmp_path: Path) -> None:
    modes_and_distances(made)
    readings = list(Session(tmp_path).messages("red/sensor/range", decode=True))
    assert {reading.car for reading in readings} == {"red"}
    assert [reading["range_m"] for reading in readings] == [0.5, 1.5, None, *(second + 0.5 for second in range(3, 8))]
    assert [round(reading.time.timestamp() - START_NS / 1e9) for reading in readings] == list(range(8))
    assert [one.payload for one in Session(tmp_path).messages("red/sensor/range")] == [
        reading.value.SerializeToString() for reading in readings
    ]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sensor/rang", "session-0.1 has no messages of sensor/rang. Did you mean sensor/range"),
        ("sensor/*", "name one of fleet.v1.Battery, "),
        ("purple/sensor/range", "session-0.1 has no messages of purple/sensor/range."),
    ],
)
def test_name_that_is_no_table_says_which_are(name: str, words: str) -> None:
    with pytest.raises(NoTable, match=words.replace(".", r"\.")):
        Session(OLD).to_arrow(name)


def test_wrong_topic_name_suggests_topic() -> None:
    with pytest.raises(NoTable) as refused:
        Session(OLD).to_arrow("sensor/distance")
    assert "sensor/range?" in str(refused.value)
    assert "sensor/obstacle" not in str(refused.value)


def test_topic_without_messages_is_an_empty_table() -> None:
    assert Session(OLD).to_arrow("sensor/arm").num_rows == 0
    assert "joint_deg" in Session(OLD).to_pandas("sensor/arm").columns


@pytest.mark.parametrize("package", ["pyarrow", "pandas"])
def test_without_the_extra_the_error_says_what_to_type(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(Session(OLD).to_pandas("sensor/range")), "pyarrow has looked for pandas, and never looks again"
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(FormatMissing, match=rf"{package} is not installed.*'zenoh-car-fleet\[analysis\]'") as error:
        Session(OLD).to_pandas("sensor/range")
    assert isinstance(error.value, ImportError)


def test_newest_session_needs_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NoSession, match=r"No recordings here yet \(in sessions\)"):
        Session()
    for hour, origin in ((1, {}), (2, {}), (3, {"by": "cut"})):
        path = tmp_path / "sessions" / f"s{9 - hour}"
        path.mkdir(parents=True)
        every_type.make(path / "0001.mcap")
        about = SessionInfo("fleet", f"2026-03-14T0{hour}:00:00.000Z", "host", {}, origin=origin)
        about.write(path)
    assert [Session(name).name for name in ("latest", "latest~1", "s6", "sessions/s7")] == ["s7", "s8", "s6", "s7"]
    with pytest.raises(NoSession, match="latest~2: there are only 2 recorded sessions"):
        Session("latest~2")
    with pytest.raises(NoSession, match="There is no session at s5"):
        Session("s5")


def test_example_plots_distance_over_time(tmp_path: Path) -> None:
    mpl.use("Agg")
    distance_over_time.main(str(OLD), "red", str(tmp_path / "distance.png"))
    assert (tmp_path / "distance.png").read_bytes().startswith(b"\x89PNG")

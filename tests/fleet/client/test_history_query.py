"""The gateways' history: `fleet get --last, --since`, as CSV and JSON, and by any Zenoh client."""

import csv
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet.client import history_query
from fleet.client.client import Fleet as Client
from fleet.client.reading import Reading
from fleet.recording.tools.csv_table import table
from schemas import topics
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import HISTORY
from tests.fleet.conftest import running
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, TcpCar, wait_for
from tests.support.text_parts import has_parts

SENT = HISTORY + 100
AT_ONCE = 20
"""Number of readings in one burst. In a flood, a gateway drops readings for which it is late."""
NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


def centimetres(number: int) -> float:
    """Return the distance of the reading with this number."""
    return 10 + number / 10


class Remembered(FleetProcesses):
    """One car that has sent more readings than its gateway caches, with distances that grow a little each time."""

    def __init__(self, endpoint: str, directory: Path) -> None:
        super().__init__(endpoint, directory)
        self.car = TcpCar()
        self.gateway(self.car.link)
        wait_for(lambda: self.car.received, "the gateway writes")

        def measured() -> bool:
            self.car.send(b"$4WD,CSB5.00,PV7.91,GS214,LF1011,HW01,GM10#")
            return self.newest_m() is not None

        wait_for(measured, "a distance is taken for measured")
        for number in range(SENT):
            self.car.send(b"$4WD,CSB%.2f,PV7.91,GS214,LF1011,HW01,GM10#" % centimetres(number))
            if number % AT_ONCE == AT_ONCE - 1:
                newest = round(centimetres(number) / 100, 4)
                wait_for(lambda newest=newest: self.newest_m() == newest, "all have come")

    def newest_m(self) -> float | None:
        """Return the last distance, None if the gateway has none or does not answer in time."""
        found = [each.range_m for each in self.get("fleet/red/sensor/range") if not isinstance(each, str)]
        return found[0] if found else None

    def close(self) -> None:
        super().close()
        self.car.close()


@pytest.fixture(scope="module")
def remembered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Remembered]:
    fleet = Remembered(free_endpoint(), tmp_path_factory.mktemp("remembered"))
    try:
        yield fleet
    finally:
        fleet.close()


def get(fleet: FleetProcesses, *arguments: str) -> "subprocess.CompletedProcess[bytes]":
    command = [sys.executable, "-m", "fleet.cli", "get", *arguments, "--connect", fleet.endpoint]
    return subprocess.run(command, capture_output=True, timeout=60, check=False)


def newest(count: int) -> list[float]:
    return [round(centimetres(number) / 100, 4) for number in range(SENT - count, SENT)]


def test_last_so_many_come_oldest_first(remembered: Remembered) -> None:
    done = get(remembered, "red/sensor/range", "--last", "100", "--json")
    assert done.returncode == 0
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["value"]["range_m"] for row in rows] == newest(100)
    assert done.stderr == b""
    lines = get(remembered, "red/sensor/range", "--last", "2").stdout.decode().splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("fleet/red/sensor/range  range_m=1.")
    assert lines[0].endswith(" s ago"), "of the past nobody expects that it is fresh"


def test_csv_has_units_in_header_and_follows_rfc_4180(remembered: Remembered) -> None:
    done = get(remembered, "red/sensor/range", "--last", "100", "--csv")
    assert done.returncode == 0
    assert done.stdout.count(b"\r\n") == done.stdout.count(b"\n") == 101
    rows = list(csv.DictReader(io.StringIO(done.stdout.decode(), newline="")))
    assert list(rows[0]) == ["time", "key", "car", "seq", "range_m", "no_echo"]
    assert [float(row["range_m"]) for row in rows] == newest(100)
    assert {(row["key"], row["car"], row["no_echo"]) for row in rows} == {("fleet/red/sensor/range", "red", "false")}
    assert all(datetime.fromisoformat(row["time"]).utcoffset() == timedelta(0) for row in rows)
    header = get(remembered, "*/sensor/grayscale", "--csv").stdout.splitlines()
    assert header[0] == b"time,key,car,seq,raw_count"
    assert header[1].endswith(b",214")


def test_get_last_and_since_report_missing_history(remembered: Remembered) -> None:
    done = get(remembered, "red/sensor/range", "--last", "5000", "--json")
    assert (done.returncode, done.stdout.count(b"\n")) == (0, HISTORY)
    assert done.stderr.startswith(b"fleet: fleet/red/sensor/range: 1500 of 5000, ")
    done = get(remembered, "red/sensor/range", "--since", "1h", "--csv")
    assert done.stdout.count(b"\n") == HISTORY + 1
    assert b" s of 3600 s, " in done.stderr
    done = get(remembered, "red/state/mode", "--last", "5")
    assert (done.returncode, done.stdout.count(b"\n")) == (0, 1)
    assert b"latest value" in done.stderr


def test_several_keys_each_keep_their_order(remembered: Remembered) -> None:
    with Client(remembered.endpoint) as client:
        readings = client.history("red", last=50)
    keys = [reading.key for reading in readings]
    assert keys == sorted(keys)
    assert len(set(keys)) > 3
    for one, other in pairwise(readings):
        assert one.key != other.key or one.value.seq + 1 == other.value.seq


def test_any_zenoh_client_gets_the_same(remembered: Remembered) -> None:
    """Zenoh's own client with its defaults gets one answer for each key, unless the query has a time range."""
    config = zenoh.Config.from_json5('{mode: "client"}')
    config.insert_json5("connect/endpoints", json.dumps([remembered.endpoint]))
    with zenoh.open(config) as session:

        def ask(parameters: str, **more: Any) -> list[Any]:
            answers = [answer.ok for answer in session.get(f"fleet/red/sensor/range?{parameters}", **more)]
            if "format=json" in parameters:
                assert {str(answer.encoding) for answer in answers} == {"application/json"}
                return [json.loads(answer.payload.to_string())["range_m"] for answer in answers]
            assert {str(answer.encoding) for answer in answers} <= {"application/protobuf;fleet.v1.Range"}
            return [pb.Range.FromString(answer.payload.to_bytes()).range_m for answer in answers]

        assert ask("_time=[now(-1h)..]") == newest(HISTORY)
        assert ask("_time=[now(-1h)..];last=100") == newest(100)
        assert ask("_time=[now(-1h)..];last=3;format=json") == newest(3)
        assert ask("last=100;format=json", consolidation=zenoh.ConsolidationMode.NONE) == newest(100)
        assert ask("_time=[now(1h)..]") == []


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        ("red --csv", 2, "--csv … fleet/red/sensor/* … sensor/range, sensor/battery"),
        ("red/sensor/rang --csv", 2, "red/sensor/rang. … mean red/sensor/range?"),
        ("red/sensor/range --csv --json", 2, "--csv and --json "),
        ("red/sensor/range --last 0", 2, "--last: 0 … 1"),
        ("red/sensor/range --last ten", 2, '--last: "ten" … whole number'),
        ("red/sensor/range --since noon", 2, "--since: 'noon' … time. … 30s or 5m (ago), 14:05 (local), "),
        ("red/sensor/range --since 2100-01-01", 2, "--since: 2100-01-01 … "),
        ("red/sensor/range --since 2020-01-01", 2, "--since: 2020-01-01 … 168h"),
        ("red/sensor/range --since 8760h", 2, "--since: 8760h … 168h"),
        ("red/event/command --last 3", 2, "no history of event/command, … sensor/*"),
        ("red/sensor/arm --last 3", 1, "nothing under fleet/red/sensor/arm; red has sensor/battery"),
        ("purple/sensor/range --since 1m", 1, 'No car "purple". … : red.'),
    ],
)
def test_get_history_errors_are_one_line(remembered: Remembered, arguments: str, code: int, told: str) -> None:
    done = get(remembered, *arguments.split())
    assert (done.returncode, done.stdout) == (code, b"")
    assert has_parts(done.stderr.decode(), told)
    assert done.stderr.count(b"\n") == 1


def test_get_survives_closed_pipe(remembered: Remembered) -> None:
    command = [sys.executable, "-m", "fleet.cli", "get", "red", "--last", "1500", "--connect", remembered.endpoint]
    with running(command) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) == 1


# ---------------------------------------------------------------------- pure


@pytest.mark.parametrize(
    ("last", "since_s", "selector"),
    [
        (100, None, "fleet/red/sensor/range?last=100"),
        (None, 30.0, "fleet/red/sensor/range?_time=[now(-30.000000s)..]"),
        (5, 0.25, "fleet/red/sensor/range?_time=[now(-0.250000s)..];last=5"),
    ],
)
def test_how_a_history_is_asked_for(last: int | None, since_s: float | None, selector: str) -> None:
    assert history_query.selector("fleet/red/sensor/range", last=last, since_s=since_s) == selector


@pytest.mark.parametrize(
    ("last", "since_s"),
    [(None, None), (0, None), (1.5, None), (2.0, None), (True, None), (None, 0.0), (None, float("nan"))],
)
def test_history_of_nothing_is_refused(last: Any, since_s: float | None) -> None:
    with pytest.raises(ValueError, match=r"needs last|not allowed"):
        history_query.selector("fleet/red/sensor/range", last=last, since_s=since_s)


def readings(count: int, newest_s: float = 0.0, topic: str = "sensor/range") -> list[Reading]:
    """Return readings with one second between them."""
    return [
        Reading(f"fleet/red/{topic}", NOW - timedelta(seconds=newest_s + count - 1 - each), pb.Range(seq=each))
        for each in range(count)
    ]


def numbered(*seqs: int, key: str = "fleet/red/sensor/range", boot: str = "a") -> list[Reading]:
    return [Reading(key, NOW + timedelta(seconds=seq), pb.Range(seq=seq, boot_id=boot)) for seq in seqs]


def test_merged_history_answers_fill_gaps() -> None:
    blue = numbered(7, key="fleet/blue/sensor/range", boot="b")
    first, second = numbered(1, 2, 5) + blue, numbered(2, 3, 4, 5, 6)
    assert history_query.gaps(history_query.merge(first, [])) == {"fleet/red/sensor/range": 2}
    assert history_query.merge(first, second) == blue + numbered(1, 2, 3, 4, 5, 6)
    assert history_query.gaps(history_query.merge(first, second)) == {}
    assert history_query.merge(first, second, last=3) == blue + numbered(4, 5, 6)
    assert history_query.gaps(numbered(900) + numbered(3, boot="z")) == {}, "a gateway that began anew counts anew"
    told = history_query.describe_shortfalls(numbered(1, 2, 5), NOW, last=3)
    (line,) = told
    assert line.startswith("fleet/red/sensor/range: 2 ")


@pytest.mark.parametrize(
    ("count", "last", "since_s", "told"),
    [
        (40, 40, None, []),
        (40, 100, None, ["fleet/red/sensor/range: 40 of 100, "]),
        (1500, 2000, None, ["fleet/red/sensor/range: 1500 of 2000, … 1500"]),
        (1500, None, 1499.0, []),
        (1500, None, 2000.0, ["fleet/red/sensor/range: … 1499.0 s of 2000 s, … 1500"]),
        (40, None, 2000.0, []),  # the car may have begun then, or measured nothing before
        (40, 100, 60.0, []),
        (1500, 1500, 2000.0, []),  # all requested readings are there
    ],
)
def test_history_shortfalls_in_words(count: int, last: int | None, since_s: float | None, told: list[str]) -> None:
    found = history_query.describe_shortfalls(readings(count), NOW, last=last, since_s=since_s)
    assert len(found) == len(told)
    assert all(has_parts(each, parts) for each, parts in zip(found, told, strict=True))


def test_csv_columns_do_not_depend_on_measured_fields() -> None:
    arm = [Reading("fleet/red/sensor/arm", NOW, pb.Arm(car="red", joint_deg=joints)) for joints in ([90, 45.5], [1])]
    lines = table(arm, topics.TOPICS["sensor/arm"]).split("\r\n")
    assert lines == [
        "time,key,car,seq,joint_deg_1,joint_deg_2",
        "2026-11-21T12:00:00.000000Z,fleet/red/sensor/arm,red,0,90.0,45.5",
        "2026-11-21T12:00:00.000000Z,fleet/red/sensor/arm,red,0,1.0,",
        "",
    ]
    silent = [Reading("fleet/red/sensor/range", NOW, pb.Range(car="red", seq=2**63, no_echo=True))]
    assert table(silent, topics.TOPICS["sensor/range"]).endswith(",red,9223372036854775808,,true\r\n")
    mode = [Reading("fleet/red/state/mode", NOW, pb.Mode(asked="manual", evidence='a "b", c', candidates=["x", "y"]))]
    row = next(csv.DictReader(io.StringIO(table(mode, topics.TOPICS["state/mode"]), newline="")))
    assert (row["evidence"], row["candidates"], row["evidence_age_s"]) == ('a "b", c', '["x", "y"]', "")
    safety = pb.Safety(motors="off")
    safety.hold.by = "ann"
    row = next(
        csv.DictReader(
            io.StringIO(table([Reading("fleet/red/state/safety", NOW, safety)], topics.TOPICS["state/safety"]))
        )
    )
    assert (row["hold"], row["lease"], row["worst_stop_s"]) == ('{"by": "ann"}', "", "")
    motion = [Reading("fleet/red/state/motion", NOW, pb.Motion(motion="stop"))]
    row = next(csv.DictReader(io.StringIO(table(motion, topics.TOPICS["state/motion"]))))
    assert (row["speed"], row["servo_deg"]) == ("0.0", "")


def test_every_units_column_is_named_once() -> None:
    truth = table([Reading("fleet/red/sim/truth", NOW, pb.Truth())], topics.TOPICS["sim/truth"]).split("\r\n")[0]
    assert truth == "time,key,car,seq,x_m,y_m,heading_rad,mode,motor_left_pwm,motor_right_pwm,blocked,fan,led"
    link = table([Reading("fleet/red/state/link", NOW, pb.Link())], topics.TOPICS["state/link"]).split("\r\n")[0]
    assert "rx_bytes,tx_bytes,rx_frames" in link
    assert "tx_airtime,since_s,last_rx_s" in link

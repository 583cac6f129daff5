"""Columns of the mode beside readings, and the times in which a reading does not exist in the mode of a car."""

from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from fleet import Session
from fleet.recording.tools.analysis import NoTable
from fleet.recording.tools.mode_spans import ModeSpan, does_exist, mode_spans, sensor_of, spans_without
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Mode, Platform
from tests.fleet.replay.make_session import START_NS, Made

S = 1_000_000_000


def states(*rows: tuple[float, str, str, str], car: str = "red") -> list[dict[str, Any]]:
    names = ("asked", "inferred", "verdict")
    return [
        {"car": car, "publish_time": round(at_s * S), **dict(zip(names, words, strict=True))} for at_s, *words in rows
    ]


AVOIDING = ("obstacle_avoidance", "unknown", "assumed")
MANUAL = ("manual", "manual", "confirmed")
TRACKING = ("tracking", "tracking", "confirmed")


def test_span_lasts_until_the_next_mode() -> None:
    rows = states((0, *MANUAL), (1, *AVOIDING), (2, *AVOIDING), (3.5, *MANUAL), (4, *MANUAL))
    assert list(mode_spans(rows)) == [
        ModeSpan("red", Mode.MANUAL, 0, S),
        ModeSpan("red", Mode.OBSTACLE_AVOIDANCE, S, 3 * S + S // 2),
        ModeSpan("red", Mode.MANUAL, 3 * S + S // 2, 4 * S),
    ]
    assert spans_without("range", rows) == [ModeSpan("red", Mode.OBSTACLE_AVOIDANCE, S, 3 * S + S // 2)]


def test_silent_gateway_ends_mode_span_when_stale() -> None:
    rows = states((0, *AVOIDING), (1, *AVOIDING), (10, *AVOIDING), (12, *AVOIDING))
    assert [(span.begin_ns, span.end_ns) for span in mode_spans(rows)] == [(0, 4 * S), (10 * S, 12 * S)]


def test_where_the_car_contradicts_its_mode_is_what_it_shows() -> None:
    rows = states((0, "obstacle_avoidance", "manual", "contradicted"), (1, "manual", "unknown", "contradicted"))
    assert [(span.mode, span.end_ns) for span in mode_spans(rows)] == [(Mode.MANUAL, S)]
    assert list(mode_spans(states((0, "unknown", "unknown", "assumed"), (1, "a new mode", "", "confirmed")))) == []


def test_cars_have_their_own_spans() -> None:
    rows = states((0, *AVOIDING), (2, *AVOIDING)) + states((0, *TRACKING), (2, *TRACKING), car="blue")
    rows.sort(key=lambda row: row["publish_time"])
    assert [(span.car, span.mode) for span in spans_without("range", rows)] == [
        ("blue", Mode.TRACKING),
        ("red", Mode.OBSTACLE_AVOIDANCE),
    ]
    assert [span.car for span in spans_without("line", rows)] == ["red"]


@pytest.mark.parametrize("mode", [each for each in Mode if each is not Mode.MANUAL])
@pytest.mark.parametrize("platform", list(Platform))
def test_no_car_reports_more_in_a_mode_than_is_said(mode: Mode, platform: Platform) -> None:
    assert all(does_exist(sensor, mode) for sensor in parse_platform(platform).measurable(mode))


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("sensor/range", "range"),
        ("red/sensor/range", "range"),
        ("fleet/*/sensor/line", "line"),
        ("fleet.v1.Range", "range"),
        ("Battery", "battery"),
        ("state/mode", ""),
        ("sensor/*", ""),
    ],
)
def test_names_of_a_sensor(name: str, sensor: str) -> None:
    assert sensor_of(name) == sensor


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """Make a session of two cars: red avoids obstacles from 3 to 6 s and is silent then, blue stays in manual mode."""
    made = Made(tmp_path / "0001.mcap", Writer)
    for second in range(10):
        avoids = 3 <= second < 6
        for car in ("blue", "red"):
            words = AVOIDING if avoids and car == "red" else MANUAL
            state = pb.Mode(asked=words[0], inferred=words[1], verdict=words[2])
            made.put(f"fleet/{car}/state/mode", state, second)
            if words is MANUAL:
                made.put(f"fleet/{car}/sensor/range", pb.Range(range_m=1.0), second + 0.5)
    made.close()
    return Session(tmp_path)


def test_reading_has_the_mode_as_commanded_and_as_seen(session: Session) -> None:
    with pytest.warns(UserWarning, match=r"sensor/range does not exist in some modes.*: red 3\.0 s in obstacle_avoid"):
        table = session.joined("sensor/range", "state/mode")
    assert set(table["mode"]) == set(table["mode_seen"]) == {"manual"}
    assert len(table) == 17
    every = session.joined("state/mode", "state/mode")
    red = every[every["car"] == "red"]
    assert list(red["mode"]) == [*["manual"] * 3, *["obstacle_avoidance"] * 3, *["manual"] * 4]
    assert list(red["mode_seen"].isna()) == [False] * 3 + [True] * 3 + [False] * 4
    assert "mode" not in session.joined("sensor/range", "sensor/battery").columns


def test_times_without_a_reading_are_a_table(session: Session) -> None:
    table = session.times_without("sensor/range")
    assert list(table.columns) == ["car", "mode", "begin", "end"]
    (row,) = table.itertuples()
    assert (row.car, row.mode) == ("red", "obstacle_avoidance")
    assert (row.begin.value - START_NS, row.end.value - START_NS) == (3 * S, 6 * S)
    assert len(session.times_without("blue/sensor/range")) == 0
    assert len(session.times_without("red/sensor/range")) == 1
    session.joined("blue/sensor/range", "state/mode")  # no warning
    with pytest.raises(NoTable):
        session.times_without("state/mode")

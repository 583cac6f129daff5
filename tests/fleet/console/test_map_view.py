"""Where a map draws the cars: from truth and measured poses, live and at any moment of a recording."""

import math
import random
from pathlib import Path
from typing import Any

import pytest

from fleet.console.map_view import SHOWN_S, TRAIL_S, TRAIL_STEP_S, MapView
from fleet.console.past_worker import answer
from fleet.recording.reading.session import Session
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.fleet.replay.make_session import START_NS, make
from tests.support.soaks import only_in_soak
from tests.support.sorted_writer import SortedWriter

SECONDS = 120
TRUTH, POSE = "sim/truth", "sensor/pose"
S = 1_000_000_000


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("map") / "made.mcap"
    make(made, SECONDS, SortedWriter)
    return made


def told_by_tables(tables: dict[str, Any], at_ns: int) -> dict[str, list[Any]]:
    """Return what the tables of a session say about the places of the cars at a moment, as a page gets it."""
    told: dict[str, list[Any]] = {}
    for topic, frame in ((POSE, None), (TRUTH, "")):
        table, stale_s = tables[topic], TOPICS[topic].stale_after_s or 0.0
        logged = table["log_time"].astype("int64")
        for car, rows in table[(logged <= at_ns) & (logged > at_ns - SHOWN_S * S)].groupby("car"):
            row = rows.loc[rows["publish_time"].astype("int64").idxmax()]
            age_s = (at_ns - int(logged.loc[row.name])) / 1e9
            place = [round(row[name], 3) for name in ("x_m", "y_m", "heading_rad")]
            where = row["frame"] if frame is None else frame
            std = round(row["xy_std_m"], 3) if topic == POSE else None
            told[str(car)] = [*place, where, std, int(age_s) if age_s > stale_s else None]
    return told


@pytest.mark.parametrize("count", [25, *only_in_soak([100])])
def test_map_places_equal_tables_at_random_moments(path: Path, count: int) -> None:
    session, chance = Session(path), random.Random(31)
    tables = {topic: session.to_pandas(topic) for topic in (TRUTH, POSE)}
    compared = 0
    for _ in range(count):
        at_ms = START_NS // 1_000_000 + chance.randrange(-5_000, (SECONDS + 40) * 1000)
        question = {"path": str(path), "at_ms": at_ms, "colors": {}, "car": "", "series": [], "span_s": 0, "map": True}
        found = answer(question)["map"]["cars"]
        assert found == told_by_tables(tables, at_ms * 1_000_000), at_ms
        compared += len(found)
    assert compared > count * 2


def truth(x_m: float) -> pb.Truth:
    return pb.Truth(x_m=x_m, y_m=1.0, heading_rad=math.pi / 2)


def test_map_shows_measured_pose_with_error_and_prefers_truth() -> None:
    view = MapView()
    view.on_message("red", POSE, pb.Pose(frame="map", x_m=1.23456, y_m=2, heading_rad=-1, xy_std_m=0.05), 10.0)
    view.on_message("blue", POSE, pb.Pose(x_m=1), 10.0)
    assert view.places(10.5) == {
        "blue": [1.0, 0.0, 0.0, "map", None, None],
        "red": [1.235, 2.0, -1.0, "map", 0.05, None],
    }
    view.on_message("red", TRUTH, truth(5.0), 11.0)
    view.on_message("red", POSE, pb.Pose(frame="map", x_m=1), 11.5)
    assert view.places(11.5)["red"] == [5.0, 1.0, 1.571, "", None, None]
    view.on_message("red", POSE, pb.Pose(frame="map", x_m=1), 13.0)
    assert view.places(13.0)["red"][3] == "map", "its simulator has ended"
    view.keep({"red"})
    assert sorted(view.places(13.0)) == ["red"]
    view.on_message("red", "sensor/range", pb.Range(range_m=1), 14.0)
    assert view.places(14.0)["red"][0] == 1.0


def test_old_place_has_its_age_and_is_forgotten() -> None:
    view = MapView()
    view.on_message("red", TRUTH, truth(5.0), 0.0)
    assert {at: [place[5] for place in view.places(at).values()] for at in (0.9, 1.5, 29.9, 30.1)} == {
        0.9: [None],
        1.5: [1],
        29.9: [29],
        30.1: [],
    }


def test_map_trail_is_bounded_and_standing_car_adds_nothing() -> None:
    view = MapView()
    for number in range(20_000):
        view.on_message("red", TRUTH, truth(number / 100), number / 100)
        view.on_message("blue", TRUTH, truth(3.0), number / 100)
    trails = view.trails(200.0)
    assert TRAIL_S / TRAIL_STEP_S - 2 <= len(trails["red"]) <= TRAIL_S / TRAIL_STEP_S + 1
    assert "blue" not in trails or len(trails["blue"]) == 1
    assert [at for at, _, _ in view.trails(200.0, 199.0)["red"]] == [199250, 199500, 199750]
    view.on_message("red", POSE, pb.Pose(frame="map", x_m=1), 300.0)
    assert view.trails(300.0) == {"red": [(300_000, 1.0, 0.0)]}, "it counts from another origin"


def test_floor_is_told_while_its_simulation_runs() -> None:
    view = MapView()
    assert view.world(0.0) is None
    point = pb.SimPoint(x_m=1, y_m=2)
    lamp = pb.SimLamp(name="x" * 1000, x_m=1, on=True)
    world = pb.World(walls=[pb.SimWall(begin=point, end=point)] * 3000, line=[point], lamps=[lamp])
    view.on_message("", "@sim/world", world, 10.0)
    found = view.world(12.0)
    assert found is not None
    assert (len(found["walls"]), found["line"], len(found["lamps"][0][0])) == (2000, [[1.0, 2.0]], 64)
    assert view.world(14.0) is None

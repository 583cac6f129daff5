"""What the pages show of a moment of a recording, and the questions for it."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from fleet.console.car_view import SILENT_AFTER_S
from fleet.console.page_requests import BadPageMessage
from fleet.console.past_api import moment_question
from fleet.console.past_view import PLOT_SLOTS, cars_at, lanes_as_dict, samples_of
from fleet.console.past_worker import answer
from fleet.console.plot_buffer import Series
from fleet.recording.reading.session import Session
from fleet.recording.tools.lanes import Lanes
from fleet.recording.tools.moment import Known, known_at
from schemas import keys
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.replay.make_session import START_NS, make

S = 1_000_000_000
RANGE = ("red", "sensor/range", "range_m")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("past") / "made.mcap"
    make(path)
    return path


def known(topic: str, message: Any, at_s: float, car: str = "red") -> Known:
    return Known(keys.Key("fleet", car, topic), message, round(at_s * S), round(at_s * S))


def question(path: Path, at_s: float, **more: Any) -> dict[str, Any]:
    return {
        "path": str(path),
        "at_ms": (START_NS + at_s * S) // 1_000_000,
        "colors": {},
        "car": "",
        "series": [],
        **more,
    }


@pytest.mark.parametrize(
    ("at_s", "car", "motion", "mode", "hold", "link"),
    [
        (2.5, "red", "stop", "manual", None, "online"),
        (4.5, "red", "forward", "manual", None, "online"),
        (6.9, "red", "stop", "manual", "ann", "online"),
        (8.9, "green", "stop", "tracking", None, "lost"),
        (15.5, "blue", "stop", "obstacle_avoidance", None, "quiet"),
    ],
)
def test_moment_is_shown_as_the_live_page_would(
    session: Path, at_s: float, car: str, motion: str, mode: str, hold: str | None, link: str
) -> None:
    found = answer(question(session, at_s))
    assert [each["name"] for each in found["cars"]] == ["blue", "green", "red"]
    (shown,) = [each for each in found["cars"] if each["name"] == car]
    assert shown["gateway"]
    assert (shown["motion"]["motion"], shown["mode"]["asked"], shown["hold"], shown["link"]["state"]) == (
        motion,
        mode,
        hold,
        link,
    )


def test_car_is_gone_after_last_message_then_forgotten(session: Path) -> None:
    # The last states are of second 19.
    shown = {at_s: answer(question(session, at_s))["cars"] for at_s in (21, 30, 60)}
    assert [each["gateway"] for each in shown[21]] == [True] * 3
    assert [(each["gateway"], 6 <= each["gone_s"] <= 8) for each in shown[30]] == [(False, True)] * 3
    assert all(each["silent_s"] > SILENT_AFTER_S for each in shown[30])
    assert shown[60] == []


def test_past_view_lists_commands_and_frames_before_moment(session: Path) -> None:
    detail = answer(question(session, 4.5, car="red"))["detail"]
    assert [each["requested"] for each in detail["commands"]] == ["led by ann (person)", "drive by ann (person)"]
    assert {each["text"] for each in detail["frames"]} == {"$1,0,0,0,0,0,0,0,0#"}
    assert detail["car"] == "red"
    assert "connected to /dev/pts/3" in [each["words"] for each in detail["ledger"]]
    assert len(answer(question(session, 6.4, car="red"))["detail"]["commands"]) == 3
    rows = dict(answer(question(session, 4.5, car="red"))["detail"]["gateway"])
    assert rows["platform"] == "arduino"


def test_past_plot_values_are_of_their_time_one_per_slot(session: Path) -> None:
    samples = answer(question(session, 4.5, series=[RANGE], span_s=3))["samples"]
    assert [round((at_ms - START_NS // 1_000_000) / 100) for at_ms, _ in samples[0]] == [21, 31, 41]
    many = (known("sensor/range", pb.Range(range_m=number / 10), number / 1000) for number in range(10_000))
    (values,) = samples_of([Series(*RANGE)], many, 0, 10 * S).values()
    assert len(values) <= PLOT_SLOTS + 1
    assert values[-1] == (9999, 999.9)


def test_past_map_has_places_trails_and_floor(session: Path) -> None:
    found = answer(question(session, 10.5, map=True))["map"]
    assert sorted(found["cars"]) == ["blue", "green", "red"]
    assert {place[3] for place in found["cars"].values()} == {""}, "the truth goes before what is measured"
    assert found["world"]["walls"][0] == [-2, 2, -2, -2]
    assert found["world"]["lamps"] == [["beacon", 1.5, 1.5, False]]
    assert all(len(points) > 5 for points in found["trails"].values())
    ages = [found["cars"]["red"][5], *(answer(question(session, at, map=True))["map"] for at in (25, 60))]
    assert ages[0] is None
    assert ages[1]["cars"]["red"][5] in (5, 6), "it is told how old the last place is"
    assert ages[1]["world"] is None
    assert ages[2] == {"cars": {}, "trails": {}, "world": None}
    assert "map" not in answer(question(session, 10.5))


def test_past_plan_is_last_one_put_in_force(session: Path) -> None:
    found = {at: answer(question(session, at, plan=True))["plan"] for at in (-1, 15)}
    assert found[-1]["plan"] is None
    assert found[15]["plan"]["text"]
    assert {car for role in found[15]["roles"] for car in role["cars"]} <= {"red", "green", "blue"}
    assert [each["decided"] for each in found[15]["decisions"]]


def test_names_and_numbers_that_are_none_reach_no_page() -> None:
    odd = [
        known("state/motion", pb.Motion(motion="stop", speed=math.nan), 1),
        known("state/mode", pb.Mode(asked="manual"), 1, "<b>"),
        known("state/mode", pb.Mode(asked="manual"), 1, "\u202ered"),
        known("state/mode", pb.Mode(asked="manual"), 1),
    ]
    found = cars_at(odd, 2 * S, {"red": "#010203"})
    assert [(each["name"], each["color"]) for each in found] == [("red", "#010203")]
    json.dumps(found, allow_nan=False)
    lanes = Lanes()
    for each in odd:
        lanes.add(each.key.car, each.key.topic, each.message, each.log_ns)
    assert {span[0] for span in lanes_as_dict(lanes, 2 * S)["spans"]} == {"red"}


def test_past_lanes_have_times_and_marks(session: Path) -> None:
    found = answer({"path": str(session)})
    assert found["ok"]
    assert found["cars"] == ["blue", "green", "red"]
    assert (found["begin_ms"] - START_NS // 1_000_000, found["marks"][0][1]) == (1, "here it gets interesting")
    said = {(car, lane, words) for car, lane, _, _, words, _ in found["spans"]}
    assert {("red", "mode", "tracking"), ("green", "loss", "lost"), ("red", "hold", "e-stop by ann: too close")} <= said
    assert ("red", "stop", "stop by ann complete") in said
    assert answer({"path": str(session.parent / "none.mcap")})["ok"] is False


def test_damaged_session_says_what_is_lost(session: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[:-2000])
    found = answer(question(cut, 2.5))
    assert (found["ok"], len(found["cars"]), found["words"]) == (True, 3, ""), "it may be growing"
    bad = bytearray(session.read_bytes())
    bad[3000:3010] = b"\0" * 10
    (tmp_path / "bad.mcap").write_bytes(bytes(bad))
    assert "damaged" in answer(question(tmp_path / "bad.mcap", 2.5))["words"]


def test_questions_of_a_page() -> None:
    asked = {"at_ms": 1000.7, "car": "red", "span_s": 60, "series": [list(RANGE)], "more": 1}
    plain = {"at_ms": 5, "car": "", "span_s": 0.0, "map": False, "plan": False, "series": []}
    assert moment_question(json.dumps(asked)) == plain | {
        "at_ms": 1000,
        "car": "red",
        "span_s": 60.0,
        "series": [RANGE],
    }
    assert moment_question('{"at_ms": 5}') == plain
    assert moment_question('{"at_ms": 5, "map": true, "plan": true}') == plain | {"map": True, "plan": True}


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "x", "{" * 100_000, '{"at_ms": -1}', '{"at_ms": "1"}', '{"at_ms": true}', '{"at_ms": NaN}',
        '{"at_ms": 1e300}',
        '{"at_ms": 1, "car": "*"}', '{"at_ms": 1, "car": 5}', '{"at_ms": 1, "car": "../x"}',
        '{"at_ms": 1, "span_s": 1e9}',
        '{"at_ms": 1, "series": [["*", "sensor/range", "range_m"]]}', '{"at_ms": 1, "series": 5}',
    ],
)  # fmt: skip
def test_bad_questions_are_refused(text: str) -> None:
    with pytest.raises(BadPageMessage):
        moment_question(text)


def test_known_messages_are_in_the_order_of_their_recording(session: Path) -> None:
    times = [each.log_ns for each in known_at(Session(session), START_NS + 10 * S)]
    assert times == sorted(times)
    assert len(times) > 30

"""Recorded frames against today's decoder: recorded vectors have no difference, and each change is found."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from mcap.writer import Writer
from msgspec.structs import replace

from fleet.cli import cli
from fleet.recording.reading.session import Recorded
from fleet.replay.analysis import vector_file
from fleet.replay.analysis.recorded_frames import (
    SORTED_NS,
    Item,
    KnownMode,
    KnownPlatform,
    Rx,
    SkippedMessages,
    Tx,
    of_session,
)
from fleet.replay.analysis.redecode import ReadingDifference, Redecoding
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Mode
from tests.fleet.replay.make_session import Made, make

VECTORS = sorted((Path(__file__).parents[3] / "vectors" / "recorded").glob("*.jsonl"))
FOLLOWING = b"$4WD,CSB120,PV8.3,GS000,LF0000,HW00,GM00"
TRACKING = b"$4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#"
LINE = {"sensor/line": {"left_outer": False, "left_inner": True, "right_inner": True, "right_outer": False}}
S = 1_000_000_000


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def redecoded(items: list[Item], platform: str | None = None) -> tuple[list[ReadingDifference], Redecoding]:
    one = Redecoding("red", platform)
    found = [difference for item in items for difference in one.take(item)]
    return [*found, *one.end()], one


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
def test_recorded_vector_has_no_difference(path: Path) -> None:
    _, items = vector_file.read(path)
    found, one = redecoded(items)
    assert found == []
    assert one.counts.frames >= 3
    assert one.counts.undecided == 0 == one.counts.absent


def test_there_are_vectors() -> None:
    assert {"manual", "manual_no_echo", "tracking", "following", "raspberry_pi"} <= {path.stem for path in VECTORS}


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
def test_every_field_of_a_vector_counts(path: Path) -> None:
    """Any change in the readings of a recorded frame is found and named."""
    _, items = vector_file.read(path)
    frames = [number for number, item in enumerate(items) if isinstance(item, Rx) and item.readings]
    changed = 0
    for number in {frames[0], frames[-1]}:
        frame = items[number]
        assert isinstance(frame, Rx)
        for topic, fields in frame.readings.items():
            for name, value in fields.items():
                other: Any = not value if isinstance(value, bool) else (0.0,) if isinstance(value, tuple) else value + 1
                readings = {**frame.readings, topic: {**fields, name: other}}
                found, _ = redecoded([*items[:number], replace(frame, readings=readings), *items[number + 1 :]])
                assert [(each.what, each.then, each.now) for each in found] == [(f"{topic} {name}", other, value)]
                changed += 1
    assert changed


def test_constants_may_have_been_published_or_not() -> None:
    """A recording does not say if the gateway took the car for an stm32 that sends constants."""
    frame = Rx(S, b"$4WD,CSB57.00,PV7.50,GS0,LF0000,HW00,GM00#", "sensors")
    left_out = {"sensor/range": {"no_echo": False, "range_m": 0.57}, "sensor/battery": {"voltage_v": 7.5}}
    sides = {"left": False, "right": False}
    more = {
        "sensor/grayscale": {"raw": 0},
        "sensor/line": dict.fromkeys(LINE["sensor/line"], False),
        "sensor/obstacle": sides,
        "sensor/light": sides,
    }
    for readings in (left_out, {**left_out, **more}):
        then = replace(frame, published=tuple(readings), readings=readings)
        found, one = redecoded([KnownPlatform(0, "arduino"), KnownMode(0, Mode.MANUAL), then])
        assert (found, one.counts.undecided) == ([], 1)


def test_redecode_of_verdict_and_unpublished_reading() -> None:
    known: list[Item] = [KnownPlatform(0, "arduino"), KnownMode(0, Mode.TRACKING)]
    frame = Rx(S, TRACKING, "sensors", ("sensor/line",), LINE)
    assert redecoded([*known, frame])[0] == []
    found, _ = redecoded([*known, replace(frame, verdict="bad_number", published=("sensor/light",), readings={})])
    assert [(each.what, each.then, each.now) for each in found] == [
        ("verdict", "bad_number", "sensors"),
        ("published", ("sensor/light",), ("sensor/line",)),
    ]


def test_echo_is_known_by_sent_bytes_for_two_seconds() -> None:
    sent = b"$1,0,0,0,0,0,0,0,0#"
    known: list[Item] = [KnownPlatform(0, "arduino"), KnownMode(0, None), Tx(3 * S, sent)]
    echo = Rx(4 * S, sent, "echo")
    assert redecoded([*known, echo])[0] == []
    late, _ = redecoded([*known, replace(echo, at_ns=6 * S)])
    assert [(each.what, each.now) for each in late] == [("verdict", "unknown_word")]
    # Frames from before the recording are unknown.
    assert redecoded([*known[:2], replace(echo, at_ns=S)])[0] == []
    assert len(redecoded([*known[:2], replace(echo, at_ns=3 * S)])[0]) == 1


def test_redecode_counts_what_recording_lacks_as_no_difference() -> None:
    """A frame of following without obstacles has the text of light seeking before its #."""
    seen = {"sensor/obstacle": {"left": True, "right": True}}
    frame = Rx(S, FOLLOWING, "sensors", ("sensor/obstacle",), seen)
    for then in (frame, replace(frame, published=(), readings={})):
        found, one = redecoded([KnownPlatform(0, "arduino"), KnownMode(0, None), then])
        assert (found, one.counts.undecided) == ([], 1)
    # A mode that was confirmed at the time of the frame.
    changing: list[Item] = [KnownPlatform(0, "arduino"), KnownMode(0, None), frame, KnownMode(S + 1, Mode.FOLLOWING)]
    assert redecoded(changing)[0] == []
    # Impossible readings are a difference in any case.
    wrong = replace(frame, readings={"sensor/obstacle": {"left": False, "right": True}})
    assert [each.what for each in redecoded([KnownPlatform(0, "arduino"), wrong])[0]] == ["sensor/obstacle left"]


def test_redecode_differences_equal_those_of_vector(tmp_path: Path) -> None:
    """In the generated session, most line readings differ from their frames."""
    session = tmp_path / "made.mcap"
    make(session, seconds=12)
    result = run("sessions", "redecode", session)
    assert result.exit_code == 1
    assert "+4.000s $4WD,CSB0,PV8,GS0,LF0110,HW00,GM00#: sensor/line " not in result.output.splitlines()[0]
    lines = [
        json.loads(line) for line in run("sessions", "redecode", session, "--json", "--car", "red").output.splitlines()
    ]
    summary = lines.pop()
    assert summary["frames"] == 40
    assert summary["readings"] == 40
    assert summary["differences"] == len(lines) > 5
    assert {each["what"] for each in lines} == {"sensor/line left_inner", "sensor/line right_inner"}
    assert {(each["car"], each["then"], each["now"]) for each in lines} == {("red", False, True)}

    out = tmp_path / "v.jsonl"
    assert run("sessions", "vector", session, "--car", "red", "--from", "5s", "--to", "7s", "--out", out).exit_code == 0
    of_it = [json.loads(line) for line in run("sessions", "redecode", out, "--json").output.splitlines()]
    assert of_it[-1]["frames"] == 20
    within = [each for each in lines if 5 <= each["at_s"] < 7]
    assert [(each["what"], round(each["at_s"], 3)) for each in of_it[:-1]] == [
        (each["what"], round(each["at_s"] - 5, 3)) for each in within
    ]


def test_cut_off_session_is_redecoded_as_far_as_it_goes(tmp_path: Path) -> None:
    session = tmp_path / "made.mcap"
    make(session)
    session.write_bytes(session.read_bytes()[:-9000])
    result = run("sessions", "redecode", session, "--json")
    summary = json.loads(result.output.splitlines()[-1])
    assert result.exit_code == 1  # the readings differ
    assert "made.mcap" in summary["damage"]
    assert summary["frames"] > 0


def bare(path: Path) -> Made:
    return Made(path, Writer)


def test_bad_input_is_told_in_a_line(tmp_path: Path) -> None:
    no_frames = tmp_path / "plan.mcap"
    made = bare(no_frames)
    made.put("fleet/@coordinator/plan", pb.Plan(text="fixed: {red: {mode: manual}}"), 1.0)
    made.put("fleet/red/state/mode", pb.Mode(asked="manual"), 1.0)
    made.close()
    assert "no raw frames" in run("sessions", "redecode", no_frames).output
    assert "its cars: red" in run("sessions", "redecode", no_frames, "--car", "blue").output
    assert "of red there" in run("sessions", "vector", no_frames, "--car", "red", "--out", tmp_path / "x.jsonl").output

    unknown = tmp_path / "unknown.mcap"
    made = bare(unknown)
    made.put("fleet/red/frame/rx", pb.RxFrame(data=TRACKING, verdict="sensors", published=["sensor/line"]), 1.0)
    made.close()
    assert "of red (no state/health)" in run("sessions", "redecode", unknown).output
    assert "--platform" in run("sessions", "redecode", unknown).output
    result = run("sessions", "redecode", unknown, "--platform", "arduino")
    assert result.exit_code == 0
    assert "1 published readings" in result.output

    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as file:
        writer: Any = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/odom", "json", 0), 5, b"{}", 5)
        writer.finish()
    assert "no raw frames" in run("sessions", "redecode", foreign).output
    assert run("sessions", "redecode", tmp_path / "none").exit_code == 1
    assert run("sessions", "redecode", unknown, "--platform", "tank").exit_code == 2
    other = run("sessions", "redecode", unknown, "--platform", "ugv_rover")
    assert other.exit_code == 2
    assert "ugv_rover" in other.output

    for text, words in (
        ("", "is not a vector"),
        ("{}\n", "is not a vector"),
        ("{\n", "line 1: this is not JSON"),
        ('{"format": 9, "car": "red"}\n', "reads up to 1: update it"),
        ('{"format": 1, "car": "red"}\n{"at_us": 1, "mode": "asleep"}\n', "line 2: ValueError"),
        ('{"format": 1, "car": "red"}\n{"at_us": 1, "rx": "$"}\n', "line 2: KeyError"),
        ('{"format": 1, "car": "red"}\n7\n', "line 2: TypeError"),
        ('{"format": 1, "car": "red"}\n{"at_us": 1e999, "tx": "a"}\n', "line 2: OverflowError"),
        ("[" * 200_000, "line 1: this is not JSON"),
    ):
        path = tmp_path / "bad.jsonl"
        path.write_text(text)
        result = run("sessions", "redecode", path)
        assert result.exit_code == 1
        assert words in result.output
    path = tmp_path / "there.jsonl"
    path.touch()
    assert "exists already" in run("sessions", "vector", unknown, "--car", "red", "--out", path).output
    assert "ends in .jsonl" in run("sessions", "vector", unknown, "--car", "red", "--out", tmp_path / "x.tsv").output


@pytest.mark.parametrize("ahead_s", [0, -3600, 3600])
def test_frames_are_in_order_by_the_clock_of_their_gateway(ahead_s: int) -> None:
    """The clock of a gateway may be wrong by an hour. That neither changes the order nor keeps all messages waiting."""
    arrived = 0

    def recorded() -> Iterator[Recorded]:
        nonlocal arrived
        for number in range(60):
            arrived += 1
            # Two messages a second, each second one overtaken by the one before.
            value = pb.RxFrame(data=TRACKING, verdict="sensors")
            value.stamp.FromNanoseconds((1000 + ahead_s) * S + (number + (1 if number % 2 else -1)) * S // 2)
            yield Recorded(
                "fleet/red/frame/rx", value.SerializeToString(), "fleet.v1.RxFrame", "protobuf",
                1000 * S + number * S // 2, 1000 * S + number * S // 2, number,
            )  # fmt: skip

    waiting, stamps = 0, []
    for _, item in of_session(recorded(), SkippedMessages()):
        stamps.append(item.at_ns)
        waiting = max(waiting, arrived - len(stamps))
    assert len(stamps) == 60
    assert stamps == sorted(stamps)
    assert waiting <= 2 * SORTED_NS // S + 2

"""Every recorded message is shown by `fleet replay`, or named with its key, count and cause."""

import math
import subprocess
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import rerun.chunk as rrc
from click.testing import CliRunner
from mcap.writer import IndexType

from fleet.commands.replay import replay
from fleet.recording.left_out import LeftOutCause
from fleet.recording.reading.session import NoSession, Session
from fleet.replay.rerun import rrd_export
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.random_session import LINK, LOG, RANGE, UNKNOWN_LEVEL, Mixed, make


def replayed(path: Path) -> rrd_export.Replayed:
    return rrd_export.export(Session(path), path.with_suffix(".rrd"))


@pytest.mark.parametrize("first", ["fleet.v1.Link", "fleet.v1.Range"])
def test_stray_message_hides_no_own_message_of_key(tmp_path: Path, first: str) -> None:
    # Rerun chooses a schema at random: once would prove nothing.
    for number in range(8):
        made = Mixed(path := tmp_path / f"{number}.mcap")
        if first == "fleet.v1.Range":
            made.stray(LINK, RANGE)
        made.own(LINK, 25)
        made.stray(LINK, RANGE)
        made.own(LINK, 25)
        made.close()
        found = replayed(path)
        assert found.shown == {LINK: 50}
        assert found.left_out.counts == {(LINK, LeftOutCause.OTHER_TYPE): made.counts[LINK] - 50}
        assert rrd_export.rows(path.with_suffix(".rrd")) == found.shown


def test_junk_is_named_by_its_cause(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    made.own(RANGE, 3)
    made.put(RANGE, "fleet.v1.Range", b"\xff\xff")
    made.put(RANGE, "", b"{}", "json")
    made.put("/imu", "", b"{}", "json")
    made.close()
    found = replayed(path)
    assert found.shown == {RANGE: 3}
    assert found.left_out.counts == {
        (RANGE, LeftOutCause.UNREADABLE): 1,
        (RANGE, LeftOutCause.NOT_PROTOBUF): 1,
        ("/imu", LeftOutCause.NOT_PROTOBUF): 1,
    }


ODD_NUMBERS = (math.inf, -math.inf, math.nan, 1e300)


def test_numbers_without_a_place_hide_nothing(tmp_path: Path) -> None:
    """One such message of any program on the bus ended the export with a traceback, or printed warnings of numpy."""
    made = Mixed(path := tmp_path / "x.mcap")
    wall = pb.SimWall(begin=pb.SimPoint(), end=pb.SimPoint(x_m=2.0))
    messages: list[tuple[str, Any]] = [("fleet/@sim/world", pb.World(walls=[pb.SimWall(), wall]))]
    for odd in (*ODD_NUMBERS, 1.0):
        messages += [
            ("fleet/red/sim/truth", pb.Truth(x_m=odd, heading_rad=odd)),
            ("fleet/red/sensor/pose", pb.Pose(y_m=odd, heading_rad=odd)),
            ("fleet/@sim/world", pb.World(lamps=[pb.SimLamp(x_m=odd)], things=[pb.SimThing(heading_rad=odd)])),
            ("fleet/@sim/world", pb.World(line=[pb.SimPoint(x_m=odd), pb.SimPoint()])),
        ]
    for key, message in messages:
        made.put(key, message.DESCRIPTOR.full_name, message.SerializeToString())
    counts = made.close()
    found = replayed(path)
    assert found.shown == counts
    assert not found.left_out.total
    chunks = list(rrc.RrdReader(path.with_suffix(".rrd")).store().stream())
    ways = {chunk.entity_path for chunk in chunks if chunk.entity_path.endswith("/way")}
    assert ways == {"/fleet/red/sim/truth/way", "/fleet/red/sensor/pose/way"}
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if chunk.entity_path in ways and "LineStrips3D:strips" in batch.schema.names:
            ((strip,),) = batch.column("LineStrips3D:strips").to_pylist()
            assert [list(map(float, point)) for point in strip] == [
                [1.0, 0.0, 0.0] if "truth" in chunk.entity_path else [0.0, 1.0, 0.0]
            ]


def test_level_without_a_name_does_not_end_the_process(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    made.own(LOG, 2)
    made.put(LOG, "foxglove.Log", UNKNOWN_LEVEL)
    made.close()
    # Rerun would abort the process of the tests.
    program = "import sys; from fleet.__main__ import main; sys.exit(main())"
    save = ["replay", str(path), "--save", str(path.with_suffix(".rrd"))]
    done = subprocess.run([sys.executable, "-c", program, *save], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert rrd_export.rows(path.with_suffix(".rrd")) == {LOG: 2}


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"index_types": IndexType.NONE}])
def test_files_that_reruns_reader_refuses_are_shown(tmp_path: Path, options: dict[str, object]) -> None:
    made = Mixed(path := tmp_path / "x.mcap", **options)
    made.own(RANGE, 5)
    made.close()
    found = replayed(path)
    assert (found.shown, found.left_out.total) == ({RANGE: 5}, 0)


def test_replay_without_fleet_message_is_no_traceback(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap", use_chunking=False)
    made.put("/imu/\x1b]0;pwn\x07data", "J", b"{}", "json")
    made.close()
    result = CliRunner().invoke(replay, [str(path), "--save", str(tmp_path / "x.rrd")])
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "\x1b" not in result.output
    assert not (tmp_path / "x.rrd").exists()


def test_part_counts_only_what_is_asked(tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    made.own(LINK, 4)
    made.stray(LINK, RANGE)
    made.own("fleet/blue/state/mode", 4)
    made.close()
    part = rrd_export.Part(cars=("red",))
    found = rrd_export.export(Session(path), tmp_path / "x.rrd", part)
    assert (found.shown, found.left_out.by_key()) == ({LINK: 4}, {LINK: 1})


def check(directory: Path, seed: int) -> None:
    make(path := directory / f"{seed}.mcap", seed)
    try:
        session = Session(path)
        recorded = Counter(row[0].channel.topic for row in session.rows())
        session.check()
        found = rrd_export.export(session, path.with_suffix(".rrd"))
    except NoSession:
        return
    named = found.left_out.by_key()
    assert {key: found.shown[key] + named.get(key, 0) for key in recorded} == recorded, seed
    assert not found.left_out.by_key().keys() - recorded, seed
    assert not found.shown.keys() - recorded, seed
    assert rrd_export.rows(path.with_suffix(".rrd")).total() <= found.shown.total(), seed
    path.unlink()
    path.with_suffix(".rrd").unlink()


def check_some(directory: Path, first: int, count: int) -> None:
    for seed in range(first, first + count):
        check(directory, seed)


@pytest.mark.parametrize("first", range(0, 60, 20))
def test_recorded_is_shown_and_named_in_files_of_chance(tmp_path: Path, first: int) -> None:
    check_some(tmp_path, first, 20)


def test_schema_that_only_rerun_refuses_costs_its_messages_only(tmp_path: Path) -> None:
    check(tmp_path, 827)  # one bit of the schema of a plan is another


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_recorded_is_shown_and_named_in_many_files(tmp_path: Path) -> None:
    # Rerun keeps two threads and their memory for each recording until the process ends: 8.5 GB for all of them.
    spawn = get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
        for first in range(0, 2000, 50):
            pool.submit(check_some, tmp_path, first, 50).result()

"""Time of a question about one topic to many sessions. The floor: plain DuckDB over the same Parquet files.

Once with all tables made, once after those of one session in a hundred are gone.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import duckdb
from mcap.writer import Writer

from fleet import Catalog
from fleet.recording.session_dir import SessionInfo
from fleet.recording.tools.table_cache import tables_of
from schemas.gen import fleet_v1_pb2 as pb
from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import scratch
from tests.fleet.replay.make_session import Made, drive_about

SESSIONS = 1000
ROWS = 10_000
"""Distances of a session: nearly three hours at one a second."""
FRAMES = 90_000
"""Frames of a session, which the question does not look at. So all sessions have 10^8 rows."""
DIFFERENT = 10
"""Sessions that are written. The others are hard links under other names: only their number matters to a question."""
QUESTION = "SELECT session, car, count(*) n, min(range_m) nearest FROM {} WHERE range_m < 0.5 GROUP BY ALL"
MAX_AFTER_LOSS_S = 20.0
"""Goal of issue 32."""


def _sessions(place: Path, count: int, rows: int, frames: int) -> None:
    """Write sessions with every topic of a car, and make their tables."""
    for number in range(count):
        session = place / f"s{number:04d}"
        if number >= DIFFERENT:
            shutil.copytree(place / f"s{number % DIFFERENT:04d}", session, copy_function=os.link)
            continue
        session.mkdir(parents=True)
        SessionInfo("fleet", "2026-01-01T00:00:00Z", "bench", {}, closed=True).write(session)
        made = Made(session / "0001.mcap", Writer)
        drive_about(made, "red", number, 5)
        for row in range(rows):
            made.put("fleet/blue/sensor/range", pb.Range(range_m=(row * (number + 7)) % 100 / 50), 10 + row)
        for row in range(frames):
            made.put("fleet/blue/frame/rx", pb.RxFrame(data=b"$4WD,CSB120,PV8.3#", verdict="sensors"), 10 + row / 9)
        made.close()
        tables_of(session)


def _timed(ask: Callable[[], int], expected: int) -> float:
    began = perf_counter()
    found = ask()
    took = perf_counter() - began
    assert found == expected
    return took


def _ours(place: Path) -> int:
    catalog = Catalog(place)
    try:
        return catalog.query(QUESTION.format("sensor_range")).num_rows
    finally:
        catalog.close()


def _plain(place: Path) -> int:
    """Ask as somebody would who knows the folders."""
    files = f"read_parquet('{place}/*/.tables-*/fleet.v1.Range.parquet', filename=true)"
    session = "regexp_extract(filename, '([^/]+)/[^/]+/[^/]+$', 1)"
    source = f"(SELECT {session} AS session, * FROM {files} WHERE key LIKE '%/sensor/range')"
    with duckdb.connect(config={"memory_limit": "1GB"}) as database:
        answer: Any = database.sql(QUESTION.format(source)).to_arrow_table()
        return int(answer.num_rows)


def run(scale: Scale) -> list[Measured]:
    with scratch() as directory:
        place = directory / "sessions"
        count = scale.count(SESSIONS, least=DIFFERENT)
        _sessions(place, count, scale.count(ROWS, least=100), scale.count(FRAMES))
        expected = _ours(place)

        def ours_after_loss() -> float:
            for session in sorted(place.iterdir())[::100]:
                for tables in session.glob(".tables-*"):
                    shutil.rmtree(tables)
            return _timed(lambda: _ours(place), expected)

        warm = in_turns(
            scale, lambda: _timed(lambda: _ours(place), expected), lambda: _timed(lambda: _plain(place), expected)
        )
        lossy = in_turns(scale, ours_after_loss, lambda: _timed(lambda: _plain(place), expected))
    return [
        Measured(f"one question to {count} sessions", tuple(warm[0]), tuple(warm[1]), "s", 1.5),
        Measured(
            "the same, 1 in 100 without tables", tuple(lossy[0]), tuple(lossy[1]), "s", 0.0, slack=MAX_AFTER_LOSS_S
        ),
    ]

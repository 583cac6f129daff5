"""Lanes end after the last message: not sooner, and only once, in any order of batches."""

from typing import Any

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs

from fleet.replay.rerun.staleness import LOG_TIMELINE, PUBLISH_TIMELINE, StaleStates

LINE = "/fleet/red/sensor/line"
STALE_S = 3
LANES = {f"line {side} {place}" for side in ("left", "right") for place in ("inner", "outer")}


def batch(*seconds: float) -> Any:
    at = np.array([int(second * 1e9) for second in seconds], dtype="datetime64[ns]")
    return pa.record_batch(
        {PUBLISH_TIMELINE: pa.array(at), LOG_TIMELINE: pa.array(at + np.timedelta64(1_000_000, "ns"))}
    )


def drawn(ends: StaleStates, now: float) -> list[float]:
    """Return the seconds at which lanes end."""
    found: list[float] = []
    for chunk in ends.chunks(int(now * 1e9)):
        made = chunk.to_record_batch()
        assert set(made.schema.names) >= LANES
        for name in LANES:
            assert all(row == [None] for row in made.column(name).to_pylist())
            assert made.schema.field(name).type.value_type == pa.bool_()
        published, logged = (
            made.column(name).cast(pa.int64()).to_pylist() for name in (PUBLISH_TIMELINE, LOG_TIMELINE)
        )
        assert [each + 1_000_000 for each in published] == logged
        found += [each / 1e9 for each in published]
    return found


def test_gaps_within_between_and_after_batches_end_lanes() -> None:
    ends = StaleStates()
    ends.add(LINE, "sensor/line", batch(1, 2, 10, 11))
    ends.add(LINE, "sensor/line", batch(20, 21))
    assert drawn(ends, 30) == [2 + STALE_S, 11 + STALE_S, 21 + STALE_S]
    assert drawn(ends, 40) == []


def test_lane_of_frequent_messages_does_not_end() -> None:
    ends = StaleStates()
    for start in range(0, 60, 6):
        ends.add(LINE, "sensor/line", batch(start, start + 3))
        assert drawn(ends, start + 3 + STALE_S) == []


def test_batches_may_come_in_any_order() -> None:
    ends = StaleStates()
    ends.add(LINE, "sensor/line", batch(16, 14, 15))
    ends.add(LINE, "sensor/line", batch(3, 1, 2))
    ends.add(LINE, "sensor/line", batch(0, 20))
    assert drawn(ends, 20) == [3 + STALE_S, 16 + STALE_S]


def test_live_staleness_is_told_once_and_again_after_news() -> None:
    ends = StaleStates()
    ends.add(LINE, "sensor/line", batch(1, 2))
    assert drawn(ends, 4) == []
    assert drawn(ends, 6) == [2 + STALE_S]
    ends.add(LINE, "sensor/line", batch(8))
    assert drawn(ends, 9) == []
    assert drawn(ends, 12) == [8 + STALE_S]


def test_lane_of_events_never_ends() -> None:
    ends = StaleStates()
    ends.add("/fleet/red/event/command", "event/command", batch(1))
    assert drawn(ends, 1000) == []

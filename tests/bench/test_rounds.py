"""Runs one small round of each benchmark, as `python -m tests.bench --small` does. No test asserts a speed."""

import importlib
import math
from pathlib import Path

import pytest

from tests.bench.__main__ import BENCHMARKS, row_of
from tests.bench.measured import SMALL, Measured
from tests.bench.stops import measured
from tests.support.stops import LONGEST_S, StopRow

BENCH = Path(__file__).parent
PARTS = {"__init__", "__main__", "measured", "record_ours", "stage", "test_rounds"}
"""Modules that are not benchmarks."""


PROCESSES = {"cli", "commands", "fleet", "floods", "load", "readings", "record", "router", "secure"}
"""Benchmarks that start many processes: too much for the test suite."""


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.soak] if each in PROCESSES else []) for each in BENCHMARKS]
)
def test_small_round(name: str) -> None:
    rows: list[Measured] = importlib.import_module(f"tests.bench.{BENCHMARKS[name]}").run(SMALL)
    assert rows
    for row in rows:
        assert row.name
        assert row.unit in {"us", "ms", "s", "/s", "%", "MB", "kB/s"}, row
        assert row.ours, row
        assert row.floor, row
        assert all(math.isfinite(value) and value >= 0 for value in (*row.ours, *row.floor)), row
        assert {*row.to_dict()} >= {"name", "ours", "floor", "unit", "ratio", "goal", "slack", "met"}
    assert len({row.name for row in rows}) == len(rows), "two rows have one name"


def test_command_knows_each_benchmark() -> None:
    assert {path.stem for path in BENCH.glob("*.py")} - PARTS == {*BENCHMARKS.values()}


@pytest.mark.parametrize(("announced_s", "met"), [(LONGEST_S, True), (LONGEST_S + 0.1, False)])
def test_stop_without_a_floor_has_an_absolute_goal(announced_s: float, met: bool) -> None:
    row = measured(StopRow("at rest", 9, 0.0, 0.0, 0.0, announced_s, math.inf, 0.0, 0, math.inf, math.inf, ""))
    assert (row.ratio, row.to_dict()["ratio"], row.met) == (None, None, met)
    assert "inf" not in row_of(row)
    assert f"{LONGEST_S:g} s" in row_of(row)

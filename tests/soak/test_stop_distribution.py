"""`stop` at 200 random moments in each mode and load: the measured times beside the announced ones.

`STOPS_TSV=FILE make soak` also writes the table as tab-separated text.
"""

import os
from pathlib import Path

import pytest

from schemas.words import Mode
from tests.support.stops import LONGEST_S, RATIO, SLACK_S, played, rows, tsv

MOMENTS = 200


@pytest.mark.soak
def test_distribution_of_stops() -> None:
    seen = played(MOMENTS)
    table = rows(seen)
    head = f"{'state':48} {'stops':>6} {'p50':>6} {'p90':>6} {'worst':>6} {'announced':>9} {'ratio':>6}  worst seen in"
    print(f"\n{head}")
    for row in table:
        print(
            f"{row.state:48} {row.stops:6} {row.p50_s:6.3f} {row.p90_s:6.3f} {row.worst_s:6.3f} {row.announced_s:9.3f} "
            f"{row.ratio:6.2f}  {row.worst_case}"
        )
    where = os.environ.get("STOPS_TSV")
    if where:
        Path(where).write_text(tsv(table))
    late = [one for one in seen if one.is_late and not one.may_be_late]
    too_careful = [
        row
        for row in table
        if row.ratio > RATIO and row.announced_s - row.worst_s > SLACK_S and "renewal" not in row.state
    ]
    too_long = [
        row
        for row in table
        if row.announced_s > LONGEST_S
        and Mode.OBSTACLE_AVOIDANCE not in row.state.replace(" ", "_")
        and "restored" not in row.state
    ]
    assert (late, too_careful, too_long) == ([], [], [])

"""`stop` at random moments in every mode and load: the longest announced, and the worst that the motors showed.

On virtual time, so a figure is the same on every machine. `make vectors` writes the same distribution into
tests/vectors/stops.tsv for docs/reference/stopping-times.md; the soak plays more moments.
"""

from tests.bench.measured import Measured, Scale
from tests.support.stops import LONGEST_S, PLAYED, RATIO, StopRow, distribution

MOMENTS = 40


def run(scale: Scale) -> list[Measured]:
    cases = PLAYED[:: len(PLAYED) // scale.count(len(PLAYED))]
    table = distribution(scale.count(MOMENTS), cases)
    return [measured(row) for row in table]


def measured(row: StopRow) -> Measured:
    """Judge what was announced: by the worst that was seen, or by an absolute limit if the motors were always off."""
    goal, slack = (RATIO, 0.0) if row.worst_s > 0 else (0.0, LONGEST_S)
    return Measured(f"stop, {row.state}", (row.announced_s,), (row.worst_s,), "s", goal, slack)

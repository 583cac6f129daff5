"""`stop` at random moments in every mode and load: the longest announced time, and the longest time of the motors.

It runs on virtual time, so its figures are the same on every machine. `make vectors` writes the same distribution into
tests/vectors/stops.tsv for docs/reference/stopping-times.md. The soak plays more moments.
"""

from tests.bench.measured import Measured, Scale
from tests.support.stops import LONGEST_S, PLAYED, RATIO, StopRow, distribution

MOMENTS = 40


def run(scale: Scale) -> list[Measured]:
    cases = PLAYED[:: len(PLAYED) // scale.count(len(PLAYED))]
    table = distribution(scale.count(MOMENTS), cases)
    return [measured(row) for row in table]


def measured(row: StopRow) -> Measured:
    """Judge the announced time by the longest measured one, or by an absolute limit if the motors were always off."""
    goal, slack = (RATIO, 0.0) if row.worst_s > 0 else (0.0, LONGEST_S)
    return Measured(f"stop, {row.state}", (row.announced_s,), (row.worst_s,), "s", goal, slack)

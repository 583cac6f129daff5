"""`stop` at random moments in every mode and load: the longest announced, and the worst that the motors showed.

On virtual time, so a figure is the same on every machine. The README's page on what happens when is made of the table
that this writes, tests/vectors/stops.tsv; the soak plays more moments of the same.
"""

from pathlib import Path

from tests.bench.measured import Measured
from tests.support.stops import RATIO, distribution, tsv

MOMENTS = 40
TABLE = Path(__file__).parents[1] / "vectors" / "stops.tsv"


def run() -> list[Measured]:
    table = distribution(MOMENTS)
    TABLE.write_text(tsv(table), encoding="utf-8")
    return [Measured(f"stop, {row.state}", (row.announced_s,), (row.worst_s,), "s", RATIO) for row in table]

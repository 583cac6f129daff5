"""The distribution of stops, tests/vectors/stops.tsv: `make vectors` writes the file.

The controller and the simulated cars run on virtual time, so that each machine writes the same table.
"""

from pathlib import Path

from tests.bench.stops import MOMENTS
from tests.support.stops import distribution, tsv

STOPS = Path(__file__).parents[1] / "vectors" / "stops.tsv"

if __name__ == "__main__":
    STOPS.write_text(tsv(distribution(MOMENTS)), encoding="utf-8")

"""tests/vectors/stops.tsv: the distribution of stops; `make vectors` writes it.

Control and the simulated cars play it on virtual time, so that each machine writes the same table.
"""

from pathlib import Path

from tests.bench.stops import MOMENTS
from tests.support.stops import distribution, tsv

STOPS = Path(__file__).parents[1] / "vectors" / "stops.tsv"

if __name__ == "__main__":
    STOPS.write_text(tsv(distribution(MOMENTS)), encoding="utf-8")

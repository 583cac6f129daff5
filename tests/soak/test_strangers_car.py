"""Many gaps around stops of foreign cars, of any length and direction, in every mode, with strict limits."""

import random
import time
from pathlib import Path

import pytest

from tests.support.foreign_cars import MODES, ForeignLot, any_gaps, stop_all

ROUNDS = 30


@pytest.mark.soak
@pytest.mark.timeout(60 * ROUNDS)
def test_stops_behind_many_gaps(tmp_path: Path) -> None:
    seed = int(time.time())
    lot = ForeignLot(tmp_path)
    found = []
    try:
        lot.ready()
        for each in range(seed, seed + ROUNDS):
            print(f"\nseed {each}")
            pause_s = random.Random(each).uniform(0.0, 4.0)  # short pauses stop a mode during its opening
            found += stop_all(lot, any_gaps(MODES, each), pause_s=pause_s, busy_s=0.0)
    finally:
        lot.close()
    assert not found, "\n\n".join(found)

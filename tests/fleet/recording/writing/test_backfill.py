"""Backfill asks for what is missing, from the time at which it began to be missing."""

import re
import threading
import time

import zenoh

from fleet.recording.writing.backfill import Backfill
from schemas.bus import Bus
from tests.support.processes import wait_for

SLOW_S = 1.5


def test_each_window_begins_where_the_gap_does(endpoint: str, bus: Bus) -> None:
    windows: dict[str, tuple[float, float]] = {}
    """Of each key: when the query came, and the length of its window, s."""

    def answer(query: zenoh.Query) -> None:
        with query:
            (length_s,) = re.findall(r"now\(-([0-9.]+)s\)", str(query.selector))
            key = str(query.key_expr)
            windows.setdefault(key.split("/")[1], (time.monotonic(), float(length_s)))
            if "/slow/" in key:
                threading.Event().wait(SLOW_S)

    for car in ("slow", "quick"):
        bus.queryable(f"fleet/{car}/state/link/@adv/pub/**", answer)
    with Bus.open(endpoint) as own:
        backfill = Backfill(own, ["fleet/slow/**", "fleet/quick/**"], resumes_s=30.0)
        backfill.start()
        wait_for(lambda: len(windows) == 2, "both are asked")
        backfill.close()
    begun = {car: at - length_s for car, (at, length_s) in windows.items()}
    assert windows["quick"][0] - windows["slow"][0] > SLOW_S
    assert abs(begun["quick"] - begun["slow"]) < SLOW_S / 2

"""What a gateway answers of what it has published, on a real bus."""

import queue
from pathlib import Path

import zenoh

from gateway.control.controller import Controller
from gateway.protocol.profile import parse_platform
from gateway.protocol.readings import ImuReading
from gateway.publish import SLICE, Publications
from schemas.bus import Bus
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, Fleet, wait_for


def test_a_long_history_is_answered_in_slices(tmp_path: Path) -> None:
    """As JSON it takes longer than a car may be left alone."""
    fleet = Fleet(free_endpoint(), tmp_path)
    try:
        with Bus.open(fleet.endpoint) as opened:
            out = Publications(opened, "fleet", "red", Controller("red", parse_platform("arduino")), "tcp://x")
            for number in range(3 * SLICE + 1):
                out.event(ImuReading(b"", float(number), (number, 0, 0), (0, 0, 0)), None, loaded=False)
            pauses: queue.Queue[int] = queue.Queue()

            def answer(query: zenoh.Query) -> None:
                pauses.put(len(list(out.answers("sensor", query))))

            def ask(parameters: str) -> int:
                return len(list(fleet.bus.query(f"fleet/red/sensor/*?{parameters}", timeout_s=20.0)))

            opened.queryable("fleet/red/sensor/*", answer)
            wait_for(lambda: ask(""), "the queryable is known")
            assert pauses.get(timeout=PATIENCE_S) == 0
            for parameters, count, paused in (("last=1500", 3 * SLICE + 1, 3), ("format=json", 1, 0), ("last=x", 1, 0)):
                assert (ask(parameters), pauses.get(timeout=PATIENCE_S)) == (count, paused), parameters
    finally:
        fleet.close()

"""What a gateway answers of what it has published, on a real bus."""

from pathlib import Path

import zenoh

from gateway.control.controller import Controller
from gateway.protocol.profile import parse_platform
from gateway.protocol.readings import ImuReading
from gateway.publish import SLICE, Publications
from schemas.bus import Bus
from tests.support.ports import free_endpoint
from tests.support.processes import Fleet


def test_a_long_history_is_answered_in_slices(tmp_path: Path) -> None:
    """As JSON it takes longer than a car may be left alone."""
    fleet = Fleet(free_endpoint(), tmp_path)
    try:
        with Bus.open(fleet.endpoint) as opened:
            out = Publications(opened, "fleet", "red", Controller("red", parse_platform("arduino")), "tcp://x")
            for number in range(3 * SLICE + 1):
                out.event(ImuReading(b"", float(number), (number, 0, 0), (0, 0, 0)), number + 1, None, loaded=False)
            pauses: list[int] = []

            def answer(query: zenoh.Query) -> None:
                pauses.append(len(list(out.answers("sensor", query))))

            opened.queryable("fleet/red/sensor/*", answer)
            for parameters, count, paused in (("last=1500", 3 * SLICE + 1, 3), ("format=json", 1, 0), ("last=x", 1, 0)):
                found = list(fleet.bus.query(f"fleet/red/sensor/*?{parameters}", timeout_s=20.0))
                assert (len(found), pauses.pop()) == (count, paused), parameters
    finally:
        fleet.close()

"""10,000 drives a second from three operators: the memory is bounded, one frame on the link, and a stop gets through.

tests/soak/test_kills.py floods for a minute, alone on the machine, and measures how soon the stop is on the wire.
"""

from tests.support.flooding import FLIGHT_S, flood
from tests.support.processes import FleetProcesses


def test_flood_of_drives(fleet: FleetProcesses) -> None:
    found = flood(fleet, seconds=2.0, stops=1)
    assert found.published > 10_000
    assert min(found.apart_s) > FLIGHT_S - 0.001, "the next frame waits until the last is no more in flight"
    wire = b"".join(data for _, data in found.frames)
    assert wire.count(b"$") == wire.count(b"#") == len(found.apart_s) + 1, "what is on the wire is what was told"
    assert len(found.stopped_s) == 1
    assert max(found.rss_mb) < found.rss_mb[0] + 30.0, found.rss_mb

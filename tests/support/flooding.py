"""10,000 drives a second from three operators at one car, and stops among them: shared by tests/e2e and tests/soak."""

import itertools
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.support.judge import Judge
from tests.support.processes import TAKEN, FleetProcesses, frames, wait_for
from tests.support.tap import Tap

PER_S: Final = 10_000
KINDS: Final = ("person", "script", "coordinator")
FLOOD: Final = Path(__file__).parents[1] / "e2e" / "flood.py"
WARM_S: Final = 2.0
FLIGHT_S: Final = 0.06
"""docs/reference/protocol.md#pacing: a frame without a block of its own is in flight so long."""
STOPS: Final = (b"$4WD,MODE00#", b"$0,0,0,0,0,0,0,0,0#")
"""What a stop may begin with."""


def stops_in(data: bytes) -> bool:
    """Whether a stop is in what passed at once: the tap may have been late, and a drive before it."""
    return any(frame in STOPS for frame in frames(data))


@dataclass
class Flooded:
    """What was seen."""

    published: int = 0
    frames: list[tuple[int, bytes]] = field(default_factory=list)
    """What passed the wire, and when (ns since the epoch)."""
    apart_s: list[float] = field(default_factory=list)
    """The time from each write to the next."""
    stopped_s: list[float] = field(default_factory=list)
    """From each stop's question to its first frame on the wire."""
    drove_on_s: list[float] = field(default_factory=list)
    """How long after the first stop motors went on again: nobody has let go."""
    rss_mb: list[float] = field(default_factory=list)
    left_out: int = 0


def flood(fleet: FleetProcesses, *, seconds: float, stops: int) -> Flooded:
    """Three operators drive one car, each in its own direction every 0.3 ms; a fourth stops it now and then."""
    judge = Judge.follow(fleet.bus)
    _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
    tap = Tap(link)
    found = Flooded()
    try:
        gateway = fleet.gateway(tap.link)
        fleet.ready()
        wait_for(lambda: fleet.get("fleet/red/sensor/range"), "a ranging with an echo")
        began_ns = time.time_ns()
        operators = [fleet.start(str(FLOOD), kind, str(PER_S / len(KINDS)), str(seconds + WARM_S)) for kind in KINDS]
        wait_for(lambda: judge.driving, "it drives")
        first_at = time.monotonic() + WARM_S
        first_ns = 0
        for number in range(stops):
            time.sleep(max(0.0, first_at + number * seconds / stops - time.monotonic()))
            found.rss_mb.append(gateway.rss_mb())
            if number:
                fleet.ready()  # a stop that still ran would be joined
            asked_ns = time.time_ns()
            assert fleet.ask("stop", sender="ann", kind="person")["status"] in TAKEN
            on_wire = wait_for(
                lambda at=asked_ns: [when for when, data in tap.passed if when > at and stops_in(data)], "a stop"
            )
            found.stopped_s.append((on_wire[0] - asked_ns) / 1e9)
            first_ns = first_ns or asked_ns
        found.drove_on_s = judge.on_after(first_ns + 1_000_000_000)
        found.published = sum(operator.line() for operator in operators)
        for operator in operators:
            assert operator.wait() == 0, operator.stderr
        found.rss_mb.append(gateway.rss_mb())
        found.left_out = fleet.state("health").bus_drops
        assert fleet.ask("stop", sender="ann", kind="person")["status"] in TAKEN, "it still answers"
        fleet.ready()
        assert "Traceback" not in gateway.stderr, gateway.stderr
        found.frames = [each for each in tap.passed if each[0] > began_ns]

        def told() -> list[int]:
            return [at for at, _, _ in judge.frames if at > began_ns]

        wire = b"".join(data for _, data in found.frames)  # of which two frames may have passed at once
        wait_for(lambda: len(told()) >= wire.count(b"#"), "what is on the wire is told")  # the answer was faster
        found.apart_s = [(later - earlier) / 1e9 for earlier, later in itertools.pairwise(told())]
    finally:
        tap.close()
    return found

"""Three operators send 10,000 drives a second to one car, and a fourth stops it. Shared by tests/e2e and tests/soak."""

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
"""Time for which a frame that blocks nothing is in flight (docs/reference/protocol.md#pacing)."""
STOPS: Final = (b"$4WD,MODE00#", b"$0,0,0,0,0,0,0,0,0#")
"""The frames with which a stop may begin."""


def stops_in(data: bytes) -> bool:
    """Return True if the bytes of one read hold a stop. If the tap was late, a drive may precede it."""
    return any(frame in STOPS for frame in frames(data))


@dataclass
class Flooded:
    """The measurements of one flood."""

    published: int = 0
    frames: list[tuple[int, bytes]] = field(default_factory=list)
    """Time (ns since the epoch) and bytes of each read at the tap before the car."""
    apart_s: list[float] = field(default_factory=list)
    """Time from each written frame to the next, by the stamps of frame/tx."""
    stopped_s: list[float] = field(default_factory=list)
    """Time from each request of a stop to its first frame on the wire."""
    drove_on_s: list[float] = field(default_factory=list)
    """Times at which motors went on, from one second after the first stop: none, because no operator has paused."""
    rss_mb: list[float] = field(default_factory=list)
    left_out: int = 0


def flood(fleet: FleetProcesses, *, seconds: float, stops: int) -> Flooded:
    """Let three operators drive one car, each in its own direction every 0.3 ms. Let a fourth stop it now and then."""
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
                fleet.ready()  # a request during a stop would only join that stop
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

        wire = b"".join(data for _, data in found.frames)  # one read may hold two frames
        # The answer to a command may arrive before the publications of its frames.
        wait_for(lambda: len(told()) >= wire.count(b"#"), "what is on the wire is told")
        found.apart_s = [(later - earlier) / 1e9 for earlier, later in itertools.pairwise(told())]
    finally:
        tap.close()
    return found

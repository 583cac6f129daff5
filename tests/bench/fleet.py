"""A fleet of simulated cars under `fleet up`: the cost of a car, and the times of a query and a stop of all cars.

The floor is a bare process that answers at once, or the smallest fleet for figures that grow. PSS is Linux's.
"""

import contextlib
import statistics
import time
from pathlib import Path
from time import perf_counter

from fleet.client.client import Fleet
from schemas.bus import Sample
from tests.bench.measured import Measured, Scale, percentile
from tests.bench.stage import scratch
from tests.support.judge import stamp_ns
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for
from tests.support.up import Up

SIZES = (1, 50, 100)
GOALS = 50
"""Number of cars for queries and stops. A small round has one car."""
QUERIES = 40
STOPS = 12
WINDOW_S = 5.0
QUERY_MS, STOP_MS = 100.0, 150.0
LONGEST_UP_S, LOOK_S = 300.0, 0.5
UP_S = 60.0
"""Maximum time until a hundred cars are at rest, on two processors (issue 10)."""


def cpu_s(pids: list[int]) -> float:
    """Return the CPU time of these processes, by the scheduler's own count."""
    total = 0
    for pid in pids:
        for thread in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with contextlib.suppress(OSError):  # the thread has just ended
                total += int(thread.read_text(encoding="ascii").split()[0])
    return total / 1e9


def _pss_mb(pid: int) -> float:
    """Return the proportional set size: shared memory is divided among its processes."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0


class SimulatedFleet:
    """A fleet of this size, up and at rest."""

    def __init__(self, up: Up, size: int, scale: Scale) -> None:
        self.up = up
        self.scale = scale
        self.size = size
        while self.at_rest() < size:
            assert perf_counter() - up.began < LONGEST_UP_S, f"{self.at_rest()} of {size} cars are at rest"
            time.sleep(LOOK_S)
        self.up_s = perf_counter() - up.began
        again = {each.name: each.words for each in up.processes() if each.restarts}
        assert not again, f"started again: {again}"

    def at_rest(self) -> int:
        """Return the number of cars that are known to stand."""
        answers = list(self.up.bus.query("fleet/*/state/safety", timeout_s=5.0))
        return sum(isinstance(each, Sample) and each.message().motors == "off" for each in answers)  # type: ignore[attr-defined]

    def pids(self) -> list[int]:
        """Return the process ids of the gateways."""
        return [each.pid for each in self.up.status().processes if each.kind == "gateway" and each.HasField("pid")]

    def cpu(self) -> float:
        """Return the CPU time of one gateway, percent of a core."""
        pids = self.pids()
        before, began = cpu_s(pids), perf_counter()
        time.sleep(self.scale.seconds(WINDOW_S, 1.2))  # a report comes once a second
        return (cpu_s(pids) - before) / (perf_counter() - began) / self.size * 100

    def pss(self) -> float:
        """Return the memory of one gateway, MB."""
        return statistics.fmean(_pss_mb(pid) for pid in self.pids())

    def queries(self) -> list[float]:
        """Return the times of wildcard queries for one state of every car, until the last answer, ms."""
        times = []
        for _ in range(self.scale.count(QUERIES, 3)):
            began = perf_counter()
            answers = list(self.up.bus.query("fleet/*/state/link", timeout_s=5.0))
            times.append((perf_counter() - began) * 1e3)
            assert len(answers) == self.size
        return times

    def track(self, client: Fleet) -> None:
        """Bring all cars but Raspberry Pi cars into tracking."""
        outcomes = [client.car(car).mode("tracking") for car in client.cars() if self._may_track(car)]
        assert all(outcome.ok for outcome in outcomes), [outcome for outcome in outcomes if not outcome.ok]

    def _may_track(self, car: str) -> bool:
        return not self.up.get(f"{car}/state/health").platform.startswith("raspberry")

    def stops(self, client: Fleet) -> list[float]:
        """Return the time from a stop of all cars until its first frame is on the wire, ms, for each car."""
        wires: dict[str, int] = {}

        def wire(sample: Sample) -> None:
            frame = sample.message()
            if frame.why == "stop":  # type: ignore[attr-defined]  # a fleet.v1.TxFrame
                wires.setdefault(sample.key, stamp_ns(frame))

        subscriber = self.up.bus.subscribe("fleet/*/frame/tx", wire)
        time.sleep(0.2)  # until all gateways have the subscription
        asked = time.time_ns()
        # Wait until all stops are over: a stop that joins another one writes nothing. A car may show its stop late.
        wait_for(lambda: all(outcome.ok for outcome in client.stop()), "all cars stand", 60.0)
        wait_for(lambda: len(wires) == self.size, "a stop is on every wire", 30.0)
        subscriber.undeclare()
        return [(at - asked) / 1e6 for at in wires.values()]


def run(scale: Scale) -> list[Measured]:
    found: list[Measured] = []
    idle: dict[int, tuple[float, float]] = {}
    sizes = sorted({scale.count(size) for size in SIZES})
    goals = scale.count(GOALS)
    for size in sizes:
        with scratch() as directory, Up(directory, free_endpoint(), "--sim", str(size), "--no-record") as up:
            fleet = SimulatedFleet(up, size, scale)
            idle[size] = fleet.cpu(), fleet.pss()
            first = idle[sizes[0]]
            found += [
                Measured(f"fleet up until at rest, {size} cars", (fleet.up_s,), (UP_S,), "s", 1.0),
                Measured(f"gateway CPU, 1 report/s, {size} cars", (idle[size][0],), (first[0],), "%", None),
                Measured(f"gateway PSS, {size} cars", (idle[size][1],), (first[1],), "MB", None),
            ]
            if size == goals:
                found += _goals(fleet)
    return found


def _goals(fleet: SimulatedFleet) -> list[Measured]:
    found = []
    with Fleet(fleet.up.endpoint) as client:
        assert len(client.cars()) == fleet.size
        for what in ("1 report/s", "tracking"):
            if what == "tracking":
                fleet.track(client)
                found.append(Measured(f"gateway CPU, tracking, {fleet.size} cars", (fleet.cpu(),), (1.0,), "%", None))
            p50 = percentile(fleet.queries(), 0.5)
            found.append(Measured(f"wildcard query p50, {fleet.size} cars, {what}", (p50,), (QUERY_MS,), "ms", 1.0))
            stops = [
                each
                for _ in range(fleet.scale.count(STOPS) if what == "1 report/s" else 1)
                for each in fleet.stops(client)
            ]
            p95 = percentile(stops, 0.95)
            found.append(Measured(f"stop on all wires p95, {fleet.size} cars, {what}", (p95,), (STOP_MS,), "ms", 1.0))
    return found

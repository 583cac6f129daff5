"""Time from the start of a command to its end, with absolute goals. The floor is a Python that does nothing."""

import subprocess
import sys
from time import perf_counter

from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import scratch
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

CARS = ("red", "green", "blue")
RUNS = 20
"""Number of runs, more than elsewhere because the processes are short."""
HELP_MS, LIST_MS = 200.0, 300.0


def _run_ms(*arguments: str) -> float:
    began = perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return (perf_counter() - began) * 1e3


def run(scale: Scale) -> list[Measured]:
    many = Scale(scale.count(RUNS), scale.share)
    with scratch() as directory:
        endpoint = free_endpoint()

        def times(*arguments: str) -> tuple[list[float], list[float]]:
            command = ("-m", "fleet.cli", *arguments)
            return in_turns(many, lambda: _run_ms(*command), lambda: _run_ms("-c", "pass"))

        helped, floor = times("--help")
        fleet = FleetProcesses(endpoint, directory)
        try:
            _, links = fleet.simulate(*(f"{car}:arduino:pty" for car in CARS))
            for car, link in zip(CARS, links, strict=True):
                fleet.gateway(link, car=car)
            for car in CARS:
                fleet.ready(car)
            listed, list_floor = times("list", "--connect", endpoint)
        finally:
            fleet.close()
    return [
        Measured("fleet --help", tuple(helped), tuple(floor), "ms", 0.0, slack=HELP_MS),
        Measured("fleet list, 3 cars", tuple(listed), tuple(list_floor), "ms", 0.0, slack=LIST_MS),
    ]

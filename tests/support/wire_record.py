"""`gateway sim` with a record of the bytes to its cars: `python -m tests.support.wire_record FILE SIM-ARGUMENTS`.

Each line of the file has a time (ns since the epoch), a car, and the bytes in hex. If the car's program becomes blocked
or free, its line has `blocked` or `free` in place of bytes.
"""

import argparse
import sys
import time
from bisect import bisect_left
from pathlib import Path
from typing import TextIO

from gateway.sim.cli import add_arguments, run
from gateway.sim.simulation import SimCar, Simulation


def note_all(file: TextIO) -> None:
    """Note the bytes and blocks of all cars that this process will simulate."""
    received, start = SimCar.received, Simulation.start

    def note(car: SimCar, what: str) -> None:
        file.write(f"{time.time_ns()} {car.spec.name} {what}\n")
        file.flush()

    def on_bytes(car: SimCar, data: bytes) -> None:
        note(car, data.hex())
        received(car, data)

    blocked: dict[SimCar, bool] = {}

    def on_truth(car: SimCar) -> None:
        truth = car.firmware.truth
        assert truth is not None, "a capture has no truth"
        if truth.blocked is not blocked.get(car, False):
            blocked[car] = truth.blocked
            note(car, "blocked" if truth.blocked else "free")

    async def start_noted(simulation: Simulation) -> None:
        for car in simulation.cars.values():
            car.watchers.append(on_truth)
        await start(simulation)

    SimCar.received, Simulation.start = on_bytes, start_noted  # type: ignore[assignment, method-assign]


class WireRecord:
    """The lines of a record, by car and in order."""

    def __init__(self, file: Path) -> None:
        self._file = file.open()
        self._rest = ""
        self._bytes: dict[str, list[int]] = {}
        self._blocks: dict[str, list[tuple[int, bool]]] = {}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> None:
        """Read the new lines of the file."""
        *lines, self._rest = (self._rest + self._file.read()).split("\n")
        for line in lines:
            at, car, what = line.split()
            if what not in ("blocked", "free"):
                self._bytes.setdefault(car, []).append(int(at))
                continue
            self._blocks.setdefault(car, [(0, False)]).append((int(at), what == "blocked"))

    def first_after(self, car: str, moment_ns: int) -> int | None:
        """Return the time at which the first bytes after a moment reached a car, None if none did."""
        times = self._bytes.get(car, [])
        index = bisect_left(times, moment_ns)
        return times[index] if index < len(times) else None

    def is_blocked(self, car: str) -> bool:
        """Return True if the last line about the car's program says that it is blocked."""
        return self._blocks.get(car, [(0, False)])[-1][1]

    def was_blocked(self, car: str, begin_ns: int, end_ns: int) -> bool:
        """Return True if the car's program was blocked at any time between two moments."""
        blocks = self._blocks.get(car, [(0, False)])
        running = blocks[bisect_left(blocks, (begin_ns, False)) - 1][1]
        return running or any(on for at, on in blocks if begin_ns <= at <= end_ns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="gateway sim")
    add_arguments(parser)
    with Path(sys.argv[1]).open("w") as record:
        note_all(record)
        sys.exit(run(parser.parse_args(sys.argv[2:])))

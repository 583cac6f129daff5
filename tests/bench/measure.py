"""What a bench gives, and how it is taken: ours and its floor in turn, the median of five."""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from schemas import bus
from tests.support.ports import free_endpoint

ROUNDS = 5
PATIENCE_S = 30.0


@dataclass(frozen=True, slots=True)
class Measured:
    """One line of the table. `goal`: the greatest ratio; `slack`: what may come on top of it, in `unit`."""

    name: str
    ours: float
    floor: float
    unit: str
    goal: float
    slack: float = 0.0

    @property
    def ratio(self) -> float:
        return self.ours / self.floor

    @property
    def met(self) -> bool:
        return self.ours <= self.goal * self.floor + self.slack


def in_turn(ours: Callable[[], float], floor: Callable[[], float]) -> tuple[float, float]:
    """Medians of five rounds, taken in turn so that both see the same machine."""
    taken = [(floor(), ours()) for _ in range(ROUNDS)]
    return statistics.median(each[1] for each in taken), statistics.median(each[0] for each in taken)


def quantile(values: list[float], share: float) -> float:
    """The value below which this share of the values lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


@contextmanager
def hub() -> Iterator[str]:
    """A hub on an endpoint of its own."""
    endpoint = free_endpoint()
    with process("schemas.hub", "--endpoint", endpoint):
        wait_for(lambda: bus.accepts(endpoint))
        yield endpoint


@contextmanager
def process(module: str, *arguments: str, env: dict[str, str] | None = None) -> "Iterator[subprocess.Popen[bytes]]":
    """A process of this interpreter that ends with the block."""
    environment = (
        os.environ | {"FLEET_STATE_DIR": str(Path(os.environ.get("TMPDIR", "/tmp")) / "bench-state")} | (env or {})
    )
    started = subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
        stdin=subprocess.DEVNULL,
    )
    try:
        yield started
    finally:
        started.terminate()
        started.wait(PATIENCE_S)


def wait_for(condition: Callable[[], object]) -> None:
    """Until it holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the thing that is measured did not come up")
        time.sleep(0.002)


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, user and system, s (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int) -> float:
    """Resident memory of a process, MB (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

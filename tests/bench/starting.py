"""From the start of a gateway to its liveliness token, and its memory; the floor is a process that declares a token."""

import subprocess
from collections.abc import Callable
from time import sleep

from tests.bench.measured import Measured, in_turns
from tests.bench.stage import Arrival, Stage, perf_counter, stage
from tests.support.processes import Process

SETTLED_S = 1.0


def _rss_mb(pid: int) -> float:
    listed = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=True)
    return int(listed.stdout) / 1024


def _start(here: Stage, token: str, start: Callable[[], Process]) -> tuple[float, float]:
    """(ms until the token, MB of memory a second later)."""
    alive, gone = Arrival(), Arrival()
    watch = here.session.liveliness().declare_subscriber(
        token, lambda sample: (alive if sample.kind == sample.kind.PUT else gone).note()
    )
    began = perf_counter()
    process = start()
    took = (alive.wait() - began) * 1e3
    sleep(SETTLED_S)
    memory = _rss_mb(process.pid)
    process.popen.kill()
    process.wait()
    gone.wait()
    watch.undeclare()
    return took, memory


def run() -> list[Measured]:
    with stage() as here:
        port = here.tty()
        ours, floor = in_turns(
            lambda: _start(here, "fleet/red", lambda: here.fleet.gateway(port.path)),
            lambda: _start(here, "bench/token", lambda: here.bare("alive", "bench/token")),
        )
    return [
        Measured("gateway start to token", tuple(t for t, _ in ours), tuple(t for t, _ in floor), "ms", 2.5),
        Measured("gateway memory (RSS)", tuple(m for _, m in ours), tuple(m for _, m in floor), "MB", 2.0),
    ]

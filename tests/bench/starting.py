"""Time from a gateway's start to its liveliness token, and its memory. The floor is a process that declares a token.

The benchmark also measures the time of the first answer to a query after the token. A token alone serves nobody.
"""

import subprocess
from collections.abc import Callable
from time import perf_counter, sleep

from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import Arrival, Stage, stage
from tests.support.processes import GatewayProcess

SETTLED_S = 1.0


def _rss_mb(pid: int) -> float:
    listed = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=True)
    return int(listed.stdout) / 1024


def _start(here: Stage, token: str, asked: str, start: Callable[[], GatewayProcess]) -> tuple[float, float, float]:
    """Return (ms until the token, ms until the answer to a query sent then, MB of memory a second later)."""
    alive, gone = Arrival(), Arrival()
    watch = here.session.liveliness().declare_subscriber(
        token, lambda sample: (alive if sample.kind == sample.kind.PUT else gone).note()
    )
    began = perf_counter()
    process = start()
    token_at = alive.wait()
    answer = next(iter(here.session.get(asked)))
    answered_at = perf_counter()
    assert answer.ok is not None
    sleep(SETTLED_S)
    memory = _rss_mb(process.pid)
    process.popen.kill()
    process.wait()
    gone.wait()
    watch.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
    return (token_at - began) * 1e3, (answered_at - began) * 1e3, memory


def run(scale: Scale) -> list[Measured]:
    with stage() as here:
        port = here.tty()
        ours, floor = in_turns(
            scale,
            lambda: _start(here, "fleet/red", "fleet/red/state/health", lambda: here.fleet.gateway(port.path)),
            lambda: _start(here, "bench/answer/alive", "bench/answer", lambda: here.bare("answer", "bench/answer")),
        )
    token, answer, memory = ((tuple(run[part] for run in ours), tuple(run[part] for run in floor)) for part in range(3))
    return [
        Measured("gateway start to token", *token, "ms", 2.5),
        Measured("gateway start to first answer", *answer, "ms", None),
        Measured("gateway memory (RSS)", *memory, "MB", 2.0),
    ]

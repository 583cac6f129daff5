"""From the start of a gateway to its liveliness token, and its memory, against a bare process that opens a session."""

import subprocess
import threading
import time
from contextlib import AbstractContextManager

from tests.bench import floors
from tests.bench.measure import Measured, hub, in_turn, process, rss_mb
from tests.bench.wire import Tty


def run() -> list[Measured]:
    line = Tty()
    memory: dict[str, list[float]] = {"ours": [], "floor": []}
    with hub() as endpoint, floors.session(endpoint) as session:

        def timed(name: str, key: str, make: "AbstractContextManager[subprocess.Popen[bytes]]") -> float:
            there, gone = threading.Event(), threading.Event()
            watcher = session.liveliness().declare_subscriber(
                key, lambda sample: (there if str(sample.kind).endswith("PUT") else gone).set()
            )
            began = time.perf_counter()
            with make as started:
                there.wait(30.0)
                took = (time.perf_counter() - began) * 1e3
                time.sleep(1.0)
                memory[name].append(rss_mb(started.pid))
            gone.wait(30.0)
            watcher.undeclare()
            return took

        def ours() -> float:
            arguments = ("run", "--car", "red", "--link", line.path, "--platform", "arduino", "--connect", endpoint)
            return timed("ours", "fleet/red", process("gateway.cli", *arguments))

        def floor() -> float:
            return timed("floor", "floor/token", process("tests.bench.floors", "token", endpoint, "floor/token"))

        start = Measured("gateway start to token", *in_turn(ours, floor), "ms", 2.5)
    line.close()
    middle = [sorted(memory[name])[len(memory[name]) // 2] for name in ("ours", "floor")]
    return [start, Measured("gateway RSS", *middle, "MB", 2.0)]

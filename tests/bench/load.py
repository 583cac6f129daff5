"""A gateway at 25 tracking frames a second: its CPU, the time of commands, and its memory after an hour's frames.

The floors: a bare loop that publishes the same, a query that a bare process answers at once, its own memory before.
"""

import json
import subprocess
from pathlib import Path
from time import monotonic, perf_counter, sleep

from tests.bench.commands import GAP_S, TURNS
from tests.bench.measured import Measured, Scale, in_turns, percentile
from tests.bench.stage import READING, Arrival, Stage, Tty, frames, play_car, stage
from tests.support.processes import PATIENCE_S, GatewayProcess

TRACKING = b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"
RATE_HZ = 25
WINDOW_S = 8.0
COMMANDS = 30
HOUR = 3600 * RATE_HZ
"""Number of frames in an hour of tracking."""
SETTLED = HOUR // 10
"""Number of frames after which every ring of 1,500 readings is full."""
AT_ONCE = 100
LOST_AFTER_S = 3.0
"""Time after which frames that `state/link` lacks count as dropped. `state/link` comes once a second."""


def cpu_s(process: GatewayProcess) -> float:
    """Return the CPU time, user and system: on Linux by the scheduler's own count, elsewhere by `ps` in hundredths.

    The ticks of /proc/PID/stat take 10 ms, and miss most of the threads that run for a fraction of a tick.
    """
    threads = list(Path(f"/proc/{process.pid}/task").glob("*/schedstat"))
    if threads:
        return sum(int(thread.read_text(encoding="ascii").split()[0]) for thread in threads) / 1e9
    listed = subprocess.run(["ps", "-o", "time=", "-p", str(process.pid)], capture_output=True, text=True, check=True)
    minutes, _, seconds = listed.stdout.strip().rpartition(":")
    return int(minutes or 0) * 60 + float(seconds)


def _cpu(process: GatewayProcess, port: Tty, window_s: float) -> float:
    """Return the share of a core, in percent."""
    with frames(port, TRACKING, RATE_HZ):
        sleep(0.5)
        before, began = cpu_s(process), monotonic()
        sleep(window_s)
        return (cpu_s(process) - before) / (monotonic() - began) * 100


def _track(here: Stage, port: Tty) -> None:
    """Bring the gateway's car into tracking, and wait until the mode is confirmed."""
    here.fleet.ask("mode", mode="tracking")

    def opened() -> bool:
        return bool(here.fleet.state("mode").asked == "tracking")

    def confirmed() -> bool:
        return opened() and here.fleet.state("mode").verdict == "confirmed"

    play_car(port, confirmed, lambda: TRACKING if opened() else READING)


def _commands(here: Stage, port: Tty, count: int) -> list[float]:
    """Return the times from request to tty, ms, while mode-0 frames (six readings each) come at the same rate."""
    times = []
    for _ in range(count):
        motion, frame = next(TURNS)
        sleep(GAP_S)
        port.drain()
        began = perf_counter()
        payload = json.dumps({"motion": motion, "duration_s": 5})
        replies = here.session.get("fleet/red/@cmd/drive", payload=payload, encoding="application/json")
        seen, deadline = b"", monotonic() + PATIENCE_S
        while frame not in seen:
            assert monotonic() < deadline, seen
            seen += port.read()
        times.append((perf_counter() - began) * 1e3)
        assert all(reply.ok is not None for reply in replies)
    return times[1:]  # the first command may have waited for the stop of the motion before


def _queries(here: Stage, count: int) -> list[float]:
    times = []
    for _ in range(count):
        sleep(GAP_S)
        began = perf_counter()
        assert next(iter(here.session.get("bench/answer", payload=b"{}"))).ok is not None
        times.append((perf_counter() - began) * 1e3)
    return times[1:]


def _feed(here: Stage, port: Tty, count: int) -> None:
    """Send frames as fast as the gateway takes them, until `state/link` has counted `count` more of them."""
    first = here.fleet.state("link").rx_frames
    written = taken = 0
    deadline = monotonic() + PATIENCE_S
    while taken < count:
        if written - taken < 20 * AT_ONCE and written < count:  # beyond that the PTY blocks the writer anyway
            port.write(TRACKING * AT_ONCE)
            written += AT_ONCE
            continue
        before, taken = taken, here.fleet.state("link").rx_frames - first
        if taken > before:
            deadline = monotonic() + PATIENCE_S
        elif monotonic() > deadline - PATIENCE_S + LOST_AFTER_S:
            written = taken  # a stalled gateway drops bytes that are too old: write as many again
        assert monotonic() < deadline
        sleep(0.02)


def run(scale: Scale) -> list[Measured]:
    with stage() as here:
        port, bare_port, alive, answering = here.tty(), here.tty(), Arrival(), Arrival()
        gateway = here.gateway(port)
        kept = [
            here.session.liveliness().declare_subscriber("bench/loop/alive", alive.note, history=True),
            here.session.liveliness().declare_subscriber("bench/answer/alive", answering.note, history=True),
        ]
        bare = here.bare("loop", bare_port.path, "bench/loop")
        here.bare("answer", "bench/answer")
        alive.wait()
        answering.wait()
        with frames(port, READING, RATE_HZ):
            count = scale.count(COMMANDS, 3)
            ours, floor = in_turns(scale, lambda: _commands(here, port, count), lambda: _queries(here, count))
        _track(here, port)
        window_s = scale.seconds(WINDOW_S, 1.2)  # a state comes once a second
        cpu, bare_cpu = in_turns(scale, lambda: _cpu(gateway, port, window_s), lambda: _cpu(bare, bare_port, window_s))
        _feed(here, port, scale.count(SETTLED))
        before = gateway.rss_mb()
        _feed(here, port, scale.count(HOUR))
        after = gateway.rss_mb()
        for each in kept:
            each.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
    return [
        Measured("gateway CPU, 25 frames/s", tuple(cpu), tuple(bare_cpu), "%", 2.0),
        Measured(
            "command to tty, p90, 25 frames/s",
            tuple(percentile(times, 0.9) for times in ours),
            tuple(percentile(times, 0.9) for times in floor),
            "ms",
            1.5,
            slack=1.0,
        ),
        Measured("RSS after an hour of frames", (after,), (before,), "MB", 1.05),
    ]

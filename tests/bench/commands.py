"""Time from a command's query to its bytes on the tty. The floor is a query that a bare process answers at once."""

import json
from itertools import cycle
from statistics import median
from time import monotonic, perf_counter, sleep

from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import READING, Arrival, Stage, Tty, frames, stage
from tests.support.processes import PATIENCE_S

COMMANDS = 30
GAP_S = 0.1
"""Interval of the commands, over the 60 ms for which a motion is in flight. Pacing delays none of them."""
TURNS = cycle([("left", b"$3,0,0,0,0,0,0,0,0#"), ("right", b"$4,0,0,0,0,0,0,0,0#")])


def _command(here: Stage, port: Tty, count: int) -> float:
    times = []
    for _ in range(count):
        motion, frame = next(TURNS)
        payload = json.dumps({"motion": motion, "duration_s": 5})
        sleep(GAP_S)
        port.drain()
        began = perf_counter()
        replies = here.session.get("fleet/red/@cmd/drive", payload=payload, encoding="application/json")
        seen = b""
        deadline = monotonic() + PATIENCE_S
        while frame not in seen:
            assert monotonic() < deadline, (seen, [str(reply.ok and reply.ok.payload.to_string()) for reply in replies])
            seen += port.read()
        times.append((perf_counter() - began) * 1e3)
        assert all(reply.ok is not None for reply in replies)
    return median(times[1:])  # the first command may have waited for the stop of the motion before


def _query(here: Stage, count: int) -> float:
    times = []
    for _ in range(count):
        sleep(GAP_S)
        began = perf_counter()
        replies = here.session.get("bench/answer", payload=b'{"motion": "left"}', encoding="application/json")
        assert next(iter(replies)).ok is not None
        times.append((perf_counter() - began) * 1e3)
    return median(times)


def run(scale: Scale) -> list[Measured]:
    with stage() as here:
        port, alive = here.tty(), Arrival()
        here.gateway(port)
        watch = here.session.liveliness().declare_subscriber("bench/answer/alive", alive.note, history=True)
        here.bare("answer", "bench/answer")
        alive.wait()
        with frames(port, READING, rate_hz=1.0):  # the gateway does not drive a silent car
            count = scale.count(COMMANDS, 3)
            ours, floor = in_turns(scale, lambda: _command(here, port, count), lambda: _query(here, count))
        watch.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
    return [Measured("command to tty, p50", tuple(ours), tuple(floor), "ms", 1.5, slack=1.0)]

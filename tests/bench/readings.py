"""Time from a write on the tty to a subscriber's callback. The floor is a bare process with pyserial's read and a put.

The gateway publishes a sensors frame as six readings and the frame. The time ends with `sensor/range`, the first one.
"""

from time import perf_counter, sleep

from tests.bench.measured import Measured, Scale, in_turns, percentile
from tests.bench.stage import READING, Arrival, Stage, Tty, stage

FRAMES = 100
GAP_S = 0.02
"""Interval of the frames. A car sends at most one in 37 ms."""


def _times(port: Tty, arrival: Arrival, count: int) -> list[float]:
    times = []
    for _ in range(count):
        sleep(GAP_S)
        began = perf_counter()
        port.write(READING)
        times.append((arrival.wait() - began) * 1e3)
    return times


def run(scale: Scale) -> list[Measured]:
    with stage() as here:
        ours, floor = _measure(here, scale)
    return [
        Measured(
            f"tty to callback, {name}",
            tuple(percentile(times, share) for times in ours),
            tuple(percentile(times, share) for times in floor),
            "ms",
            1.5,
        )
        for name, share in (("p50", 0.5), ("p90", 0.9))
    ]


def _measure(here: Stage, scale: Scale) -> tuple[list[list[float]], list[list[float]]]:
    port, bare_port = here.tty(), here.tty()
    here.gateway(port)
    came, bare_came, alive = Arrival(), Arrival(), Arrival()
    kept = [
        here.session.declare_subscriber("fleet/red/sensor/range", came.note),
        here.session.declare_subscriber("bench/floor", bare_came.note),
        here.session.liveliness().declare_subscriber("bench/floor/alive", alive.note, history=True),
    ]
    here.bare("tty_to_bus", bare_port.path, "bench/floor")
    alive.wait()
    count = scale.count(FRAMES, 5)
    found = in_turns(scale, lambda: _times(port, came, count), lambda: _times(bare_port, bare_came, count))
    for each in kept:
        each.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
    return found

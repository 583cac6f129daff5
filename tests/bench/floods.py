"""`stop` while the bus is flooded: time from the request to the first frame on the tty, and the gateway's memory.

The floor is the same gateway without a flood. The goal of each is 50 ms more at most. For floods of
tokens, the output also has the time in which a bare process answers. Most of the work for a token is Zenoh's own.
"""

import json
import threading
from pathlib import Path
from time import perf_counter, sleep

from tests.bench.measured import Measured, Scale
from tests.bench.stage import READING, Arrival, Stage, Tty, frames, stage
from tests.support.processes import CLOSING_S, PATIENCE_S, REPORT_S, TAKEN, wait_for

FLOODER = Path(__file__).parents[1] / "support" / "flooder.py"
RATES = {"history": 330.0, "operators": 1200.0, "cars": 1200.0, "large": 20.0, "drives": 10_000.0}
"""Maximum messages a second of each flood."""
TOKENS = ("operators", "cars")
STOPS = 5
WARM_S = 2.0
ROUND_S = 6.0
"""Time of a drive and its stop, until the stop is shown."""
KEPT = 1500
"""Number of values of each reading that a gateway caches."""
LONGEST_FRAME = 26
CLOSE = b"$4WD,MODE00#"


class _Car:
    """The car's end of a tty: it reports as in mode 0, and each `MODE00` delays the next report by a second."""

    def __init__(self, port: Tty) -> None:
        self._port = port
        self.stops: list[float] = []
        """Arrival times of the first frame of each stop."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        due = perf_counter()
        came = b""
        while not self._over.is_set():
            came = came[-LONGEST_FRAME:] + self._port.read(max(0.0, due - perf_counter()))
            now = perf_counter()
            if CLOSE in came:
                came = b""
                self.stops.append(now)
                due += CLOSING_S
            if now >= due:
                due = now + REPORT_S
                self._port.write(READING)

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def _trust(here: Stage) -> str:
    """Return the gateway's trust in the car's state; empty without an answer."""
    safety = here.fleet.state("safety")
    return "" if safety is None else str(safety.trust)


def _drives(here: Stage, sender: str) -> bool:
    """Request a drive. Return True if the gateway accepts the request."""
    fields = {"motion": "forward", "duration_s": 10, "sender": sender, "kind": "person"}
    drive = here.session.get("fleet/red/@cmd/drive", payload=json.dumps(fields), timeout=PATIENCE_S)
    return any(reply.ok is not None and json.loads(reply.ok.payload.to_bytes())["status"] in TAKEN for reply in drive)


def _stops(here: Stage, car: _Car, count: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Drive and stop. Return the times from each stop's request to the tty, ms, and those of a bare query before."""
    times, bare = [], []
    for number in range(count):
        # A request before the end of a stop would only join it.
        wait_for(lambda: _trust(here) not in ("", "stopping", "recovering"), "the stop before has ended")
        wait_for(lambda number=number: _drives(here, f"bench{number}"), "the drive is accepted")
        wait_for(lambda: _trust(here) == "driving", "the car drives")
        began = perf_counter()
        assert next(iter(here.session.get("bench/answer", timeout=PATIENCE_S))).ok is not None
        bare.append((perf_counter() - began) * 1e3)
        known, began = len(car.stops), perf_counter()
        here.fleet.ask_all("stop", "red", sender=f"bench{number}", kind="person")
        wait_for(lambda known=known: len(car.stops) > known, "a stop on the tty")
        times.append((car.stops[known] - began) * 1e3)
    return tuple(times), tuple(bare)


def run(scale: Scale) -> list[Measured]:
    found = []
    with stage() as here:
        port = here.tty()
        gateway = here.gateway(port)
        alive = Arrival()
        watch = here.session.liveliness().declare_subscriber("bench/answer/alive", alive.note, history=True)
        here.bare("answer", "bench/answer", "fleet/*", "fleet/@operator/*")
        alive.wait()
        watch.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        with frames(port, READING, rate_hz=500.0):
            wait_for(lambda: here.fleet.state("link").rx_frames > scale.count(KEPT), "every ring is full")
        car, count = _Car(port), scale.count(STOPS)
        rates = dict(list(RATES.items())[: scale.count(len(RATES))])
        warm_s = scale.seconds(WARM_S)
        try:
            sleep(warm_s)
            (floor, bare_floor), held = _stops(here, car, count), (gateway.rss_mb(),)
            for kind, rate in rates.items():
                flooders = 3 if kind == "drives" else 1
                seconds = warm_s + count * ROUND_S
                flood = [
                    here.fleet.start(str(FLOODER), kind, str(rate / flooders), str(seconds)) for _ in range(flooders)
                ]
                sleep(warm_s)
                ours, bare = _stops(here, car, count)
                found.append(Measured(f"stop under a flood of {kind}", ours, floor, "ms", 1.0, slack=50.0))
                found.append(Measured(f"RSS under a flood of {kind}", (gateway.rss_mb(),), held, "MB", 1.0, slack=30.0))
                if kind in TOKENS:
                    found.append(Measured(f"a bare query under a flood of {kind}", bare, bare_floor, "ms", None))
                for each in flood:
                    each.wait()
        finally:
            car.close()
    return found

"""One router with 1 to 100 cars: its CPU, and the bytes that a car costs where somebody subscribes to everything.

A recorder, and the hub of another site where one records, subscribe to everything. The floor is one car. Bytes are
those of loopback, from a gateway to the hub or from the hub to the subscriber, with all that Zenoh and TCP add.
"""

import time
from time import perf_counter

import psutil

from fleet.client.client import Fleet
from schemas.bus import Bus
from tests.bench.fleet import SimulatedFleet, cpu_s
from tests.bench.measured import Measured, Scale
from tests.bench.stage import scratch
from tests.support.ports import free_endpoint
from tests.support.up import Up

SIZES = (1, 10, 50, 100)
WINDOW_S = 10.0
QUEUE = 65_536


class _Everything:
    """A subscriber to all that cars and services say."""

    def __init__(self, bus: Bus) -> None:
        self._channels = [bus.subscribe_channel(each, QUEUE) for each in ("fleet/**", "fleet/@supervisor/**")]

    def take(self) -> tuple[int, int]:
        """Return the number of messages that have come, and their bytes of payload."""
        count = size = 0
        for channel in self._channels:
            while (sample := channel.try_recv()) is not None:
                count, size = count + 1, size + len(sample.payload)
        return count, size


def _loopback_bytes() -> int:
    return int(psutil.net_io_counters(pernic=True)["lo"].bytes_sent)


def run(scale: Scale) -> list[Measured]:
    found: list[Measured] = []
    first: dict[str, float] = {}
    for size in sorted({scale.count(size) for size in SIZES}):
        with scratch() as directory, Up(directory, free_endpoint(), "--sim", str(size), "--no-record") as up:
            fleet = SimulatedFleet(up, size, scale)
            hub = up.hub()
            with Bus.open(up.endpoint) as bus, Fleet(up.endpoint) as client:
                everything = _Everything(bus)
                for what in ("1 report/s", "tracking"):
                    if what == "tracking":
                        fleet.track(client)
                    everything.take()
                    before, lo, began = cpu_s([hub]), _loopback_bytes(), perf_counter()
                    time.sleep(scale.seconds(WINDOW_S, 1.2))
                    seconds = perf_counter() - began
                    share, wire = (cpu_s([hub]) - before) / seconds, (_loopback_bytes() - lo) / seconds
                    count, payload = everything.take()
                    figures = {
                        "hub CPU": (share * 100, "%"),
                        "messages per car": (count / seconds / size, "/s"),
                        "payload per car": (payload / seconds / size / 1e3, "kB/s"),
                        "on the wire per car and link": (wire / 2 / size / 1e3, "kB/s"),
                    }
                    for name, (value, unit) in figures.items():
                        whole = f"{name}, {what}"
                        first.setdefault(whole, value)
                        found.append(Measured(f"{whole}, {size} cars", (value,), (first[whole],), unit, None))
    return found

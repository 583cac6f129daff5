"""A load of numbered messages on the bus, and the comparison of recordings with it."""

import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fleet.recording.reading.session import Session
from schemas import keys
from schemas.bus import Bus, Publisher
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess, wait_for

RATE_HZ = 25.0
CARS_PER_SESSION = 5
READING = b"$4WD,CSB33,PV8.2,GS214,LF0110,HW00,GM00#"


class Load:
    """Cars that track a line. For each frame, a car publishes a reading and the frame. Five cars share a thread.

    A publisher slower than its topic's rate (27 Hz) caches more than ten seconds.
    """

    def __init__(self, endpoint: str, cars: int, rate_hz: float = RATE_HZ) -> None:
        self._rate_hz = rate_hz
        self.sent: dict[str, list[int]] = {}
        """Publication times by key, ns since the epoch. The first message has number 1."""
        self._over = threading.Event()
        self._resting = threading.Event()
        self._rested = threading.Semaphore(0)
        names = [f"car{number}" for number in range(cars)]
        groups = [names[begun : begun + CARS_PER_SESSION] for begun in range(0, cars, CARS_PER_SESSION)]
        self._threads = [threading.Thread(target=self._run, args=(endpoint, group)) for group in groups]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        self.end()

    def rest(self) -> None:
        """Publish no more. The publishers stay and keep their caches."""
        self._resting.set()
        for _ in self._threads:
            assert self._rested.acquire(timeout=PATIENCE_S), "one still publishes"

    def end(self) -> None:
        """Publish no more, and close the publishers with their caches."""
        self._over.set()
        for thread in self._threads:
            thread.join()

    def count(self) -> int:
        """Return the number of published messages."""
        return sum(len(times) for times in list(self.sent.values()))

    def _run(self, endpoint: str, cars: list[str]) -> None:
        with Bus.open(endpoint, timeout_s=30.0) as bus:
            pairs = [[self._publisher(bus, car, topic) for topic in ("sensor/line", "frame/rx")] for car in cars]
            line, frame = pb.Line(left_inner=True), pb.RxFrame(data=READING, published=["sensor/line"])
            due = time.monotonic()
            while not self._over.wait(max(0.0, due - time.monotonic())):
                if self._resting.is_set():
                    self._rested.release()
                    self._over.wait()
                    return
                for lines, frames in pairs:
                    self._put(lines, line)
                    self._put(frames, frame)
                due += 1 / self._rate_hz

    def _publisher(self, bus: Bus, car: str, topic: str) -> Publisher:
        made = bus.publisher(keys.topic_key("fleet", car, topic), TOPICS[topic], car)
        self.sent[made.key] = []
        return made

    def _put(self, publisher: Publisher, message: Any) -> None:
        now = time.time_ns()
        publisher.put(message, now)
        self.sent[publisher.key].append(now)


class Recording:
    """`fleet record` as a process, and its session. The recorder has subscribed when this object is made."""

    def __init__(self, fleet: FleetProcesses, out: Path, *options: str) -> None:
        self.process: GatewayProcess = fleet.start(
            "-m", "fleet.cli", "record", "--sessions", str(out), "--connect", fleet.endpoint, "--json", *options
        )
        self.session = Path(self.process.line()["session"])

    def end(self) -> Any:
        """End the recorder by a signal, and return its last line."""
        assert self.process.end() == 0, self.process.stderr
        return self.process.line()


def kill_hub(fleet: FleetProcesses, chance: random.Random, settled_s: float = 0.3) -> None:
    """Kill the hub. Return when the recorder has started another one."""
    if fleet.hub.popen.poll() is None:
        fleet.hub.kill()
        fleet.hub.wait()
        gone = {str(fleet.hub.pid)}
    else:
        gone = set(fleet.left())
        for pid in gone:
            os.kill(int(pid), signal.SIGKILL)
    wait_for(lambda: set(fleet.left()) - gone, "another hub")
    time.sleep(settled_s + chance.random())  # not a wait: the hub's lifetime is what the test varies


def numbers(sessions: Iterable[Path]) -> dict[str, Counter[int]]:
    """Return by key how often each number is in these sessions. Leave out damaged parts."""
    found: dict[str, Counter[int]] = {}
    for path in sessions:
        for message in Session(path).messages():
            found.setdefault(message.key, Counter())[message.sequence] += 1
    return found


def faults(load: Load, sessions: Iterable[Path]) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return by key the published numbers that are in no session, and the numbers that are recorded twice."""
    found = numbers(sessions)
    lost = {
        key: missing
        for key, times in load.sent.items()
        if (missing := sorted(set(range(1, len(times) + 1)) - set(found.get(key, ()))))
    }
    twice = {
        key: again
        for key in load.sent
        if (again := [number for number, count in found.get(key, Counter()).items() if count > 1])
    }
    return lost, twice

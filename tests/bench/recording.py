"""CPU per recorded message; the floor is a subscriber's callback that calls `add_message`.

Both are processes of their own, given the same messages at the same pace: what forty cars send that track a line.
Everything that a process does is in its CPU time, so ours pays for its flushes, its status and its counting, too.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import sleep, time_ns
from typing import Any

from schemas import bus, keys
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.bench.measured import Measured, in_turns
from tests.bench.stage import READING, Stage, perf_counter, stage
from tests.support.processes import Process

CARS = 40
TOPIC_NAMES = ("sensor/line", "frame/rx")
ROUNDS = 50
ROUND_S = 1 / 25
SETTLE_S = 0.3
"""For what is still under way when the last message was sent."""


def _publishers(opened: bus.Bus, fleet: str) -> list[bus.Publisher]:
    return [
        opened.publisher(keys.topic_key(fleet, f"car{number}", name), TOPICS[name], f"car{number}")
        for number in range(CARS)
        for name in TOPIC_NAMES
    ]


def _cost(here: Stage, fleet: str, start: Callable[[Path], Process]) -> float:
    """CPU microseconds per message."""
    publishers = _publishers(here.fleet.bus, fleet)
    line = pb.Line(left_outer=True)
    frame = pb.RxFrame(data=READING, verdict="sensors", published=["sensor/line"])
    with tempfile.TemporaryDirectory(dir=here.fleet.directory) as directory:
        process = start(Path(directory))
        assert process.line()["ready"]
        due = perf_counter()
        for number in range(ROUNDS * len(publishers)):
            if number % len(TOPIC_NAMES) == 0:  # the next car's turn
                due += ROUND_S / CARS
                sleep(max(0.0, due - perf_counter()))
            publisher = publishers[number % len(publishers)]
            publisher.put(line if publisher.topic.name == "sensor/line" else frame, time_ns())
        sleep(SETTLE_S)
        found: Any = _told_to_end(process)
    assert found["messages"] >= ROUNDS * len(publishers), found
    return float(found["cpu_s"]) / (ROUNDS * len(publishers)) * 1e6


def _told_to_end(process: Process) -> Any:
    assert process.popen.stdin is not None
    process.popen.stdin.write("\n")
    process.popen.stdin.flush()
    found = process.line()
    process.wait()
    return found


def run() -> list[Measured]:
    with stage() as here:
        ours, floor = in_turns(
            lambda: _cost(
                here,
                "ours",
                lambda d: here.fleet.start("-m", "tests.bench.record_ours", here.fleet.endpoint, "ours", str(d)),
            ),
            lambda: _cost(here, "floor", lambda d: here.bare("record", "floor/**", str(d / "floor.mcap"))),
        )
    return [Measured("record a message (CPU)", tuple(ours), tuple(floor), "us", 1.3)]

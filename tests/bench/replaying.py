"""Export time per message. The floor is Rerun's own MCAP importer, which writes no layout and no lenses."""

from pathlib import Path
from time import perf_counter

import rerun.chunk as rrc
from mcap.writer import Writer

from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.session import Session
from fleet.replay.rerun.rrd_export import export
from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.stage import scratch
from tests.fleet.replay.make_session import CARS, Made, drive_about

SECONDS = 1200
SHORTEST_S = 20


def write_session(path: Path, seconds: int) -> int:
    """Write a session of three cars, and return its number of messages."""
    made = Made(path, Writer)
    for index, car in enumerate(CARS):
        drive_about(made, car, index, seconds)
    made.close()
    return sum(made.counts.values())


def import_s(source: Path, directory: Path) -> float:
    """Export with Rerun's own importer, and return the time of the export."""
    began = perf_counter()
    stream = rrc.McapReader(source).stream()
    stream.write_rrd(directory / "floor.rrd", application_id="floor", recording_id="floor")
    return perf_counter() - began


def run(scale: Scale) -> list[Measured]:
    with scratch() as directory:
        large, recorded = directory / "large.mcap", directory / "recorded.mcap"
        count = write_session(large, scale.count(SECONDS, SHORTEST_S))
        with McapCopy(recorded) as copy:  # with the recorder's chunks of one second
            for row in Session(large).rows():
                copy.add(row)

        def ours(source: Path) -> float:
            began = perf_counter()
            held = export(Session(source), directory / "ours.rrd").shown
            took = perf_counter() - began
            assert sum(held.values()) == count
            return took / count * 1e6

        def measured(name: str, source: Path) -> Measured:
            mine, least = in_turns(scale, lambda: ours(source), lambda: import_s(source, directory) / count * 1e6)
            return Measured(name, tuple(mine), tuple(least), "us", 2.0)

        return [
            measured("export a message to Rerun", large),
            measured("export a recorded message", recorded),
        ]

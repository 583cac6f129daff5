"""Time of a replay export per message, against Rerun's own MCAP importer."""

import tempfile
import time
from pathlib import Path

import rerun.experimental as rrc

from fleet.recording.session import Session
from fleet.replay.to_rerun import export
from tests.bench.measure import Measured, in_turn
from tests.fleet.replay.make_session import make

SECONDS = 1800


def run() -> list[Measured]:
    with tempfile.TemporaryDirectory() as scratch:
        recorded = Path(scratch) / "session.mcap"
        number = make(recorded, SECONDS).total()
        out = Path(scratch) / "out.rrd"

        def ours() -> float:
            began = time.perf_counter()
            export(Session.open(recorded), out)
            return (time.perf_counter() - began) / number * 1e6

        def floor() -> float:
            began = time.perf_counter()
            rrc.McapReader(recorded).stream().write_rrd(out, application_id="floor", recording_id="floor")
            return (time.perf_counter() - began) / number * 1e6

        return [Measured(f"export a message ({number} messages)", *in_turn(ours, floor), "us", 2.0)]

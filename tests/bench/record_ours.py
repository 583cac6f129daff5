"""The recorder in a process of its own, for the benchmark `record`. Arguments: endpoint, fleet, directory.

Its lines of input and output are those of floors/record.py.
"""

import json
import sys
import time
from pathlib import Path

from fleet.recording.writing.recorder import Recorder
from schemas.bus import Bus


def main() -> None:
    endpoint, fleet, directory = sys.argv[1:]
    with Bus.open(endpoint) as bus:
        recorder = Recorder(bus, fleet, Path(directory))
        recorder.start()
        print(json.dumps({"ready": True}), flush=True)
        before = time.process_time()
        published = int(sys.stdin.readline())
        deadline = time.monotonic() + 10.0
        while recorder._status().messages < published and time.monotonic() < deadline:
            time.sleep(0.02)
        cpu_s = time.process_time() - before
        print(json.dumps({"messages": recorder.close().messages, "cpu_s": cpu_s}), flush=True)


main()

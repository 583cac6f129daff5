"""What benchmark `record` measures: the recorder in a process of its own. Arguments: endpoint, fleet, directory.

Speaks as floors/record.py does.
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
        sys.stdin.readline()
        cpu_s = time.process_time() - before
        print(json.dumps({"messages": recorder.close().messages, "cpu_s": cpu_s}), flush=True)


main()

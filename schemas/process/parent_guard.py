"""Runs one program and ends it when its own standard input ends: `python -m schemas.process.parent_guard PROGRAM ...`.

The parent of this process has the other end of stdin. So the program ends with the parent, even if the parent is
killed. The first line on stdout is the program's process id.
"""

import os
import signal
import subprocess
import sys
import threading
from types import FrameType
from typing import Final

from schemas.process.children import end

PROGRAM_EXIT_TIMEOUT_S: Final = 3.0


def main() -> int:
    """Run the program and return its exit code."""
    child = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    sys.stdout.write(f"{child.pid}\n")
    sys.stdout.flush()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        child.terminate()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 64):
            pass
        end(child, PROGRAM_EXIT_TIMEOUT_S)

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)
    threading.Thread(target=watch, daemon=True).start()
    return child.wait()


if __name__ == "__main__":
    sys.exit(main())

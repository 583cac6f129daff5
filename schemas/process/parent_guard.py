"""Runs one program and ends it when its own standard input ends: `python -m schemas.process.parent_guard PROGRAM ...`.

Whoever started it holds the other end, so the program goes with its starter however that ends, SIGKILL included. The
first line on stdout is the program's process id.
"""

import os
import signal
import subprocess
import sys
import threading
from types import FrameType
from typing import Final

GRACE_S: Final = 3.0


def main() -> int:
    """The program's exit code."""
    child = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    sys.stdout.write(f"{child.pid}\n")
    sys.stdout.flush()

    def end(_number: int, _frame: FrameType | None) -> None:
        child.terminate()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 64):
            pass
        child.terminate()
        try:
            child.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            child.kill()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    threading.Thread(target=watch, daemon=True).start()
    return child.wait()


if __name__ == "__main__":
    sys.exit(main())

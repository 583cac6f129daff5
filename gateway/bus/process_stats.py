"""Measures CPU and memory of the gateway's process."""

import os
import sys
import time
from pathlib import Path
from typing import Final

from schemas.gen import fleet_v1_pb2 as pb

_STATM: Final = Path("/proc/self/statm")


class ProcessStats:
    """CPU and memory of this process, and when it started."""

    def __init__(self) -> None:
        self.started = time.monotonic()
        """Time of the start, s, monotonic."""
        self._cpu_s = time.process_time()
        self._at = self.started

    def fill(self, message: pb.Health, now: float) -> None:
        """Fill in pid, CPU share since the last call, and memory."""
        cpu_s = time.process_time()
        message.pid = os.getpid()
        message.cpu = (cpu_s - self._cpu_s) / max(now - self._at, 1e-3)
        message.rss_mb = _rss_mb()
        self._cpu_s, self._at = cpu_s, now


def _rss_mb() -> float:
    try:
        pages = int(_STATM.read_bytes().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except FileNotFoundError:
        pass
    try:
        import resource
    except ImportError:  # Windows has no such module
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3

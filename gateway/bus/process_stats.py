"""Measures CPU and memory of the gateway's process."""

import os
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

from schemas.gen import fleet_v1_pb2 as pb

CPU_SHARE_WINDOW_S: Final = 1.0
"""Minimum time over which the CPU share is measured. Health is published early after a new finding about the car, and
over the milliseconds in which the gateway worked on that finding, the share would be 100 % and more."""
_STATM: Final = Path("/proc/self/statm")


class ProcessStats:
    """CPU and memory of this process, and when it started."""

    def __init__(
        self, monotonic_s: Callable[[], float] = time.monotonic, cpu_s: Callable[[], float] = time.process_time
    ) -> None:
        self._monotonic_s = monotonic_s
        self._cpu_s = cpu_s
        self.started = monotonic_s()
        """Time of the start, s, monotonic."""
        self._samples = deque([(self.started, cpu_s())])
        """Times, s, monotonic, and the CPU time that was used until then. The first is the beginning of the window."""

    def fill(self, message: pb.Health) -> None:
        """Fill in pid, memory, and the CPU share of the last second, or since the start if that is shorter."""
        message.pid = os.getpid()
        message.cpu = self._cpu_share()
        message.rss_mb = _rss_mb()

    def _cpu_share(self) -> float:
        now, used_s = self._monotonic_s(), self._cpu_s()
        self._samples.append((now, used_s))
        while len(self._samples) > 2 and self._samples[1][0] <= now - CPU_SHARE_WINDOW_S:
            self._samples.popleft()
        began_at, used_before_s = self._samples[0]
        return (used_s - used_before_s) / max(now - began_at, 1e-3)


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

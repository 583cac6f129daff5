"""Reads how much CPU time a process has had. Decides nothing: hang.py does."""

import subprocess
from pathlib import Path
from typing import Final

from fleet.supervisor.hang import CpuTime

_PROC: Final = Path("/proc")
_PS_TIMEOUT_S: Final = 1.0
_READY: Final = frozenset("RD")
"""States of a process that runs or waits for a processor (R), or for the disk (D)."""


def read(pid: int) -> CpuTime | None:
    """Return the CPU time of a process's main thread (Linux) or of the process (elsewhere); None if unknown.

    The asyncio loop of a gateway is its main thread. Threads of Zenoh run on while it is blocked.
    """
    if not _PROC.joinpath("self", "stat").exists():
        return _of_ps(pid)
    try:
        # What follows the name, which may hold blanks and brackets, begins with the state.
        state = (_PROC / str(pid) / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
        run_ns, wait_ns, *_ = (_PROC / str(pid) / "schedstat").read_text(encoding="ascii").split()
    except (OSError, ValueError, IndexError):
        return None
    return CpuTime(int(run_ns) / 1e9, int(wait_ns) / 1e9, state in _READY)


def _of_ps(pid: int) -> CpuTime | None:
    """Without /proc (macOS): `ps` tells it in hundredths of a second."""
    command = ["ps", "-o", "state=,time=", "-p", str(pid)]
    try:
        listed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_PS_TIMEOUT_S).stdout
        state, spent = listed.split()
        *minutes, seconds = spent.replace("-", ":").split(":")
        run_s = float(seconds)
        for factor, value in zip((60, 3600, 86400), reversed(minutes), strict=False):
            run_s += factor * int(value)
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return CpuTime(run_s, ready=state[0] in _READY)

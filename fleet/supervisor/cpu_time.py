"""Reads the CPU time of a process. `hang` interprets it."""

import subprocess
from pathlib import Path
from typing import Final

from fleet.supervisor.hang import CpuTime

_PROC: Final = Path("/proc")
_PS_TIMEOUT_S: Final = 1.0
_READY: Final = frozenset("RD")
"""Process states: running or ready to run (R), waiting for the disk (D)."""


def read(pid: int) -> CpuTime | None:
    """Return the CPU time of a process's main thread (Linux) or of the process (other systems). None if unknown."""
    # A gateway's asyncio loop runs on its main thread. Zenoh's threads keep running even if that thread is blocked.
    if not _PROC.joinpath("self", "stat").exists():
        return _of_ps(pid)
    try:
        # The state comes after the name, which is in brackets and may itself contain blanks and brackets.
        state = (_PROC / str(pid) / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
        run_ns, wait_ns, *_ = (_PROC / str(pid) / "schedstat").read_text(encoding="ascii").split()
    except (OSError, ValueError, IndexError):
        return None
    return CpuTime(int(run_ns) / 1e9, int(wait_ns) / 1e9, state in _READY)


def _of_ps(pid: int) -> CpuTime | None:
    """Return the CPU time from `ps`, for systems without /proc (macOS)."""
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

"""Finds the process that has locked a port, as gateways do (Linux)."""

import os
import re
from pathlib import Path
from typing import Final

LOCKS: Final = Path("/proc/locks")
_LOCK: Final = re.compile(r"FLOCK .* (?P<pid>-?\d+) (?P<major>[0-9a-f]+):(?P<minor>[0-9a-f]+):(?P<inode>\d+) ")
_MAX_COMMAND_LENGTH: Final = 80


def find_holder(file_stat: os.stat_result) -> str | None:
    """Return which process has locked a file or device, in words; None if none has, or if that is unknown."""
    try:
        locks = LOCKS.read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    place = (os.major(file_stat.st_dev), os.minor(file_stat.st_dev), file_stat.st_ino)
    for line in locks.splitlines():
        lock = _LOCK.search(line)
        if lock and (int(lock["major"], 16), int(lock["minor"], 16), int(lock["inode"])) == place:
            return _describe(int(lock["pid"]))
    return None


def _describe(pid: int) -> str:
    if pid <= 0:  # of another container
        return "another program"
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return f"process {pid}"
    command = " ".join(filter(None, words))
    return f"process {pid} ({command[:_MAX_COMMAND_LENGTH]})" if command.isprintable() and command else f"process {pid}"

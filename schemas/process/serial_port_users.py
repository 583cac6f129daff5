"""Finds the processes that have locked a port, as gateways do, or have it open (Linux)."""

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

LOCKS: Final = Path("/proc/locks")
_PROC: Final = Path("/proc")
_LOCK: Final = re.compile(r"FLOCK .* (?P<pid>-?\d+) (?P<major>[0-9a-f]+):(?P<minor>[0-9a-f]+):(?P<inode>\d+) ")
_PSEUDO: Final = re.compile(r"/dev/pts/(\d+)")
_MASTER: Final = re.compile(r"^tty-index:\s*(\d+)$", re.MULTILINE)
_MAX_COMMAND_LENGTH: Final = 80


def find_holder(file_stat: os.stat_result) -> str | None:
    """Describe the process that has locked a file or device. Return None if there is none, or if that is unknown."""
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


def find_users(path: str) -> list[str]:
    """Describe the other processes that have a device open. Only root finds those of other users.

    Takes some 10 ms. Empty on a system other than Linux.
    """
    try:
        device = os.stat(path)  # noqa: PTH116 - a device path, not a file to work with
    except (OSError, ValueError):
        return []
    if not stat.S_ISCHR(device.st_mode):
        return []
    terminal = _PSEUDO.fullmatch(os.path.realpath(path))
    users = [pid for pid in _processes() if pid != os.getpid() and _has_open(pid, device.st_rdev)]
    # A simulated car uses the other end of its terminal, and keeps this end open too, so leave it out.
    return [_describe(pid) for pid in users if terminal is None or not _is_master(pid, terminal[1])]


def how_to_find_users(path: str) -> str:
    """Return the command that lists the programs that have a device open, for a person."""
    return f"sudo fuser -v {path}" if _PROC.is_dir() else f"lsof {path}"


def is_running(command: str) -> bool:
    """Return True if a process with this name runs. False if that is unknown."""
    for pid in _processes():
        try:
            name = (_PROC / str(pid) / "comm").read_text(encoding="utf-8", errors="replace")
        except OSError:  # it has ended
            continue
        if name.rstrip("\n") == command:
            return True
    return False


def _processes() -> Iterator[int]:
    try:
        names = os.listdir(_PROC)  # noqa: PTH208 - not a path for each of several hundred processes
    except OSError:
        return
    yield from (int(name) for name in names if name.isdecimal())


def _has_open(pid: int, device: int) -> bool:
    """Return True if the process has the device with this number open."""
    try:
        with os.scandir(_PROC / str(pid) / "fd") as descriptors:
            return any(_is_device(each.path, device) for each in descriptors)
    except OSError:  # it has ended, or belongs to another user
        return False


def _is_master(pid: int, terminal: str) -> bool:
    """Return True if the process has the other end of a pseudo terminal."""
    try:
        for each in (_PROC / str(pid) / "fdinfo").iterdir():
            master = _MASTER.search(each.read_text(encoding="ascii", errors="replace"))
            if master and master[1] == terminal:
                return True
    except OSError:  # it has ended
        pass
    return False


def _is_device(descriptor: str, device: int) -> bool:
    # Look at the link first: `stat` of a descriptor may wait for a network file system.
    try:
        if not os.readlink(descriptor).startswith("/dev/"):  # noqa: PTH115 - a path as text is enough
            return False
        found = os.stat(descriptor)  # noqa: PTH116 - a descriptor
    except OSError:
        return False
    return stat.S_ISCHR(found.st_mode) and found.st_rdev == device


def _describe(pid: int) -> str:
    if pid <= 0:  # of another container
        return "another program"
    try:
        words = (_PROC / str(pid) / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return f"process {pid}"
    command = " ".join(filter(None, words))
    return f"process {pid} ({command[:_MAX_COMMAND_LENGTH]})" if command.isprintable() and command else f"process {pid}"

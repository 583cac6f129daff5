"""Tells a process whether the one that started it still runs."""

import os


def parent_option() -> tuple[str, str]:
    """Return the option that makes a new process end with this one."""
    return ("--parent", str(os.getpid()))


def watched_pid(starter: int | None) -> int | None:
    """Return the process id that `os.getppid` reports while the starter runs, or None if nothing is to be watched.

    The starter passes its own id, because it may end before the new process could ask for it. On Windows, `os.getppid`
    reports the launcher of the virtual environment, and never changes.
    """
    return starter if starter is None or os.name == "posix" else os.getppid()


def has_ended(watched: int | None) -> bool:
    """Return True if the process of this `watched_pid` has ended. Without one, return False."""
    return watched not in (None, os.getppid())

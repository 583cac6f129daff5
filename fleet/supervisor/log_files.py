"""The log files of the processes of a run: their lines, their size, and the directory of the run."""

import contextlib
import hashlib
import logging
import os
import sys
import time
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Final

from schemas.atomic_file import write_atomically
from schemas.state_dir import directory_of

MAX_LOG_BYTES: Final = 1_000_000
"""Maximum size of one log file. Each process has at most two."""

MAX_RUN_DIRECTORIES: Final = 10
"""Number of run directories that are kept. Older ones are removed, unless they may be in use."""

RUN_IN_USE_S: Final = 3600.0
"""A run directory that was changed within this time may be in use and is not removed."""


class Log(RotatingFileHandler):
    """The log file of one process. At rollover it becomes `.log.1` and replaces an older one."""

    def __init__(self, path: Path, limit_bytes: int = MAX_LOG_BYTES) -> None:
        super().__init__(path, "a", limit_bytes, backupCount=1, encoding="utf-8", delay=True, errors="replace")
        self.path = path
        self.older = path.with_suffix(".log.1")
        self.failed = ""
        """Why a line could not be written. Empty if all lines were written."""

    def add(self, line: str, now: float) -> None:
        """Add a line. `now` is in s since the epoch."""
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        name = self.path.stem.lstrip("@")  # the names of services begin with @
        text = f"{stamp} {name} | {line}"
        self.handle(logging.makeLogRecord({"msg": text}))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: ARG002, N802 - logging calls it so
        """Note why the line was not written. A full disk must not end the supervisor."""
        error = sys.exception()
        self.failed = f"{self.path} cannot be written: {getattr(error, 'strerror', error)}"


def parse_log_line(line: str) -> dict[str, str]:
    """Split a log line into time, process name and text. A truncated line has only a text."""
    when, bar, words = line.rstrip("\n").partition(" | ")
    stamp, _, name = when.partition(" ")
    return {"time": stamp, "name": name, "line": words} if bar else {"time": "", "name": "", "line": when}


def runs_directory(fleet: str, endpoint: str) -> Path:
    """Return the directory of all runs of a fleet."""
    return directory_of(endpoint) / "runs" / fleet


def new_run(fleet: str, endpoint: str, now: float) -> Path:
    """Create a directory for one run and remove the oldest ones. Raises OSError."""
    place = runs_directory(fleet, endpoint)
    path = place / f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(now))}-{os.getpid()}"
    path.mkdir(parents=True)
    for old in sorted((each for each in place.iterdir() if each.is_dir()), reverse=True)[MAX_RUN_DIRECTORIES:]:
        with contextlib.suppress(OSError):  # another `fleet up` removes it at this moment
            if now - old.stat().st_mtime > RUN_IN_USE_S:
                for file in old.iterdir():
                    file.unlink()
                old.rmdir()
    return path


def write_copy(directory: Path, name: str, text: str) -> Path:
    """Write a text to a file whose name contains its hash, unless that file exists. Raises OSError."""
    data = text.encode()
    path = directory / f"{name}-{hashlib.sha256(data).hexdigest()[:12]}.yaml"
    if not path.is_file():
        write_atomically(path, data)
    return path


def remove_links(directory: Path) -> None:
    """Remove the symlinks to the terminals of a simulator that has ended.

    The system may give the same terminals to other cars.
    """
    for path in directory.glob("*.tty"):
        with contextlib.suppress(OSError):
            path.unlink()

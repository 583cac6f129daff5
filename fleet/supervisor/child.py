"""One child process, its log file of limited size, and the directory of a run."""

import asyncio
import contextlib
import hashlib
import logging
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Final

from schemas.atomic_file import write_atomically
from schemas.process import json_log
from schemas.process.children import OWN_GROUP, kill
from schemas.state_dir import directory_of

MAX_LOG_BYTES: Final = 1_000_000
"""Maximum size of one log file. Each process has at most two."""
MAX_LINE_BYTES: Final = 65_536
MAX_RUN_DIRECTORIES: Final = 10
"""Number of run directories that are kept. Older ones are removed, unless they may be in use."""
RUN_IN_USE_S: Final = 3600.0
"""A run directory that was changed within this time may be in use and is not removed."""
_GATEWAY_LOG_LINE: Final = re.compile(r"\d\d:\d\d:\d\d \S+ (?P<level>[A-Z]+) (?P<words>.*)")
"""A line of a gateway's log, as gateway/cli.py formats it."""


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


class Child:
    """A running child process."""

    def __init__(self, process: asyncio.subprocess.Process, log: Log) -> None:
        self._process = process
        self.log = log
        self.last = ""
        """Last error line on stderr: usually the reason why the process ended."""
        self.task: asyncio.Task[None]

    @classmethod
    async def start(
        cls,
        command: Sequence[str],
        environment: Mapping[str, str],
        log: Log,
        on_line: Callable[[str], bool | None],
        on_exit: Callable[[int], None],
    ) -> "Child":
        """Start a process. `on_exit` is called with the exit code.

        `on_line` is called with each line of stdout, and returns False for a line that should not be logged.

        Raises OSError.
        """
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=dict(environment),
            process_group=OWN_GROUP,
        )
        child = cls(process, log)
        child.task = asyncio.ensure_future(child._follow(on_line, on_exit))
        return child

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def signal(self, number: signal.Signals) -> None:
        """Send a signal. Do nothing if the process has ended."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def kill(self) -> None:
        """Kill the process."""
        kill(self._process)

    def write_line(self, line: str) -> None:
        """Write a line to the process's stdin. Do nothing if stdin is closed."""
        if self._process.stdin is not None and not self._process.stdin.is_closing():
            self._process.stdin.write(line.encode() + b"\n")

    async def _follow(self, on_line: Callable[[str], bool | None], on_exit: Callable[[int], None]) -> None:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        pumps = asyncio.gather(
            self._pump(self._process.stdout, on_line), self._pump(self._process.stderr, self._on_stderr_line)
        )
        code = await self._process.wait()
        # A grandchild may keep the pipes open after the process has ended.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(pumps, 1.0)
        if self._process.stdin is not None:
            self._process.stdin.close()
        on_exit(code)

    def _on_stderr_line(self, line: str) -> None:
        found = _GATEWAY_LOG_LINE.fullmatch(line)
        logged = (found["level"], found["words"]) if found else json_log.message_in(line)
        if logged is None:
            self.last = line
        elif logged[0] in ("ERROR", "CRITICAL"):
            self.last = logged[1]

    async def _pump(self, stream: asyncio.StreamReader, take: Callable[[str], bool | None]) -> None:
        rest = b""
        while data := await stream.read(4096):
            *whole, rest = (rest + data).split(b"\n")
            rest = rest[-MAX_LINE_BYTES:]
            for line in whole:
                self._line(line, take)
        if rest:
            self._line(rest, take)

    def _line(self, line: bytes, take: Callable[[str], bool | None]) -> None:
        text = line.decode("utf-8", "replace").rstrip()
        if text and take(text) is not False:
            self.log.add(text, time.time())

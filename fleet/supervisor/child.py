"""One child process: started in a group of its own, its lines taken, its log kept within bounds. Decides nothing.

A group of its own: Ctrl-C at the terminal comes to it from its supervisor, and in order.
"""

import asyncio
import contextlib
import hashlib
import os
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from schemas.state_dir import directory_of

LOG_BYTES: Final = 1_000_000
"""Of one log file; there are at most two for each process."""
LINE_BYTES: Final = 65_536
RUNS: Final = 10
"""Directories of runs that are kept."""
IN_USE_S: Final = 3600.0
"""A run that was touched within this time may go on: it is not removed."""
_LOGGED: Final = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (?P<level>[A-Z]+) (?P<words>.*)")


class Log:
    """The lines of one process, each with its time; when the file is full it becomes `.1`, in place of an older one."""

    def __init__(self, path: Path, limit_bytes: int = LOG_BYTES) -> None:
        self.path = path
        self._limit = limit_bytes
        self.failed = ""
        """Why nothing is written any more."""

    def add(self, line: str, now: float) -> None:
        """Add a line; `now` in s since the epoch. A disk that takes no more ends the log, not the supervisor."""
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        try:
            with self.path.open("a", encoding="utf-8", errors="replace") as file:
                file.write(f"{stamp} {self.path.stem.lstrip('@')} | {line}\n")
                full = file.tell() >= self._limit
            if full:
                self.path.replace(self.older)
        except OSError as error:
            self.failed = f"{self.path} cannot be written: {error.strerror}"

    @property
    def older(self) -> Path:
        """Where the lines before are."""
        return self.path.with_suffix(".log.1")


def entry(line: str) -> dict[str, str]:
    """A line of a log taken apart: when, which process, and what it said; of one that was cut, only that."""
    when, bar, words = line.rstrip("\n").partition(" | ")
    stamp, _, name = when.partition(" ")
    return {"time": stamp, "name": name, "line": words} if bar else {"time": "", "name": "", "line": when}


def runs(fleet: str, endpoint: str) -> Path:
    """Where the runs of a fleet are kept."""
    return directory_of(endpoint) / "runs" / fleet


def new_run(fleet: str, endpoint: str, now: float) -> Path:
    """A directory for one run; the oldest that are over are removed. Raises OSError."""
    place = runs(fleet, endpoint)
    path = place / f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime(now))}-{os.getpid()}"
    path.mkdir(parents=True)
    for old in sorted((each for each in place.iterdir() if each.is_dir()), reverse=True)[RUNS:]:
        with contextlib.suppress(OSError):  # another `fleet up` removes it at this moment
            if now - old.stat().st_mtime > IN_USE_S:
                for file in old.iterdir():
                    file.unlink()
                old.rmdir()
    return path


def copied(directory: Path, name: str, text: str) -> Path:
    """A file of this text, named by it: it is whole, or not there. Raises OSError."""
    data = text.encode()
    path = directory / f"{name}-{hashlib.sha256(data).hexdigest()[:12]}.yaml"
    if not path.is_file():
        begun = path.with_suffix(".part")
        try:
            begun.write_bytes(data)
            begun.replace(path)
        finally:
            begun.unlink(missing_ok=True)
    return path


def remove_links(directory: Path) -> None:
    """Remove the symlinks to terminals of a simulator that has ended: another's car may be at such a terminal next."""
    for path in directory.glob("*.tty"):
        with contextlib.suppress(OSError):
            path.unlink()


class Child:
    """A process that was started; `said` hears each line of its stdout, `ended` once how it ended."""

    def __init__(self, process: asyncio.subprocess.Process, log: Log) -> None:
        self._process = process
        self.log = log
        self.last = ""
        """Its last line on stderr that is no mere note: why it ended, if it knew."""
        self.task: asyncio.Task[None]

    @classmethod
    async def start(
        cls,
        command: Sequence[str],
        environment: Mapping[str, str],
        log: Log,
        said: Callable[[str], None],
        ended: Callable[[int], None],
    ) -> "Child":
        """Start it; raises OSError."""
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=dict(environment),
            process_group=0 if os.name == "posix" else None,
        )
        child = cls(process, log)
        child.task = asyncio.ensure_future(child._follow(said, ended))
        return child

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def signal(self, number: signal.Signals) -> None:
        """Send a signal; nothing if it has ended."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def kill(self) -> None:
        """End it without a word."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def tell(self, line: str) -> None:
        """Write a line to its stdin, which may be closed."""
        if self._process.stdin is not None and not self._process.stdin.is_closing():
            self._process.stdin.write(line.encode() + b"\n")

    async def _follow(self, said: Callable[[str], None], ended: Callable[[int], None]) -> None:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        pumps = asyncio.gather(
            self._pump(self._process.stdout, said), self._pump(self._process.stderr, self._complained)
        )
        code = await self._process.wait()
        # A grandchild may hold the pipes open for longer than the process lives.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(pumps, 1.0)
        if self._process.stdin is not None:
            self._process.stdin.close()
        ended(code)

    def _complained(self, line: str) -> None:
        logged = _LOGGED.fullmatch(line)
        if logged is None:
            self.last = line
        elif logged["level"] in ("ERROR", "CRITICAL"):
            self.last = logged["words"]

    async def _pump(self, stream: asyncio.StreamReader, take: Callable[[str], None]) -> None:
        rest = b""
        while data := await stream.read(4096):
            *whole, rest = (rest + data).split(b"\n")
            rest = rest[-LINE_BYTES:]
            for line in whole:
                self._line(line, take)
        if rest:
            self._line(rest, take)

    def _line(self, line: bytes, take: Callable[[str], None]) -> None:
        text = line.decode("utf-8", "replace").rstrip()
        if text:
            self.log.add(text, time.time())
            take(text)

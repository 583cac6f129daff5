"""One child process, whose output goes to its log file."""

import asyncio
import contextlib
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from fleet.supervisor.log_files import Log
from schemas.process import json_log
from schemas.process.children import OWN_GROUP, kill

MAX_LINE_BYTES: Final = 65_536
_GATEWAY_LOG_LINE: Final = re.compile(r"\d\d:\d\d:\d\d \S+ (?P<level>[A-Z]+) (?P<words>.*)")
"""A line of a gateway's log, as gateway/cli.py formats it."""


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

"""A process of low priority that answers questions one at a time. A question and an answer are one line of JSON each.

Python code that takes seconds must not run in the console, not even in a thread, because it would hold the interpreter
lock while a STOP waits.
"""

import asyncio
import json
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from typing import Any, Final

from schemas.process.children import kill

NICENESS: Final = 10
"""The console, the gateways and the recorder go first."""
_MAX_ANSWER_BYTES: Final = 64 * 1024 * 1024
"""Maximum size of an answer. A plan of 64 KiB may have a fault in each line, with a text of 200 bytes each: 16 MB. The
lanes of fifty cars on a time line, each lane with the maximum number of spans, take some 60 MB."""


class TooManyQuestions(Exception):
    """Too many other questions of the same person have no answer yet."""


class Worker:
    """The process. It starts with the first question, and ends when there was no question for a while.

    module: the module that it runs, which calls `serve_lines`. timeout_s: timeout of one answer. idle_s: time without a
    question after which it ends. max_open: maximum number of questions of one person without an answer.
    """

    def __init__(self, module: str, *, timeout_s: float, idle_s: float, max_open: int) -> None:
        self._module = module
        self._timeout_s = timeout_s
        self._idle_s = idle_s
        self._max_open = max_open
        self._process: Process | None = None
        self._started: list[Process] = []
        """The processes that may not have ended yet."""
        self._turn = asyncio.Lock()
        self._open: Counter[Hashable] = Counter()
        self._idle: asyncio.TimerHandle | None = None

    def is_busy(self, person: Hashable) -> bool:
        """Return True if this person may not ask another question now."""
        return self._open[person] >= self._max_open

    async def ask(self, question: Any, person: Hashable) -> dict[str, Any] | None:
        """Return the answer to a question (JSON values). Raises TooManyQuestions.

        Return None if no answer comes in time, or if the process dies of the question twice.
        """
        if self.is_busy(person):
            raise TooManyQuestions
        self._open[person] += 1
        line = json.dumps(question).encode() + b"\n"
        try:
            async with self._turn:
                return await self._ask(line)
        finally:
            self._open[person] -= 1
            if not self._open[person]:
                del self._open[person]

    async def _ask(self, line: bytes) -> dict[str, Any] | None:
        if self._idle is not None:
            self._idle.cancel()
        try:
            async with asyncio.timeout(self._timeout_s):
                # The process may have died since the last question: then a new one answers.
                found = await self._answer(line) or await self._answer(line)
        except TimeoutError:
            found = None
        self._idle = asyncio.get_running_loop().call_later(self._idle_s, self._kill)
        return found

    async def _answer(self, line: bytes) -> dict[str, Any] | None:
        """Return the answer of the process, or None if the process has died."""
        # Keep the process only if its answer was read. Otherwise the next question would get the answer that nobody has
        # read.
        process, self._process = self._process or await self._start(), None
        answered = False
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(line)
            await process.stdin.drain()
            found: dict[str, Any] = json.loads(await process.stdout.readline())
            answered = True
        except (OSError, ValueError):
            return None
        else:
            self._process = process
            return found
        finally:
            if not answered:
                kill(process)

    async def _start(self) -> Process:
        command = (sys.executable, "-m", self._module)
        made = await asyncio.create_subprocess_exec(*command, stdin=PIPE, stdout=PIPE, limit=_MAX_ANSWER_BYTES)
        self._started = [*(each for each in self._started if each.returncode is None), made]
        return made

    def _kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            kill(process)

    async def close(self) -> None:
        """End the process."""
        if self._idle is not None:
            self._idle.cancel()
        self._kill()
        for each in self._started:
            kill(each)
            await each.wait()


def serve_lines(answer: Callable[[Any], dict[str, Any]], lines: Iterable[str] = sys.stdin) -> None:
    """Answer each line of stdin by a line on stdout. Return when stdin ends.

    This is called in the process of a worker.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of the terminal
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    for line in lines:
        sys.stdout.write(json.dumps(answer(json.loads(line)), separators=(",", ":")) + "\n")
        sys.stdout.flush()

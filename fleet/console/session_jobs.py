"""Runs `fleet` in processes for the sessions page: a few at a time, at most one for each person, at low priority."""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE, Process
from collections import Counter
from collections.abc import Hashable
from contextlib import suppress
from typing import Final

from starlette.requests import Request

from fleet.console.request_filter import PERSON
from schemas.process.children import kill

MAX_SESSION_JOBS: Final = 2
"""Maximum number of processes at work. More requests wait."""
MAX_JOBS_OF_PERSON: Final = 8
"""Maximum number of requests of one person that wait or are at work. Only one of them is at work, so that other persons
have a place, too."""
_LOW_PRIORITY: Final = 5


class SessionJobs:
    """The processes that requests have started."""

    def __init__(self) -> None:
        self._slots = asyncio.Semaphore(MAX_SESSION_JOBS)
        self._running: set[Process] = set()
        self._turns: dict[Hashable, asyncio.Lock] = {}
        self._counts = Counter[Hashable]()
        """Number of requests that wait or are at work, by person."""

    def kill(self) -> None:
        """End the processes."""
        for process in list(self._running):
            kill(process)

    async def run_for(self, request: Request, *arguments: str) -> tuple[int, str, str]:
        """Run `fleet` for a person, as `run` does. End the process if the client of the request has gone."""
        person = request.scope.get(PERSON)
        name = person and person.name
        if self._counts[name] >= MAX_JOBS_OF_PERSON:
            return 1, "", "Too many requests of this person wait. Try again in a few seconds."
        self._counts[name] += 1
        work = asyncio.ensure_future(self._run_in_turn(name, *arguments))
        gone = asyncio.ensure_future(_wait_until_gone(request))
        try:
            await asyncio.wait((work, gone), return_when=asyncio.FIRST_COMPLETED)
            return work.result() if work.done() else (1, "", "The client of this request has gone.")
        finally:
            for task in (work, gone):
                task.cancel()
            await asyncio.gather(work, gone, return_exceptions=True)
            self._counts[name] -= 1
            if not self._counts[name]:
                del self._counts[name]
                self._turns.pop(name, None)

    async def _run_in_turn(self, name: Hashable, *arguments: str) -> tuple[int, str, str]:
        async with self._turns.setdefault(name, asyncio.Lock()):
            return await self.run(*arguments)

    async def run(self, *arguments: str) -> tuple[int, str, str]:
        """Run `fleet` in a process. Return its exit code, output, and the last line of its errors."""
        async with self._slots:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                *("-m", "fleet.cli", *arguments),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=PIPE,
                stderr=PIPE,
            )
            self._running.add(process)
            # The process may have ended, or the system may have no such priorities (Windows).
            with suppress(OSError, AttributeError):
                os.setpriority(os.PRIO_PROCESS, process.pid, _LOW_PRIORITY)
            try:
                out, err = await process.communicate()
            finally:
                if process.returncode is None:  # this task was cancelled
                    kill(process)
                self._running.discard(process)
        said = err.decode("utf-8", "replace").strip().splitlines()
        return process.returncode or 0, out.decode("utf-8", "replace"), said[-1].removeprefix("fleet: ") if said else ""


async def _wait_until_gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass

"""The processes that are kept running: started, killed when they hang, told to end. Which, the supervisor says."""

import asyncio
import os
import random
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fleet.supervise.process import Child, Log
from fleet.supervise.restart import Act, State, Ward, grace_s
from fleet.supervise.wanted import PATIENCE, Kind

TURN_S: Final = 0.1
"""How often to look; at most one gateway is started each time, so that a hundred do not start in one instant."""


@dataclass(slots=True)
class Process:
    """One process and what is known of it."""

    name: str
    kind: Kind
    command: tuple[str, ...]
    ward: Ward
    log: Log
    child: Child | None = None
    leaving: bool = False
    """It is not wanted any more, and forgotten when it has ended."""
    code: int | None = None
    """How it last ended."""

    @property
    def why(self) -> str:
        """Its own last word on what went wrong."""
        return self.child.last if self.child is not None else ""


class Crew:
    """All processes of one supervisor, by name.

    `tell` hears what happens (a name, words), `said` each line of a stdout, `ended` that one has ended, and whether it
    was told to.
    """

    def __init__(
        self,
        tell: Callable[[str, str], None],
        said: Callable[[Process, str], None],
        ended: Callable[[Process, bool], None],
    ) -> None:
        self._processes: dict[str, Process] = {}
        self._tell = tell
        self._said = said
        self._told_ended = ended
        self.directory = Path()
        """Of the logs."""

    def __iter__(self) -> Iterator[Process]:
        return iter(list(self._processes.values()))

    def get(self, name: str) -> Process | None:
        """The process of this name."""
        return self._processes.get(name)

    def of(self, *kinds: Kind) -> list[Process]:
        """The processes of these kinds."""
        return [process for process in self if process.kind in kinds]

    def add(self, name: str, kind: Kind, command: tuple[str, ...], *, anew: bool = False) -> None:
        """One more, to be started; of that name with another command, or `anew`: to be started anew."""
        process = self._processes.get(name)
        if process is None:
            log = Log(self.directory / f"{name}.log")
            self._processes[name] = Process(name, kind, command, Ward(PATIENCE[kind], time.monotonic()), log)
        elif anew or process.command != command or process.leaving or process.ward.state is State.GIVEN_UP:
            process.command, process.leaving = command, False
            self.end(process, grace_s(None), again=True)

    def remove(self, name: str, grace: float) -> None:
        """End it, and forget it."""
        process = self._processes.get(name)
        if process is not None:
            process.leaving = True
            self.end(process, grace)
            self.forget(process)

    def end(self, process: Process, grace: float, *, again: bool = False) -> None:
        """Tell it to end within so many s, and to begin anew if `again`."""
        if process.ward.end(time.monotonic(), grace, again=again) and process.child is not None:
            process.child.signal(signal.SIGTERM)

    def heard(self, name: str, pid: int | None = None) -> bool:
        """A sign of life of a process, if it is that one; whether it is its first."""
        process = self._processes.get(name)
        if process is None or process.child is None or pid not in (None, process.child.pid):
            return False
        return process.ward.heard(time.monotonic())

    async def turn(self, now: float, since: Callable[[Process], float | None], may: Callable[[Process], bool]) -> None:
        """Start what is due and `may` be, kill what hangs; `since` when a process could have been heard, if it can."""
        gateway_started = False
        for process in self:
            act = process.ward.turn(now, since(process))
            if act is Act.KILL and process.child is not None:
                self._tell(process.name, process.ward.words)
                process.child.kill()
            elif act is Act.START and may(process):
                if process.kind is Kind.GATEWAY and gateway_started:
                    continue
                gateway_started |= process.kind is Kind.GATEWAY
                await self._start(process)

    async def gone(self, processes: Iterable[Process], seconds: float) -> None:
        """Wait so long for these to have ended, then kill them."""
        alive = {process.child.task: process for process in processes if process.child and process.ward.alive}
        if alive:
            await asyncio.wait(alive, timeout=seconds)
        for task, process in alive.items():
            if not task.done() and process.child is not None:
                process.child.kill()
                await task

    async def _start(self, process: Process) -> None:
        def said(line: str) -> None:
            self._said(process, line)

        def ended(code: int) -> None:
            self._ended(process, code)

        now = time.monotonic()
        try:
            process.child = await Child.start(process.command, os.environ, process.log, said, ended)
        except OSError as error:
            process.ward.not_started(f"cannot be started: {error.strerror}", now, random.random())  # noqa: S311 - jitter
            self._tell(process.name, process.ward.words)
            return
        process.ward.started(now)
        again = f" again ({process.ward.words})" if process.ward.restarts else ""
        self._tell(process.name, f"started{again}, process {process.child.pid}")

    def _ended(self, process: Process, code: int) -> None:
        told = process.ward.state is State.ENDING
        process.code = code
        process.ward.ended(code, process.why, time.monotonic(), random.random())  # noqa: S311 - jitter, no secret
        if not told and not process.ward.killed:
            more = "; not started again" if process.ward.state is State.GIVEN_UP else ""
            self._tell(process.name, f"{process.ward.words}{more}")
        if process.log.failed:
            self._tell(process.name, process.log.failed)
            process.log.failed = ""
        self._told_ended(process, told)
        self.forget(process)

    def forget(self, process: Process) -> None:
        """Forget one that is not wanted any more, if it has ended for good."""
        over = process.leaving and process.ward.state in (State.ENDED, State.GIVEN_UP)
        if over and self._processes.get(process.name) is process:
            del self._processes[process.name]
            self._tell(process.name, "ended: no longer wanted")

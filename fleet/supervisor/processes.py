"""The processes that are kept running: started, killed when they hang, told to end. Which, the supervisor says."""

import asyncio
import os
import random
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Final

from fleet.supervisor import cpu_time
from fleet.supervisor.admission import Admission
from fleet.supervisor.child import Child, Log
from fleet.supervisor.hang import Pulse, WatchClock, are_many, longest_silence_s
from fleet.supervisor.restart_policy import (
    GATEWAY_GRACE_S,
    HUNG,
    WRONG_USE_RETRY_S,
    ProcessState,
    RestartAction,
    RunState,
)
from fleet.supervisor.spec import PATIENCE, ProcessKind

TURN_S: Final = 0.1
"""Interval of looks."""
STARTS_AT_ONCE: Final = 1 + (os.cpu_count() or 1)
"""Maximum gateways that start at the same time: each takes a whole processor for 0.3 s, and waits in between."""
SILENT_S: Final = 2.0
"""Silence that counts when many are silent at once: one sign of life was missed."""
LOOK_AT_CPU_S: Final = 1.0
"""Silence after which a process's CPU time is looked at. It takes two looks, a second apart, to say something."""


_HEARD_OVER_THE_BUS: Final = tuple(kind for kind in ProcessKind if kind is not ProcessKind.HUB)
"""The hub is judged by the link to it alone: its main thread shows nothing of the threads that route."""


@dataclass(slots=True)
class ManagedProcess:
    """One process and what is known of it."""

    name: str
    kind: ProcessKind
    command: tuple[str, ...]
    ward: ProcessState
    log: Log
    child: Child | None = None
    leaving: bool = False
    """It is not wanted any more, and forgotten when it has ended."""
    code: int | None = None
    """How it last ended."""
    urgent: bool = False
    """It is started to stop a car: no budget of restarts counts."""
    pulse: Pulse = field(default_factory=Pulse)

    @property
    def why(self) -> str:
        """Its own last word on what went wrong."""
        return self.child.last if self.child is not None else ""


class ProcessSet:
    """All processes of one supervisor, by name.

    `tell` hears what happens (a name, words), `said` each line of a stdout, `ended` that one has ended, and whether it
    was told to.
    """

    def __init__(
        self,
        tell: Callable[[str, str], None],
        said: Callable[[ManagedProcess, str], None],
        ended: Callable[[ManagedProcess, bool], None],
    ) -> None:
        self._processes: dict[str, ManagedProcess] = {}
        self._tell = tell
        self._said = said
        self._told_ended = ended
        self._clock = WatchClock(time.monotonic())
        self._admission = Admission(STARTS_AT_ONCE)
        self.directory = Path()
        """Of the logs."""

    @property
    def now(self) -> float:
        """The time by which all is judged: it stands while this process does."""
        return self._clock.look(time.monotonic())

    def __iter__(self) -> Iterator[ManagedProcess]:
        return iter(list(self._processes.values()))

    def get(self, name: str) -> ManagedProcess | None:
        """The process of this name."""
        return self._processes.get(name)

    def of(self, *kinds: ProcessKind) -> list[ManagedProcess]:
        """The processes of these kinds."""
        return [process for process in self if process.kind in kinds]

    def add(self, name: str, kind: ProcessKind, command: tuple[str, ...], *, anew: bool = False) -> None:
        """One more, to be started; of that name with another command, or `anew`: to be started anew."""
        process = self._processes.get(name)
        if process is None:
            log = Log(self.directory / f"{name}.log")
            self._processes[name] = ManagedProcess(name, kind, command, ProcessState(PATIENCE[kind], self.now), log)
        elif anew or process.command != command or process.leaving or process.ward.state is RunState.REFUSED:
            process.command, process.leaving, process.urgent = command, False, False
            self.end(process, GATEWAY_GRACE_S, again=True)

    def remove(self, name: str, grace: float) -> None:
        """End it, and forget it."""
        process = self._processes.get(name)
        if process is not None:
            process.leaving = True
            self.end(process, grace)
            self.forget(process)

    def end(self, process: ManagedProcess, grace: float, *, again: bool = False) -> None:
        """Tell it to end within so many s, and to begin anew if `again`."""
        if process.ward.end(self.now, grace, again=again) and process.child is not None:
            process.child.signal(signal.SIGTERM)

    def heard(self, name: str, pid: int | None = None) -> bool:
        """A sign of life of a process, if it is that one; whether it is its first."""
        process = self._processes.get(name)
        if process is None or process.child is None or pid not in (None, process.child.pid):
            return False
        process.pulse.clear()
        return process.ward.heard(self.now)

    async def turn(
        self,
        since: Callable[[ManagedProcess], float | None],
        may_start: Callable[[ManagedProcess], bool],
        may_move: Callable[[ManagedProcess], bool],
    ) -> None:
        """Start what is due and may be started, kill what hangs.

        since: since when a process could have been heard, None if it cannot be. may_move: whether a gateway's car may.
        """
        now = self.now
        silent = {process.name: process.ward.silent_s(now, since(process)) for process in self}
        judged = [process for process in self.of(*_HEARD_OVER_THE_BUS) if process.ward.state is RunState.RUNNING]
        many = are_many(sum(silent[process.name] > SILENT_S for process in judged), len(judged))
        # The process that has waited longest comes first: a few that fall again and again hold up no others.
        for process in sorted(self, key=lambda each: each.ward.due):
            if silent[process.name] > LOOK_AT_CPU_S and process.child is not None and process.pulse.is_due(now):
                process.pulse.look(now, cpu_time.read(process.child.pid))
            leave_s = 0.0
            if process.kind in _HEARD_OVER_THE_BUS:
                leave_s = longest_silence_s(process.pulse.sign, many=many, may_move=may_move(process))
                leave_s = leave_s if self._admission.may_kill(now) else inf
            act = process.ward.turn(now, since(process), leave_s)
            if act is RestartAction.KILL and process.child is not None:
                if process.ward.words.startswith(HUNG):
                    self._admission.killed()
                self._tell(process.name, process.ward.words)
                process.child.kill()
            elif act is RestartAction.START and may_start(process) and self._is_admitted(process, now):
                await self._start(process)

    def _is_admitted(self, process: ManagedProcess, now: float) -> bool:
        if process.kind is not ProcessKind.GATEWAY:
            return True
        starting = [each.ward.since for each in self.of(ProcessKind.GATEWAY) if each.ward.state is RunState.STARTING]
        restart = process.child is not None and not process.urgent
        return self._admission.admit_start(now, starting, restart=restart)

    async def gone(self, processes: Iterable[ManagedProcess], seconds: float) -> None:
        """Wait so long for these to have ended, then kill them."""
        alive = {process.child.task: process for process in processes if process.child and process.ward.alive}
        if alive:
            await asyncio.wait(alive, timeout=seconds)
        for task, process in alive.items():
            if not task.done() and process.child is not None:
                process.child.kill()
                await task

    async def _start(self, process: ManagedProcess) -> None:
        def said(line: str) -> None:
            self._said(process, line)

        def ended(code: int) -> None:
            self._ended(process, code)

        now = self.now
        process.pulse.clear()
        try:
            process.child = await Child.start(process.command, os.environ, process.log, said, ended)
        except OSError as error:
            process.ward.not_started(f"cannot be started: {error.strerror}", now, random.random())  # noqa: S311 - jitter
            self._tell(process.name, process.ward.words)
            return
        process.ward.started(now)
        why = f" ({process.ward.words})" if process.ward.words else ""
        again = f" again{why}" if process.ward.restarts else ""
        self._tell(process.name, f"started{again}, process {process.child.pid}")

    def _ended(self, process: ManagedProcess, code: int) -> None:
        told = process.ward.state is RunState.ENDING
        process.code = code
        process.ward.ended(code, process.why, self.now, random.random())  # noqa: S311 - jitter, no secret
        if not told and not process.ward.killed:
            more = f"; retry in {WRONG_USE_RETRY_S:g} s" if process.ward.state is RunState.REFUSED else ""
            self._tell(process.name, f"{process.ward.words}{more}")
        if process.log.failed:
            self._tell(process.name, process.log.failed)
            process.log.failed = ""
        self._told_ended(process, told)
        self.forget(process)

    def forget(self, process: ManagedProcess) -> None:
        """Forget one that is not wanted any more, if it has ended for good."""
        over = process.leaving and process.ward.state in (RunState.ENDED, RunState.REFUSED)
        if over and self._processes.get(process.name) is process:
            del self._processes[process.name]
            self._tell(process.name, "ended: no longer wanted")

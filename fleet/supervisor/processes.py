"""The set of managed processes: starts, restarts, kills and ends them as the supervisor decides."""

import asyncio
import os
import random
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from math import inf
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from fleet.supervisor import cpu_time
from fleet.supervisor.child import Child
from fleet.supervisor.hang import Pulse, WatchClock, have_common_cause, longest_hub_silence_s, longest_silence_s
from fleet.supervisor.log_files import Log
from fleet.supervisor.process_state import GATEWAY_GRACE_S, HUNG, WRONG_USE_RETRY_S, ProcessState, RestartAction
from fleet.supervisor.spec import PATIENCE
from fleet.supervisor.start_limit import Admission
from schemas.words import ProcessKind, RunState

SUPERVISOR_POLL_INTERVAL_S: Final = 0.1
"""Interval at which the supervisor polls its processes."""
STARTS_AT_ONCE: Final = 1 + (os.cpu_count() or 1)
"""Maximum number of gateways that start at the same time. A start takes 0.3 s of CPU time and also some waiting, so
one start more than there are CPUs keeps them busy."""
MISSED_HEARTBEAT_S: Final = 2.0
"""Time without a heartbeat after which a process counts as silent. It has then missed at least one heartbeat."""
CPU_CHECK_SILENCE_S: Final = 1.0
"""Silence after which a process's CPU time is sampled."""


# A hub sends no heartbeats: its main thread does not know whether Zenoh's routing threads hang. Our link to the hub
# serves as its heartbeat.
_HEARTBEAT_KINDS: Final = tuple(kind for kind in ProcessKind if kind is not ProcessKind.HUB)


class ManagedProcess(Struct):
    """One process, its log and its state."""

    name: str
    kind: ProcessKind
    command: tuple[str, ...]
    status: ProcessState
    log: Log
    child: Child | None = None
    leaving: bool = False
    """True if the process will be removed when it has ended."""
    code: int | None = None
    """The last exit code."""
    urgent: bool = False
    """True if the process is started to stop a car. Then the rate limit of restarts does not apply."""
    pulse: Pulse = field(default_factory=Pulse)

    @property
    def why(self) -> str:
        """The process's last error line."""
        return self.child.last if self.child is not None else ""


class ProcessSet:
    """All processes of one supervisor, by name.

    on_event: called with a process's name and a text. on_line: called with each line of a process's stdout, returns
    False if the line should not be logged. on_exit: called when a process has ended, with True if the supervisor ended
    it.
    """

    def __init__(
        self,
        on_event: Callable[[str, str], None],
        on_line: Callable[[ManagedProcess, str], bool],
        on_exit: Callable[[ManagedProcess, bool], None],
    ) -> None:
        self._processes: dict[str, ManagedProcess] = {}
        self._on_event = on_event
        self._on_line = on_line
        self._on_exit = on_exit
        self._clock = WatchClock(time.monotonic())
        self._admission = Admission(STARTS_AT_ONCE)
        self.directory = Path()
        """Directory of the logs."""

    @property
    def now(self) -> float:
        """The time of the supervisor's clock, which stops while this process stalls."""
        return self._clock.advance(time.monotonic())

    def __iter__(self) -> Iterator[ManagedProcess]:
        return iter(list(self._processes.values()))

    def get(self, name: str) -> ManagedProcess | None:
        """Return the process of this name."""
        return self._processes.get(name)

    def of(self, *kinds: ProcessKind) -> list[ManagedProcess]:
        """Return the processes of these kinds."""
        return [process for process in self if process.kind in kinds]

    def add(self, name: str, kind: ProcessKind, command: tuple[str, ...], *, restart: bool = False) -> None:
        """Add a process.

        A process of this name is restarted if its command differs, if it is ending for good, if it ended because its
        arguments were wrong (REFUSED), or if `restart` is True.
        """
        process = self._processes.get(name)
        if process is None:
            log = Log(self.directory / f"{name}.log")
            self._processes[name] = ManagedProcess(name, kind, command, ProcessState(PATIENCE[kind], self.now), log)
        elif restart or process.command != command or process.leaving or process.status.state is RunState.REFUSED:
            process.command, process.leaving, process.urgent = command, False, False
            self.end(process, GATEWAY_GRACE_S, again=True)

    def remove(self, name: str, grace: float) -> None:
        """End a process, and remove it when it has ended."""
        process = self._processes.get(name)
        if process is not None:
            process.leaving = True
            self.end(process, grace)
            self.forget(process)

    def end(self, process: ManagedProcess, grace: float, *, again: bool = False) -> None:
        """Send SIGTERM, and kill the process after `grace` s. Restart it if `again`."""
        if process.status.end(self.now, grace, again=again) and process.child is not None:
            process.child.signal(signal.SIGTERM)

    def on_heartbeat(self, name: str, pid: int | None = None) -> bool:
        """Note a heartbeat, unless an earlier process of that name sent it. Return True if it is the first one."""
        process = self._processes.get(name)
        if process is None or process.child is None or pid not in (None, process.child.pid):
            return False
        process.pulse.clear()
        return process.status.on_heartbeat(self.now)

    async def turn(
        self,
        since: Callable[[ManagedProcess], float | None],
        may_start: Callable[[ManagedProcess], bool],
        may_move: Callable[[ManagedProcess], bool],
    ) -> None:
        """Start the due processes and kill the hung ones.

        `since` returns when the connection began on which a process's heartbeats are received, or None if there is no
        such connection now. `may_move` returns True if a gateway's car may be moving.
        """
        now = self.now
        silent = {process.name: process.status.silent_s(now, since(process)) for process in self}
        judged = [process for process in self.of(*_HEARTBEAT_KINDS) if process.status.state is RunState.RUNNING]
        many = have_common_cause(sum(silent[process.name] > MISSED_HEARTBEAT_S for process in judged), len(judged))
        # First start the process that has waited longest. So a few processes that crash again and again do not delay
        # the others.
        for process in sorted(self, key=lambda each: each.status.due):
            if silent[process.name] > CPU_CHECK_SILENCE_S and process.child is not None and process.pulse.is_due(now):
                process.pulse.add(now, cpu_time.read(process.child.pid))
            leave_s = longest_hub_silence_s(process.pulse.sign)
            if process.kind in _HEARTBEAT_KINDS:
                leave_s = longest_silence_s(process.pulse.sign, many=many, may_move=may_move(process))
                if not self._admission.may_kill(now):
                    leave_s = inf
            action = process.status.turn(now, since(process), leave_s)
            if action is RestartAction.KILL and process.child is not None:
                if process.status.words.startswith(HUNG):
                    self._admission.count_kill(now)
                self._on_event(process.name, process.status.words)
                process.child.kill()
            elif action is RestartAction.START and may_start(process) and self._is_admitted(process, now):
                await self._start(process)

    def _is_admitted(self, process: ManagedProcess, now: float) -> bool:
        if process.kind is not ProcessKind.GATEWAY:
            return True
        starting = [
            each.status.since for each in self.of(ProcessKind.GATEWAY) if each.status.state is RunState.STARTING
        ]
        restart = process.child is not None and not process.urgent
        return self._admission.admit_start(now, starting, restart=restart)

    async def wait_or_kill(self, processes: Iterable[ManagedProcess], seconds: float) -> None:
        """Wait until these processes have ended. After `seconds`, kill the rest."""
        alive = {process.child.task: process for process in processes if process.child and process.status.alive}
        if alive:
            await asyncio.wait(alive, timeout=seconds)
        for task, process in alive.items():
            if not task.done() and process.child is not None:
                process.child.kill()
                await task

    async def _start(self, process: ManagedProcess) -> None:
        def on_line(line: str) -> bool:
            return self._on_line(process, line)

        def on_exit(code: int) -> None:
            self._ended(process, code)

        now = self.now
        process.pulse.clear()
        try:
            process.child = await Child.start(process.command, os.environ, process.log, on_line, on_exit)
        except OSError as error:
            process.status.on_start_failed(f"cannot be started: {error.strerror}", now, random.random())  # noqa: S311 - jitter
            self._on_event(process.name, process.status.words)
            return
        failed = process.status.on_started(now)
        why = f" ({process.status.words})" if failed and process.status.words else ""
        again = f" again{why}" if process.code is not None else ""
        self._on_event(process.name, f"started{again}, process {process.child.pid}")

    def _ended(self, process: ManagedProcess, code: int) -> None:
        requested = process.status.state is RunState.ENDING
        process.code = code
        process.status.on_exit(code, process.why, self.now, random.random())  # noqa: S311 - jitter, no secret
        if not requested and not process.status.killed:
            more = f"; retry in {WRONG_USE_RETRY_S:g} s" if process.status.state is RunState.REFUSED else ""
            self._on_event(process.name, f"{process.status.words}{more}")
        if process.log.failed:
            self._on_event(process.name, process.log.failed)
            process.log.failed = ""
        process.log.close()
        self._on_exit(process, requested)
        self.forget(process)

    def forget(self, process: ManagedProcess) -> None:
        """Remove a leaving process if it has ended for good."""
        over = process.leaving and process.status.state in (RunState.ENDED, RunState.REFUSED)
        if over and self._processes.get(process.name) is process:
            del self._processes[process.name]
            self._on_event(process.name, "ended: no longer needed")

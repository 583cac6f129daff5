"""Decides when a process is started, killed because it hangs, and restarted. Pure: time is an argument.

A car that is switched off is not a failure. Its gateway runs, sends heartbeats, and retries the link by itself.
"""

from enum import StrEnum
from math import inf
from typing import Final

from msgspec import Struct, field

from schemas.backoff import backoff_s
from schemas.limits import SHUTDOWN_S
from schemas.words import RunState

FIRST_RESTART_DELAY_S: Final = 0.25
MAX_RESTART_DELAY_S: Final = 10.0
RESTART_JITTER: Final = 0.2
"""Share by which a delay varies, so that processes that crashed together do not restart together."""
STABLE_RUN_S: Final = 10.0
"""Minimum duration of a run after which the backoff starts again from the first delay."""
WRONG_USE: Final = 2
"""Exit code of a process that rejects its arguments. A restart seldom helps."""
WRONG_USE_RETRY_S: Final = 60.0
"""Interval of retries after WRONG_USE. The supervisor never gives up: the user may fix a file or a device."""
# After SIGTERM, a gateway stops its car and waits up to SHUTDOWN_S for readings that show the stop. Then it leaves the
# bus, which takes up to two seconds.
GATEWAY_GRACE_S: Final = SHUTDOWN_S + 3.0
"""Timeout for a gateway's exit after SIGTERM. Then the supervisor kills it."""
HUNG: Final = "hung"
"""First word of the reason if a process was killed because it hung."""


class RestartAction(StrEnum):
    """The next thing to do with a process."""

    NOTHING = "nothing"
    START = "start"
    KILL = "kill"


class Patience(Struct, frozen=True):
    """Heartbeat timeouts of a process, s: until the first heartbeat, and between heartbeats."""

    start_s: float
    silence_s: float
    to_the_end: bool = False
    """True if the process sends heartbeats until it exits, even after SIGTERM."""


def delay_s(failures: int, chance: float) -> float:
    """Return the restart delay (exponential backoff) after consecutive failures (1, 2, ...).

    chance: in 0..1, varies the delay by RESTART_JITTER either way.
    """
    return backoff_s(failures, FIRST_RESTART_DELAY_S, MAX_RESTART_DELAY_S) * (1 + RESTART_JITTER * (2 * chance - 1))


class ProcessState(Struct):
    """The state machine of one process. `turn` returns the next action, the other methods report what happened."""

    patience: Patience
    due: float
    """Time of the next start."""
    state: RunState = RunState.WAITING
    since: float = 0.0
    heard_at: float = -inf
    restarts: int = 0
    """How often the process was started again after it had failed. A restart on request, as by a reload, is no
    failure."""
    words: str = ""
    """Reason of the last failure."""
    _failures: int = 0
    _kill_at: float = inf
    _killed: bool = False
    _again: bool = field(default=False)

    @property
    def killed(self) -> bool:
        """True if `turn` has returned KILL for the running process."""
        return self._killed

    @property
    def alive(self) -> bool:
        """True if the process exists."""
        return self.state in (RunState.STARTING, RunState.RUNNING, RunState.ENDING)

    def silent_s(self, now: float, listening_since: float | None) -> float:
        """Return how long no heartbeat was received although it could have been. 0 if none is expected."""
        if listening_since is None or self._killed or not self.alive:
            return 0.0
        if self.state is RunState.ENDING and not self.patience.to_the_end:
            return 0.0
        heard_at = self.heard_at if self.state is RunState.RUNNING else max(self.heard_at, self.since)
        return max(0.0, now - max(listening_since, heard_at))

    def turn(self, now: float, listening_since: float | None, leave_s: float = 0.0) -> RestartAction:
        """Return the next action.

        `listening_since` is the time since which heartbeats could be received without a break, or None if they cannot
        be received now. `leave_s` is the silence that `hang` allows, and counts if it is longer than the patience.
        """
        if self.state in (RunState.WAITING, RunState.REFUSED) and now >= self.due:
            return RestartAction.START
        if self.state is RunState.ENDING and now >= self._kill_at and not self._killed:
            return self._kill("did not end in time and was killed")
        silent = self.silent_s(now, listening_since)
        allowed = self.patience.start_s if self.state is RunState.STARTING else self.patience.silence_s
        if silent > max(allowed, leave_s):
            return self._kill(f"{HUNG}: no heartbeat for {silent:.1f} s")
        return RestartAction.NOTHING

    def on_started(self, now: float) -> bool:
        """Note that the process was started. Return True if that follows a failure."""
        failed = bool(self.since or self.restarts) and (self._killed or not self._again)
        self.restarts += failed
        self._set(RunState.STARTING, now)
        self._killed = self._again = False
        return failed

    def on_heartbeat(self, now: float) -> bool:
        """Note a heartbeat. Return True if it is the first one."""
        first = self.state is RunState.STARTING
        if first:
            self._set(RunState.RUNNING, now)
        self.heard_at = now
        return first

    def on_exit(self, code: int, why: str, now: float, chance: float) -> None:
        """Note the exit code (negative: the signal). `why`: the last error line. For `chance`, see `delay_s`."""
        if self.state is RunState.ENDING:
            self._set(RunState.WAITING if self._again else RunState.ENDED, now)
            self.due = now
            return
        if not self._killed:
            reason = f": {why}" if why and code > 0 else ""
            self.words = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}{reason}"
        if code == WRONG_USE:
            self._set(RunState.REFUSED, now)
            self.due = now + WRONG_USE_RETRY_S
            return
        self._failures = 1 if self.alive and now - self.since >= STABLE_RUN_S else self._failures + 1
        self._set(RunState.WAITING, now)
        self.due = now + delay_s(self._failures, chance)

    def on_start_failed(self, words: str, now: float, chance: float) -> None:
        """Note that the system could not start the process."""
        self._failures += 1
        self.words = words
        self._set(RunState.WAITING, now)
        self.due = now + delay_s(self._failures, chance)

    def end(self, now: float, grace_s: float, *, again: bool = False) -> bool:
        """Note that the process must exit, and restart if `again`. Return True if there is a process to signal."""
        self._again = again and self.alive
        if self.state is RunState.ENDING:
            return False
        if not self.alive:
            self._set(RunState.WAITING if again else RunState.ENDED, now)
            self.due, self._failures = now, 0
            return False
        self._set(RunState.ENDING, now)
        self._kill_at = now + grace_s
        self._failures = 0
        return True

    def served_elsewhere(self, now: float, words: str) -> None:
        """Note that another program does the work of this process."""
        if self.state is not RunState.ELSEWHERE:
            self._set(RunState.ELSEWHERE, now)
        self.words = words

    def schedule(self, now: float, delay_s: float = 0.0) -> None:
        """Start the process after this delay."""
        self._set(RunState.WAITING, now)
        self.due = now + delay_s

    def _kill(self, words: str) -> RestartAction:
        self._killed = True
        self.words = words
        return RestartAction.KILL

    def _set(self, state: RunState, now: float) -> None:
        if state is not self.state or state is RunState.STARTING:
            self.state, self.since = state, now

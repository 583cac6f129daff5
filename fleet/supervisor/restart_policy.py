"""When a process is started, when it counts as hung, and when it is started again. Pure: time is an argument.

A car that is off is none of this: its gateway runs, is heard, and keeps trying by itself.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from math import inf
from typing import Final

FIRST_S: Final = 0.25
LONGEST_S: Final = 10.0
JITTER: Final = 0.2
"""Share of a delay: what a fault took down together does not come back in one instant."""
STEADY_S: Final = 10.0
"""Who ran for so long fell for a new reason: the delay begins anew."""
WRONG_USE: Final = 2
"""Exit code of a process that refuses its arguments. Another start seldom changes that."""
WRONG_USE_RETRY_S: Final = 60.0
"""Interval of the retries then. Nothing is given up for good: a file or a device may be put right meanwhile."""
GATEWAY_GRACE_S: Final = 19.0
"""Time that a gateway has from SIGTERM to its end before it is killed. It waits up to 16 s for its car to show the stop
(gateway.control.executor, `SHUTDOWN_S`), and leaves the bus after that."""
HUNG: Final = "hung"
"""How the words begin on a process that was killed for its silence."""


class RunState(StrEnum):
    """What is so of one process."""

    WAITING = "waiting"
    STARTING = "starting"
    RUNNING = "running"
    ENDING = "ending"
    ENDED = "ended"
    REFUSED = "refused"
    ELSEWHERE = "elsewhere"


class RestartAction(StrEnum):
    """What is to be done now."""

    NOTHING = "nothing"
    START = "start"
    KILL = "kill"


@dataclass(frozen=True, slots=True)
class Patience:
    """How long a process may say nothing, s: until it is first heard, and then."""

    start_s: float
    silence_s: float
    to_the_end: bool = False
    """It is heard until it ends, also after it was told to."""


def delay_s(falls: int, chance: float) -> float:
    """How long to wait after so many falls in a row (1, 2, ...); `chance` in 0..1 spreads it by JITTER either way."""
    delay: float = min(LONGEST_S, FIRST_S * 2.0 ** min(falls - 1, 16))
    return delay * (1 + JITTER * (2 * chance - 1))


@dataclass(slots=True)
class ProcessState:
    """One process, from the first start to the last; `turn` says what to do, the rest tells what happened."""

    patience: Patience
    due: float
    """When it is to be started."""
    state: RunState = RunState.WAITING
    since: float = 0.0
    heard_at: float = -inf
    restarts: int = 0
    words: str = ""
    """Why it was started again, or is to be."""
    _falls: int = 0
    _kill_at: float = inf
    _killed: bool = False
    _again: bool = field(default=False)

    @property
    def killed(self) -> bool:
        """Whether it was to be killed, which was said then."""
        return self._killed

    @property
    def alive(self) -> bool:
        """Whether there is a process."""
        return self.state in (RunState.STARTING, RunState.RUNNING, RunState.ENDING)

    def silent_s(self, now: float, listening_since: float | None) -> float:
        """How long it could have been heard and was not; 0 while nothing is expected of it."""
        if listening_since is None or self._killed or not self.alive:
            return 0.0
        if self.state is RunState.ENDING and not self.patience.to_the_end:
            return 0.0
        heard_at = self.heard_at if self.state is RunState.RUNNING else max(self.heard_at, self.since)
        return max(0.0, now - max(listening_since, heard_at))

    def turn(self, now: float, listening_since: float | None, leave_s: float = 0.0) -> RestartAction:
        """What to do; `listening_since`: since when it could have been heard without a gap, None if it cannot be.

        leave_s: silence that is allowed even if the patience is less (hang.py).
        """
        if self.state in (RunState.WAITING, RunState.REFUSED) and now >= self.due:
            return RestartAction.START
        if self.state is RunState.ENDING and now >= self._kill_at and not self._killed:
            return self._kill("did not end in time and was killed")
        silent = self.silent_s(now, listening_since)
        allowed = self.patience.start_s if self.state is RunState.STARTING else self.patience.silence_s
        if silent > max(allowed, leave_s):
            return self._kill(f"{HUNG}: not heard for {silent:.1f} s")
        return RestartAction.NOTHING

    def started(self, now: float) -> None:
        """It was started."""
        if self.since or self.restarts:
            self.restarts += 1
        self._set(RunState.STARTING, now)
        self._killed = False

    def heard(self, now: float) -> bool:
        """A sign of life; whether it is the first."""
        first = self.state is RunState.STARTING
        if first:
            self._set(RunState.RUNNING, now)
        self.heard_at = now
        return first

    def ended(self, code: int, why: str, now: float, chance: float) -> None:
        """It has ended with this exit code (negative: by that signal); `why` is its last word, if it had one.

        `chance` in 0..1 spreads the restart.
        """
        if self.state is RunState.ENDING:
            self._set(RunState.WAITING if self._again else RunState.ENDED, now)
            self.due = now
            return
        if not self._killed:
            said = f": {why}" if why and code > 0 else ""
            self.words = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}{said}"
        if code == WRONG_USE:
            self._set(RunState.REFUSED, now)
            self.due = now + WRONG_USE_RETRY_S
            return
        self._falls = 1 if self.alive and now - self.since >= STEADY_S else self._falls + 1
        self._set(RunState.WAITING, now)
        self.due = now + delay_s(self._falls, chance)

    def not_started(self, words: str, now: float, chance: float) -> None:
        """The system would not start it."""
        self._falls += 1
        self.words = words
        self._set(RunState.WAITING, now)
        self.due = now + delay_s(self._falls, chance)

    def end(self, now: float, grace_s: float, *, again: bool = False) -> bool:
        """It is told to end, and then to be started anew if `again`; whether there is a process to tell."""
        self._again = again
        if self.state is RunState.ENDING:
            return False
        if not self.alive:
            self._set(RunState.WAITING if again else RunState.ENDED, now)
            self.due, self._falls = now, 0
            return False
        self._set(RunState.ENDING, now)
        self._kill_at = now + grace_s
        self._falls = 0
        return True

    def elsewhere(self, now: float, words: str) -> None:
        """Somebody else does what it is for."""
        if self.state is not RunState.ELSEWHERE:
            self._set(RunState.ELSEWHERE, now)
        self.words = words

    def wanted(self, now: float, delay_s: float = 0.0) -> None:
        """It is to be started after this delay: nobody else does it any more, or it did not do what it was to do."""
        self._set(RunState.WAITING, now)
        self.due = now + delay_s

    def _kill(self, words: str) -> RestartAction:
        self._killed = True
        self.words = words
        return RestartAction.KILL

    def _set(self, state: RunState, now: float) -> None:
        if state is not self.state or state is RunState.STARTING:
            self.state, self.since = state, now

"""Tells a hung process from a slow one, and from a stalled hub or machine. Pure.

The supervisor kills a process that sends no heartbeat for its `Patience`, unless there is another explanation:
- The supervisor itself stalled (`WatchClock`) and could not receive heartbeats.
- Many processes are silent at once (`are_many`): the hub or the machine stalls.
- The process is slow (`Pulse`). A hung gateway uses no CPU time, or a whole CPU.
"""

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

MAX_POLL_GAP_S: Final = 0.5
"""Maximum time that counts between two polls of the supervisor. A longer gap means that the supervisor stalled."""
MANY_SHARE: Final = 0.25
"""Minimum share of silent processes that indicates a common cause."""
MANY_SILENT_S: Final = 30.0
"""Maximum silence of a process while many are silent. A blocked hub is replaced after 8 s."""
SLOW_SILENT_S: Final = 30.0
"""Maximum silence of a slow process."""
MOVING_SILENT_S: Final = 300.0
"""Maximum silence of a slow gateway whose car may move. Only this gateway stops the car when a drive ends."""
CPU_WINDOW_S: Final = 3.0
MIN_CPU_WINDOW_S: Final = 0.9
SPINNING_SHARE: Final = 0.8
"""Share of a CPU that only an endless loop uses for seconds."""
RUNNING_SHARE: Final = 1e-4
"""Minimum share of a CPU of a process that is not blocked. An idle gateway uses 0.5 %, a blocked one nothing."""


class Sign(StrEnum):
    """The state of a silent process, judged by its CPU time."""

    UNKNOWN = "unknown"
    BLOCKED = "blocked"
    SLOW = "slow"
    SPINNING = "spinning"


@dataclass(frozen=True, slots=True)
class CpuTime:
    """CPU time since the start of a process, s: running, and waiting for a CPU while ready to run."""

    run_s: float
    wait_s: float = 0.0
    ready: bool = False
    """True if the process is now ready to run or waits for the disk."""


@dataclass(slots=True)
class Pulse:
    """Samples of the CPU time of one silent process over the last seconds."""

    _samples: deque[tuple[float, CpuTime]] = field(default_factory=deque)

    def add(self, now: float, time: CpuTime | None) -> None:
        """Add a sample. None if the system does not report the CPU time."""
        if time is None:
            self._samples.clear()
            return
        self._samples.append((now, time))
        while now - self._samples[0][0] > CPU_WINDOW_S:
            self._samples.popleft()

    def clear(self) -> None:
        """Drop all samples: the process sent a heartbeat or was replaced."""
        self._samples.clear()

    def is_due(self, now: float) -> bool:
        """Return True if it is time for the next sample."""
        return not self._samples or now - self._samples[-1][0] >= CPU_WINDOW_S / 6

    @property
    def sign(self) -> Sign:
        """The state that the samples indicate."""
        if not self._samples:
            return Sign.UNKNOWN
        (began, first), (ended, last) = self._samples[0], self._samples[-1]
        seconds = ended - began
        if seconds < MIN_CPU_WINDOW_S:
            return Sign.UNKNOWN
        run, wait = (last.run_s - first.run_s) / seconds, (last.wait_s - first.wait_s) / seconds
        if run >= SPINNING_SHARE:
            return Sign.SPINNING
        if run + wait >= RUNNING_SHARE or any(time.ready for _, time in self._samples):
            return Sign.SLOW
        return Sign.BLOCKED


def longest_silence_s(sign: Sign, *, many: bool, may_move: bool) -> float:
    """Return the allowed silence if it is longer than the process's own patience, else 0."""
    longest = MANY_SILENT_S if many else 0.0
    if sign is Sign.SLOW:
        longest = max(longest, MOVING_SILENT_S if may_move else SLOW_SILENT_S)
    return longest


def longest_hub_silence_s(sign: Sign) -> float:
    """Return the allowed silence of a hub if it is longer than the hub's own patience, else 0."""
    # A hub that works is not hung: after it stood still, a hundred sessions come back at once. Its threads then use a
    # whole CPU or more. A hub of which only the main thread still polls may look the same.
    return SLOW_SILENT_S if sign in (Sign.SLOW, Sign.SPINNING) else 0.0


def are_many(silent: int, total: int) -> bool:
    """Return True if the silent processes are so many that they have a common cause."""
    return silent >= 2 and silent >= MANY_SHARE * total


class WatchClock:
    """A clock that stops while the supervisor stalls: it advances at most MAX_POLL_GAP_S from one poll to the next."""

    def __init__(self, now: float) -> None:
        self._shown = self._last = now

    def advance(self, now: float) -> float:
        """Advance to `now` of the machine and return the clock's time."""
        self._shown += min(now - self._last, MAX_POLL_GAP_S)
        self._last = now
        return self._shown

"""Distinguishes a hung process from a slow one, and from a stalled hub or machine. Pure.

The supervisor kills a process that sends no heartbeat for its `Patience` (`spec` has the values), unless there is
another explanation:
- The supervisor itself stalled (`WatchClock`) and could not receive heartbeats.
- Many processes are silent at once (`have_common_cause`), because the hub or the machine stalls.
- The process is only slow (`Pulse`). A hung process uses no CPU time, or a whole CPU.
"""

from collections import deque
from enum import StrEnum
from typing import Final

from msgspec import Struct, field

MAX_POLL_GAP_S: Final = 0.5
"""Maximum time that counts between two polls of the supervisor. A longer gap means that the supervisor stalled."""
MANY_SHARE: Final = 0.25
"""Minimum share of silent processes that indicates a common cause."""
MANY_SILENT_S: Final = 30.0
"""Maximum silence of a process while many are silent. It exceeds the 8 s after which a blocked hub is replaced."""
SLOW_SILENT_S: Final = 30.0
"""Maximum silence of a slow process."""
MOVING_SILENT_S: Final = 300.0
"""Maximum silence of a slow gateway whose car may move. It is long, because only this gateway can stop the car."""
CPU_WINDOW_S: Final = 3.0
"""Time over which the samples of a process's CPU time are kept."""
SAMPLE_INTERVAL_S: Final = CPU_WINDOW_S / 6
MIN_CPU_WINDOW_S: Final = 0.9
"""Minimum time from the first sample to the last one. A shorter time shows nothing."""
SPINNING_SHARE: Final = 0.8
"""Share of a CPU that only an endless loop uses for seconds."""
RUNNING_SHARE: Final = 1e-4
"""Minimum share of a CPU that a process uses if it is not blocked. An idle gateway uses 0.5 %, a blocked one 0."""


class Sign(StrEnum):
    """The state of a silent process, judged by its CPU time."""

    UNKNOWN = "unknown"
    BLOCKED = "blocked"
    SLOW = "slow"
    SPINNING = "spinning"


class CpuTime(Struct, frozen=True):
    """The CPU time of a process since its start, as the system reports it."""

    run_s: float
    """Time on a CPU."""
    wait_s: float = 0.0
    """Time in which the process was ready to run and waited for a CPU."""
    ready: bool = False
    """True if the process is ready to run or waits for the disk at this moment."""


class Pulse(Struct):
    """Samples of the CPU time of one silent process over the last seconds."""

    _samples: deque[tuple[float, CpuTime]] = field(default_factory=deque)

    def add(self, now: float, time: CpuTime | None) -> None:
        """Add a sample. `time` is None if the system does not report the CPU time."""
        if time is None:
            self._samples.clear()
            return
        self._samples.append((now, time))
        while now - self._samples[0][0] > CPU_WINDOW_S:
            self._samples.popleft()

    def clear(self) -> None:
        """Drop all samples, because the process sent a heartbeat or was replaced."""
        self._samples.clear()

    def is_due(self, now: float) -> bool:
        """Return True if it is time for the next sample."""
        return not self._samples or now - self._samples[-1][0] >= SAMPLE_INTERVAL_S

    @property
    def sign(self) -> Sign:
        """The state that the samples indicate."""
        if not self._samples:
            return Sign.UNKNOWN
        (first_at, first), (last_at, last) = self._samples[0], self._samples[-1]
        seconds = last_at - first_at
        if seconds < MIN_CPU_WINDOW_S:
            return Sign.UNKNOWN
        run_share = (last.run_s - first.run_s) / seconds
        wait_share = (last.wait_s - first.wait_s) / seconds
        if run_share >= SPINNING_SHARE:
            return Sign.SPINNING
        if run_share + wait_share >= RUNNING_SHARE or any(time.ready for _, time in self._samples):
            return Sign.SLOW
        return Sign.BLOCKED


def longest_silence_s(sign: Sign, *, many: bool, may_move: bool) -> float:
    """Return how long a process may be silent for a reason other than a hang.

    The result is 0 if only a hang explains the silence. The patience of the process counts if it is longer.
    """
    longest = MANY_SILENT_S if many else 0.0
    if sign is Sign.SLOW:
        longest = max(longest, MOVING_SILENT_S if may_move else SLOW_SILENT_S)
    return longest


def longest_hub_silence_s(sign: Sign) -> float:
    """Return how long a hub may be silent, as `longest_silence_s` does for the other processes."""
    # A hub that uses a whole CPU is not hung: after a stall, a hundred sessions reconnect at once and keep its threads
    # busy. But a hub may also look so if only its main thread still polls.
    return SLOW_SILENT_S if sign in (Sign.SLOW, Sign.SPINNING) else 0.0


def have_common_cause(silent: int, total: int) -> bool:
    """Return True if so many of the processes are silent that the cause must lie outside them."""
    return silent >= 2 and silent >= MANY_SHARE * total


class WatchClock:
    """A clock that stops while the supervisor stalls: it advances at most MAX_POLL_GAP_S from one poll to the next."""

    def __init__(self, now: float) -> None:
        self._shown = self._last = now

    def advance(self, now: float) -> float:
        """Advance to the machine's time `now`, and return this clock's time."""
        self._shown += min(now - self._last, MAX_POLL_GAP_S)
        self._last = now
        return self._shown

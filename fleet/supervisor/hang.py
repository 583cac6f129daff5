"""Tells a process that hangs from one that is slow, and from a machine or hub on which nobody is heard. Pure.

A process that is silent for its patience (restart.py) is killed unless one of these shows another cause:
- The supervisor itself was late (`WatchClock`): nobody could be heard meanwhile.
- Many are silent at once (`are_many`): the hub or the machine stands, not each of them.
- The process runs or waits for a processor (`Pulse`): a gateway that hangs uses none, or all of one.
"""

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

LONGEST_TURN_S: Final = 0.5
"""Maximum time that passes for the supervisor from one look to the next."""
MANY_SHARE: Final = 0.25
"""Share of the processes whose silence at once has a common cause."""
MANY_SILENT_S: Final = 30.0
"""Silence for which a common cause is assumed. A hub that stands is replaced after 8 s."""
SLOW_SILENT_S: Final = 30.0
MOVING_SILENT_S: Final = 300.0
"""Silence of a gateway that runs, and whose car may move: only this gateway stops the car when a drive ends."""
WINDOW_S: Final = 3.0
SHORTEST_WINDOW_S: Final = 0.9
SPINNING_SHARE: Final = 0.8
"""Share of a processor that only an endless loop takes for seconds."""
RUNNING_SHARE: Final = 1e-4
"""A gateway at rest takes 0.5 % of a processor, a blocked process none."""


class Sign(StrEnum):
    """What a process shows by its use of the processor."""

    UNKNOWN = "unknown"
    BLOCKED = "blocked"
    SLOW = "slow"
    SPINNING = "spinning"


@dataclass(frozen=True, slots=True)
class CpuTime:
    """Time since the start of a process, s: on a processor, and ready to run but waiting for one."""

    run_s: float
    wait_s: float = 0.0
    ready: bool = False
    """True if the process is ready to run, or waits for the disk, at this moment."""


@dataclass(slots=True)
class Pulse:
    """The CPU time of one process over the last seconds of its silence."""

    _looks: deque[tuple[float, CpuTime]] = field(default_factory=deque)

    def look(self, now: float, time: CpuTime | None) -> None:
        """Note the CPU time; None if the system does not tell."""
        if time is None:
            self._looks.clear()
            return
        self._looks.append((now, time))
        while now - self._looks[0][0] > WINDOW_S:
            self._looks.popleft()

    def clear(self) -> None:
        """Forget all: the process was heard, or another process is looked at."""
        self._looks.clear()

    def is_due(self, now: float) -> bool:
        """Return True if the last look is old enough for the next one."""
        return not self._looks or now - self._looks[-1][0] >= WINDOW_S / 6

    @property
    def sign(self) -> Sign:
        """What the looks show."""
        if not self._looks:
            return Sign.UNKNOWN
        (began, first), (ended, last) = self._looks[0], self._looks[-1]
        seconds = ended - began
        if seconds < SHORTEST_WINDOW_S:
            return Sign.UNKNOWN
        run, wait = (last.run_s - first.run_s) / seconds, (last.wait_s - first.wait_s) / seconds
        if run >= SPINNING_SHARE:
            return Sign.SPINNING
        if run + wait >= RUNNING_SHARE or any(time.ready for _, time in self._looks):
            return Sign.SLOW
        return Sign.BLOCKED


def longest_silence_s(sign: Sign, *, many: bool, may_move: bool) -> float:
    """Return the silence that is allowed beyond a process's own patience; 0 if only that counts."""
    longest = MANY_SILENT_S if many else 0.0
    if sign is Sign.SLOW:
        longest = max(longest, MOVING_SILENT_S if may_move else SLOW_SILENT_S)
    return longest


def are_many(silent: int, total: int) -> bool:
    """Return True if so many of all processes are silent that there is a common cause."""
    return silent >= 2 and silent >= MANY_SHARE * total


class WatchClock:
    """A clock that stands while its watcher does: from one look to the next it passes at most LONGEST_TURN_S."""

    def __init__(self, now: float) -> None:
        self._shown = self._last = now

    def look(self, now: float) -> float:
        """Return the watcher's time, at `now` of the machine."""
        self._shown += min(now - self._last, LONGEST_TURN_S)
        self._last = now
        return self._shown

"""Measures how long the computer has slept, which `time.monotonic()` does not count on Linux and macOS.

| system | with sleep | without sleep |
|---|---|---|
| Linux | CLOCK_BOOTTIME | CLOCK_MONOTONIC |
| macOS | CLOCK_MONOTONIC_RAW (`mach_continuous_time`) | CLOCK_UPTIME_RAW (`mach_absolute_time`) |
| Windows | GetTickCount64 | QueryUnbiasedInterruptTime |

On every other system no sleep is noticed: the wall clock would not do, because it also steps when somebody sets it. A
pause of a virtual machine is not noticed either, because no clock of its system counts the pause.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from math import inf
from typing import Final

if sys.platform == "win32":
    import ctypes

# A reading of GetTickCount64 is up to 16 ms old. On Linux and macOS the readings are exact.
MIN_SLEEP_S: Final = 0.1
"""Minimum difference of the clocks that counts as a sleep. No computer sleeps for a shorter time."""
MAX_READ_S: Final = 0.001
"""Maximum duration of an undisturbed reading of the clocks. When a `SleepWatch` starts, it
repeats a reading that took longer."""
MAX_READS: Final = 10
"""Maximum readings at the start. If the scheduler disturbs all of them, the best one is used."""
MONOTONIC_COUNTS_SLEEP: Final = sys.platform == "win32"
"""True if `time.monotonic()` and the times of asyncio continue during a sleep."""

_CLOCKS: Final = {
    "linux": ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC"),
    "darwin": ("CLOCK_MONOTONIC_RAW", "CLOCK_UPTIME_RAW"),
}

ClockPair = tuple[Callable[[], float], Callable[[], float]]
"""Two clocks that count seconds: one continues during a sleep of the computer, the other stands still."""


def clock_pair() -> ClockPair | None:
    """Return the clocks of this system, or None if it has no such pair."""
    if sys.platform == "win32":
        kernel = ctypes.windll.kernel32
        kernel.GetTickCount64.restype = ctypes.c_uint64

        def awake_s() -> float:
            ticks = ctypes.c_uint64()
            kernel.QueryUnbiasedInterruptTime(ctypes.byref(ticks))  # units of 100 ns
            return ticks.value / 1e7

        return (lambda: kernel.GetTickCount64() / 1e3), awake_s
    names = _CLOCKS.get(sys.platform)
    if names is None or not all(hasattr(time, name) for name in names):
        return None
    with_sleep, awake = (partial(time.clock_gettime, getattr(time, name)) for name in names)
    try:
        with_sleep(), awake()
    except OSError:  # an old kernel, or a sandbox without this clock
        return None
    return with_sleep, awake


class SleepWatch:
    """Measures the sleeps of the computer. If `clocks` is None, no sleep is noticed.

    A process may be interrupted between its readings of the two clocks. So the clock without sleep is read first at the
    start, and last in `take`. Only a difference that is certainly a sleep counts; an interruption never does.
    """

    def __init__(self, clocks: ClockPair | None) -> None:
        self._clocks = clocks
        self._slept_s = 0.0
        if clocks is not None:
            self._slept_s = _slept_until_now(*clocks)

    def take(self) -> float:
        """Return how long the computer has slept since the last call (s), or 0 if it has not."""
        if self._clocks is None:
            return 0.0
        with_sleep, awake = self._clocks
        at_least_s = with_sleep() - awake()  # an interruption between the two makes this less
        slept_s = at_least_s - self._slept_s
        if slept_s < MIN_SLEEP_S:
            return 0.0
        self._slept_s = at_least_s
        return slept_s


def _slept_until_now(with_sleep: Callable[[], float], awake: Callable[[], float]) -> float:
    """Return at most how long the computer has slept since its start, s, by the best of several readings."""
    best_took_s, at_most_s = inf, 0.0
    for _ in range(MAX_READS):
        before = awake()
        total = with_sleep()
        took_s = awake() - before
        if took_s < best_took_s:
            best_took_s, at_most_s = took_s, total - before
        if took_s <= MAX_READ_S:
            break
    return at_most_s

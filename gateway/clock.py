"""Converts times of the event loop's monotonic clock to wall-clock times, and to ages that include sleeps."""

import time
from collections.abc import Callable
from typing import Final

# NTP may slew a wall clock by 0.5 ms per second. The offset follows such a clock in steps of this size.
MIN_STEP_NS: Final = 2_000_000
"""Minimum change of the offset between the clocks that is applied."""
# Three readings of the clocks take less than this, unless the scheduler interrupts the process.
MAX_ERROR_NS: Final = 100_000
"""Maximum error of an undisturbed measurement. A larger error causes another attempt."""
MAX_ATTEMPTS: Final = 10
"""Maximum attempts. If the scheduler disturbs all of them, the best one is used."""


class WallClock:
    """Uses one offset between the two clocks until the wall clock steps.

    So two times keep their order and their distance, no matter when they are converted. With a new offset for each
    event, an event could get an earlier stamp than the one before it, if the process was interrupted between reading
    the two clocks.
    """

    def __init__(
        self, monotonic_ns: Callable[[], int] = time.monotonic_ns, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._wall_ns = wall_ns
        self._offset_ns, _ = self._measure_offset()

    def ns(self, at: float) -> int:
        """Return nanoseconds since the epoch. `at` is in seconds of the monotonic clock."""
        offset_ns, error_ns = self._measure_offset()
        if abs(offset_ns - self._offset_ns) > MIN_STEP_NS + error_ns:
            self._offset_ns = offset_ns
        return self._offset_ns + int(at * 1e9)

    def _measure_offset(self) -> tuple[int, int]:
        """Return the offset and its maximum error. Read the wall clock between two readings of the monotonic one."""
        best = self._measure_once()
        for _ in range(MAX_ATTEMPTS - 1):
            if best[1] <= MAX_ERROR_NS:
                break
            best = min(best, self._measure_once(), key=lambda found: found[1])
        return best

    def _measure_once(self) -> tuple[int, int]:
        before = self._monotonic_ns()
        wall = self._wall_ns()
        error_ns = (self._monotonic_ns() - before) // 2
        return wall - before - error_ns, error_ns


class Sleeps:
    """The sleeps of the computer that the monotonic clock does not count. Times: s, monotonic."""

    def __init__(self) -> None:
        self._sleeps: list[tuple[float, float]] = []
        """When the computer woke, and how long it had slept."""

    def add(self, slept_s: float, now: float) -> None:
        """Record that the computer has slept, and is awake now."""
        self._sleeps.append((now, slept_s))

    def age_s(self, at: float, now: float) -> float:
        """Return how long ago `at` was, at least 0, with the sleeps since then."""
        return max(0.0, now - at) + sum(slept_s for woke_at, slept_s in self._sleeps if at < woke_at)

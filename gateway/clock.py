"""The wall clock's time of moments of the loop's monotonic clock, in their order."""

import time
from collections.abc import Callable
from typing import Final

STEP_NS: Final = 2_000_000
"""Less between the two clocks is left alone: a slewed wall clock may gain 0.5 ms a second, and is followed in steps."""
CLOSE_NS: Final = 100_000
"""Three looks at clocks take less, unless the process does not run in between: then it looks again."""
TRIES: Final = 10
"""So often at most; of machines on which it never runs undisturbed the best counts."""


class WallClock:
    """One offset between the two clocks, kept until the wall clock is seen to have moved.

    Two moments keep their order and their distance, whenever they are asked for. With an offset taken anew for each
    they would not: a process that does not run between its looks at the two clocks would give an event a stamp before
    that of an earlier one.
    """

    def __init__(
        self, monotonic_ns: Callable[[], int] = time.monotonic_ns, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._wall_ns = wall_ns
        self._offset_ns, _ = self._measured()

    def ns(self, at: float) -> int:
        """Nanoseconds since the epoch at `at`, seconds of the monotonic clock."""
        offset_ns, wrong_ns = self._measured()
        if abs(offset_ns - self._offset_ns) > STEP_NS + wrong_ns:
            self._offset_ns = offset_ns
        return self._offset_ns + int(at * 1e9)

    def _measured(self) -> tuple[int, int]:
        """The offset, and by how much it may be wrong: the wall clock is read between two looks at the other."""
        best = self._once()
        for _ in range(TRIES - 1):
            if best[1] <= CLOSE_NS:
                break
            best = min(best, self._once(), key=lambda found: found[1])
        return best

    def _once(self) -> tuple[int, int]:
        before = self._monotonic_ns()
        wall = self._wall_ns()
        wrong_ns = (self._monotonic_ns() - before) // 2
        return wall - before - wrong_ns, wrong_ns

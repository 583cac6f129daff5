"""Converts the stamps of publishers, whose clocks may be wrong, to the clock of the recorder. Pure.

A message is received a moment after it was stamped, so the difference between the two times is the error of the
publisher's clock plus the delay. Usually the delay is small, but a backfilled message comes late. So the smallest
difference of the last messages is taken for the error alone.
"""

from typing import Final

from fleet.recording.tools.car_timeline import message_time_ns
from fleet.recording.tools.moment import Known

WINDOW_NS: Final = 30_000_000_000
"""Length of a window of the recorder's clock, in ns. The differences of this window and of the one before count, so
that a step of a clock no longer matters after two windows."""


class RecorderClock:
    """The errors of the publishers' clocks, by car or service."""

    def __init__(self) -> None:
        self._smallest: dict[str, tuple[int, int, int]] = {}
        """The window of the last message, the smallest difference in it, and that of the window before."""

    def time_ns(self, known: Known) -> int:
        """Return when a message was stamped, or published if it has no stamp, by the recorder's clock."""
        return self.at_ns(known.key.car, message_time_ns(known.message, known.publish_ns), known.log_ns)

    def at_ns(self, publisher: str, stamp_ns: int, log_ns: int) -> int:
        """Return when a message was stamped, by the recorder's clock. `log_ns` is when the recorder received it."""
        window, difference_ns = log_ns // WINDOW_NS, log_ns - stamp_ns
        last, smallest_ns, before_ns = self._smallest.get(publisher, (window, difference_ns, difference_ns))
        if window != last:
            smallest_ns, before_ns = difference_ns, smallest_ns
        smallest_ns = min(smallest_ns, difference_ns)
        self._smallest[publisher] = (window, smallest_ns, before_ns)
        return stamp_ns + min(smallest_ns, before_ns)

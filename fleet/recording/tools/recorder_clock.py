"""Converts the stamps of publishers, whose clocks may be wrong, to the clock of the recorder. Pure.

A message is received a moment after it was stamped, so the difference between the two times is the error of the
publisher's clock plus the delay. Usually the delay is small, but a backfilled message comes late. So the smallest
difference of the last messages is taken for the error alone. If a clock is set back, its messages seem to come late
from then on. Their numbers tell: they go up, while the stamps go back.
"""

from typing import Final

from fleet.recording.foreign_fields import number_of, text_of
from fleet.recording.tools.car_timeline import message_time_ns
from fleet.recording.tools.moment import Known

WINDOW_NS: Final = 30_000_000_000
"""Length of a window of the recorder's clock, in ns. The differences of this window and of the one before count, so
that a step of a clock that no number shows no longer matters after two windows."""
MIN_SET_BACK_NS: Final = 1_000_000_000
"""Minimum backward step of stamps that counts as a clock being set back."""


class RecorderClock:
    """The errors of the publishers' clocks, by car or service."""

    def __init__(self) -> None:
        self._smallest: dict[str, tuple[int, int, int]] = {}
        """The window of the last message, the smallest difference in it, and that of the window before."""
        self._newest: dict[tuple[str, str, str], tuple[int, int]] = {}
        """The number and the stamp of the newest message, by car or service, topic and start of the publisher."""

    def time_ns(self, known: Known) -> int:
        """Return when a message was stamped, or published if it has no stamp, by the recorder's clock."""
        stamp_ns = message_time_ns(known.message, known.publish_ns)
        if self._was_set_back(known, stamp_ns):
            self._smallest.pop(known.key.car, None)
        return self.at_ns(known.key.car, stamp_ns, known.log_ns)

    def _was_set_back(self, known: Known, stamp_ns: int) -> bool:
        """Return True if the publisher's clock was set back since the last message under this key."""
        boot, number = text_of(known.message, "boot_id"), number_of(known.message, "seq")
        if not boot:
            return False
        stream = known.key.car, known.key.topic, boot
        newest, newest_ns = self._newest.get(stream, (0, stamp_ns))
        if number < newest:  # a backfilled message
            return False
        self._newest[stream] = number, stamp_ns
        return stamp_ns < newest_ns - MIN_SET_BACK_NS

    def at_ns(self, publisher: str, stamp_ns: int, log_ns: int) -> int:
        """Return when a message was stamped, by the recorder's clock. `log_ns` is when the recorder received it."""
        window, difference_ns = log_ns // WINDOW_NS, log_ns - stamp_ns
        last, smallest_ns, before_ns = self._smallest.get(publisher, (window, difference_ns, difference_ns))
        if window != last:
            smallest_ns, before_ns = difference_ns, smallest_ns
        smallest_ns = min(smallest_ns, difference_ns)
        self._smallest[publisher] = (window, smallest_ns, before_ns)
        return stamp_ns + min(smallest_ns, before_ns)

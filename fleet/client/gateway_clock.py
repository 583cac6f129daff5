"""How far the clock of a gateway's computer is from ours. Clocks that differ by minutes have odd effects everywhere.

Answers of such a gateway look old, or from the future, and commands to it are `stale`. Stops, e-stops and pauses do not
depend on a clock. A state that was published just now shows the difference: its stamp is by the gateway's clock, and it
came at a time by our clock. After a delay on the way, the gateway's clock seems to be further behind than it is. So the
message with the largest lead over our clock counts, and one message is not enough.

A gateway that hangs publishes nothing, so nothing is known about its clock. A replay publishes old stamps at the usual
rate, but is not a gateway: the caller must leave it out. Pure.
"""

from collections import deque
from typing import Final

MAX_CLOCK_OFF_S: Final = 5.0
"""A larger difference of two clocks is reported. A gateway refuses a command that comes from further in the future."""
_KEPT: Final = 8
"""Number of messages that are remembered: those of 1.6 s, because five states come once a second each."""
_MIN_STAMPS: Final = 2
_NS: Final = 1e9


class GatewayClock:
    """Compares the clock of one gateway with ours, by states that were published just now."""

    def __init__(self) -> None:
        self._boot_id = ""
        self._leads: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        """Stamp (ns), and how far it was ahead of our clock when it came (s)."""

    def take(self, boot_id: str, stamp_ns: int, now_ns: int) -> None:
        """Add a state. `now_ns` is the time by our wall clock at which it came."""
        if boot_id != self._boot_id:  # another process, perhaps elsewhere
            self._boot_id = boot_id
            self._leads.clear()
        self._leads.append((stamp_ns, (stamp_ns - now_ns) / _NS))

    @property
    def off_s(self) -> float | None:
        """How many seconds the gateway's clock is ahead of ours. Negative if it is behind. None if not known yet."""
        if len({stamp for stamp, _ in self._leads}) < _MIN_STAMPS:
            return None
        return max(lead for _, lead in self._leads)


def describe_clock(car: str, off_s: float | None) -> str:
    """Return a text about a clock that is off by more than MAX_CLOCK_OFF_S. Empty otherwise."""
    if off_s is None or abs(off_s) <= MAX_CLOCK_OFF_S:
        return ""
    side = "ahead of" if off_s > 0 else "behind"
    return f"The clock of the computer of {car}'s gateway is {_words(abs(off_s))} {side} this computer's."


def _words(off_s: float) -> str:
    minutes, seconds = divmod(round(off_s), 60)
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "h"), (minutes, "min"), (seconds, "s"))
    return " ".join(f"{count} {unit}" for count, unit in parts if count)

"""Sets the delay between attempts to open a link, and limits how often they are logged."""

from typing import Final

from schemas.backoff import backoff_s

FIRST_DELAY_S: Final = 0.25
MAX_RECONNECT_DELAY_S: Final = 1.0
"""Delay after the first failure, and maximum delay. They are short, because a car may be driving while its link is
down."""
PROVEN_S: Final = 3.0
"""Time after which an open link counts as proven even without a reading."""
MAX_LOGGED_CAUSES: Final = 10
"""Maximum different causes that are logged until a link is proven. The opening of the link counts as one."""
_OPENED: Final = ""


def delay_s(failures: int, jitter: float) -> float:
    """Return the delay in s after `failures` (1..) in a row: half of the backoff with `jitter` 0, all of it with 1."""
    return backoff_s(failures, FIRST_DELAY_S, MAX_RECONNECT_DELAY_S) * (0.5 + 0.5 * jitter)


class Attempts:
    """Counts the attempts to open one link. They must not be frequent, because each may reset a car's board.

    A link is proven by a reading or an echo, or after `PROVEN_S`. After the loss of a proven link the delay starts from
    the shortest. A link that is lost before it is proven counts as a failure. Until a link is proven, each cause of a
    loss is logged only once, and so is the opening of the link.
    """

    def __init__(self) -> None:
        self._failures = 0
        self._logged: set[str] = set()
        self._opened_at: float | None = None
        """When the link was opened, if it is open and not proven yet, else None."""
        self._log_when_proven = False

    def on_open(self, now: float) -> bool:
        """Record that the link is open. Return True if that should be logged."""
        self._opened_at = now
        self._log_when_proven = _OPENED in self._logged
        self._logged.add(_OPENED)
        return not self._log_when_proven

    def check_proven(self, now: float, *, has_reading: bool) -> bool:
        """Check whether the open link is proven now. Return True if its opening should be logged now."""
        if self._opened_at is None or not (has_reading or now - self._opened_at >= PROVEN_S):
            return False
        self._opened_at = None
        self._failures = 0
        self._logged.clear()
        return self._log_when_proven

    def on_failed(self, cause: str) -> bool:
        """Record that the link did not open, or is lost. Return True if the cause should be logged."""
        self._opened_at = None
        self._failures += 1
        should_log = cause not in self._logged and len(self._logged) < MAX_LOGGED_CAUSES
        if should_log:
            self._logged.add(cause)
        return should_log

    def delay_s(self, jitter: float) -> float:
        """Return the delay in s before the next attempt. For `jitter`, see the function `delay_s`."""
        return delay_s(max(1, self._failures), jitter)

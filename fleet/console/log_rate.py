"""Limits the lines of the log by their cause, so that a flood of requests cannot fill the disk. Pure."""

import logging
from typing import Final

from schemas.token_bucket import TokenBucket

LOG_BURST: Final = 50.0
"""Lines of one cause at once. That is more than a person reads, and enough to log every device of a class that
joins."""
LOG_RATE: Final = 0.1
"""Further lines of one cause per second: one in 10 s, as with the other limits of the log."""


class LogRate(logging.Filter):
    """Lets a limited number of lines of each cause pass, and counts the rest.

    The cause is the line of code that logs.
    """

    def __init__(self) -> None:
        super().__init__()
        self._allowances: dict[tuple[str, int], TokenBucket] = {}
        self._left_out: dict[tuple[str, int], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the line is logged. If lines were left out before, add their number to it."""
        cause, now = (record.pathname, record.lineno), record.created
        if not self._allowances.setdefault(cause, TokenBucket(LOG_RATE, LOG_BURST)).take_one(now):
            self._left_out[cause] = self._left_out.get(cause, 0) + 1
            return False
        if left_out := self._left_out.pop(cause, 0):
            record.msg, record.args = f"{record.getMessage()} ({left_out} more like this were left out)", ()
        return True

"""The rate of log lines by cause."""

import logging

from fleet.console.log_rate import LOG_BURST, LOG_RATE, LogRate


def record(line: int, at: float) -> logging.LogRecord:
    made = logging.LogRecord("fleet", logging.WARNING, "client.py", line, "busy: %s", ("red",), None)
    made.created = at
    return made


def test_log_rate_is_per_cause_and_counts_omissions() -> None:
    limit, burst = LogRate(), int(LOG_BURST)
    assert sum(limit.filter(record(1, 0.0)) for _ in range(burst + 7)) == burst
    assert limit.filter(record(2, 0.0)), "another cause"
    later = record(1, 1.0 / LOG_RATE)
    assert limit.filter(later)
    assert later.getMessage().startswith("busy: red (7 ")
    again = record(1, 2.0 / LOG_RATE)
    assert limit.filter(again)
    assert again.getMessage() == "busy: red"

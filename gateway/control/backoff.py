"""How long to wait before the next try to connect."""

from typing import Final

FIRST_S: Final = 0.25
LONGEST_S: Final = 1.0
"""A car may be driving while its link is away: whatever a try costs, it is tried again within a second."""


def delay_s(failures: int, jitter: float) -> float:
    """Seconds before the next try after `failures` (1..) in a row; `jitter` 0..1 spreads it over the upper half."""
    longest = min(LONGEST_S, FIRST_S * 2.0 ** min(failures - 1, 10))
    return longest * (0.5 + 0.5 * jitter)

"""Exponential backoff: how long to wait after failures in a row. Pure."""

from typing import Final

_MAX_DOUBLINGS: Final = 32
"""Far beyond every limit, and far below what a float overflows at."""


def backoff_s(failures: int, first_s: float, longest_s: float) -> float:
    """Return the delay after this many failures in a row (1, 2, ...): `first_s`, doubled each time, to `longest_s`."""
    return min(longest_s, first_s * 2.0 ** min(failures - 1, _MAX_DOUBLINGS))

"""Exponential backoff: how long to wait after failures in a row. Pure."""

from typing import Final

_MAX_DOUBLINGS: Final = 32
"""Maximum number of doublings: more than any limit needs, and far too few to overflow a float."""


def backoff_s(failures: int, first_s: float, longest_s: float) -> float:
    """Return the delay after `failures` in a row (1, 2, ...): `first_s`, doubled each time, at most `longest_s`."""
    return min(longest_s, first_s * 2.0 ** min(failures - 1, _MAX_DOUBLINGS))

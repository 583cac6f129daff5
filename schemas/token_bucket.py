"""Limits how often something may happen: in a burst, and per second in the long run. Pure."""


class TokenBucket:
    """Allows up to `at_once` events in a burst, and `per_s` events per second in the long run. Times: s, monotonic."""

    __slots__ = ("_at", "_left", "at_once", "per_s")

    def __init__(self, per_s: float, at_once: float) -> None:
        self.per_s = per_s
        self.at_once = at_once
        self._left = at_once
        self._at = float("-inf")

    def has(self, now: float) -> bool:
        """Return True if one event may happen now."""
        self._left = min(self.at_once, self._left + self.per_s * max(0.0, now - self._at))
        self._at = max(self._at, now)
        return self._left >= 1.0

    def take_one(self, now: float) -> bool:
        """Return True if one event may happen now, and count it."""
        return self.take(1, now) == 1

    def take(self, requested: int, now: float) -> int:
        """Return how many of the requested events may happen now, 0..requested, and count these."""
        granted = min(requested, int(self._left)) if self.has(now) else 0
        self._left -= granted
        return granted

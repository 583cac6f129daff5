"""Limits a rate, so that a car that sends garbage without end costs little. No clock."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class TokenBucket:
    """Grants bursts of up to `at_once`, and `per_s` in the long run. Times: s, monotonic."""

    per_s: float
    at_once: float
    _left: float = field(init=False)
    _at: float = float("-inf")

    def __post_init__(self) -> None:
        self._left = self.at_once

    def take(self, requested: int, now: float) -> int:
        """Return how many of the requested may pass now, 0..requested."""
        self._left = min(self.at_once, self._left + self.per_s * max(0.0, now - self._at))
        self._at = max(self._at, now)
        granted = min(requested, int(self._left))
        self._left -= granted
        return granted

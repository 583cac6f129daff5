"""So much per second and no more: bounds what a car that sends nonsense without end can cost. No clock."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class TokenBucket:
    """Up to `at_once` at any moment, and `per_s` in the long run. Times are seconds on one monotonic clock."""

    per_s: float
    at_once: float
    _left: float = field(init=False)
    _at: float = float("-inf")

    def __post_init__(self) -> None:
        self._left = self.at_once

    def take(self, wanted: int, now: float) -> int:
        """How much of what is wanted may pass now, 0..wanted."""
        self._left = min(self.at_once, self._left + self.per_s * max(0.0, now - self._at))
        self._at = max(self._at, now)
        granted = min(wanted, int(self._left))
        self._left -= granted
        return granted

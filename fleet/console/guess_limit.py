"""How long an address must wait after wrong pairing codes. Pure: times are monotonic."""

from typing import Final

from msgspec import Struct, field

from schemas.backoff import backoff_s

FREE_GUESSES: Final = 5
"""Number of wrong codes after which an address must wait."""
MAX_GUESS_DELAY_S: Final = 300.0
GUESS_MEMORY_S: Final = 3600.0
"""Time after which the wrong codes of an address are forgotten."""
MAX_GUESSERS: Final = 1024
"""Maximum number of remembered addresses. More are forgotten, the oldest first."""


class WrongCode(Exception):
    """A code is wrong, used or too old. `wait_s`: how long its address has to wait before the next try, s."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(f"wait {wait_s:.0f} s")
        self.wait_s = wait_s


class TooManyGuesses(WrongCode):
    """The address has to wait after wrong codes. The code was not looked at, so it may be right."""


class GuessLimit(Struct):
    """Counts wrong codes, and delays further tries from the addresses that sent them. Times are monotonic."""

    wrong: int = 0
    """Number of all wrong codes, and of all tries that came before the end of a wait."""
    _guessers: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Number of wrong codes and time of the last one, by address."""

    def wait_s(self, address: str, now: float) -> float:
        """Return how long this address must still wait before another try (s), or 0 if it may try now."""
        count, last = self._guessers.get(address, (0, now))
        if count < FREE_GUESSES or now - last >= GUESS_MEMORY_S:
            return 0.0
        return max(0.0, last + backoff_s(count - FREE_GUESSES + 1, 1.0, MAX_GUESS_DELAY_S) - now)

    def on_wrong(self, address: str, now: float) -> int:
        """Count a wrong code. Return the number of wrong codes of this address."""
        count, last = self._guessers.pop(address, (0, now))
        count = 1 if now - last >= GUESS_MEMORY_S else count + 1
        self._guessers[address] = count, now
        if len(self._guessers) > MAX_GUESSERS:
            del self._guessers[next(iter(self._guessers))]
        self.wrong += 1
        return count

    def on_right(self, address: str) -> None:
        """Forget the wrong codes of an address that has paired."""
        self._guessers.pop(address, None)

"""Makes sure that there is only one service of a kind, such as one gateway per car.

Each service answers queries of its status. At its start, a service queries the others and gives up if one answers. Two
that start at the same moment may miss each other, so each queries again a moment later, when both can answer. Then the
one with the higher boot id gives up.
"""

import time
from collections.abc import Callable
from typing import Any

from schemas.bus.replies import BUSY
from schemas.bus.sample import Failure, messages_of
from schemas.bus.zenoh_session import Bus


class Singleton:
    """The check of one service. `describe` makes the error from the status message of another service."""

    def __init__(self, bus: Bus, status_key: str, describe: Callable[[Any], Exception], timeout_s: float = 2.0) -> None:
        self._bus = bus
        self._status_key = status_key
        self._describe = describe
        self._timeout_s = timeout_s

    def others(self) -> list[Any]:
        """Return the status messages of all other services of this kind.

        It blocks until they have answered, but at most for twice `timeout_s`.
        """
        found: list[Any] = []
        deadline, busy = time.monotonic() + self._timeout_s, True
        while busy and time.monotonic() < deadline:
            answers = list(self._bus.query(self._status_key, timeout_s=self._timeout_s))
            busy = Failure(BUSY) in answers  # there is another service, which will answer soon
            found += [status for status in messages_of(answers) if status.boot_id != self._bus.boot_id]
        return found

    def check_alone(self) -> None:
        """Raise the error if there is another service."""
        for other in self.others():
            raise self._describe(other)

    def raise_unless_first(self) -> bool:
        """Raise the error if another service has a lower boot id. Return True if another one has to give up."""
        others = self.others()
        for other in others:
            if other.boot_id < self._bus.boot_id:
                raise self._describe(other)
        return bool(others)

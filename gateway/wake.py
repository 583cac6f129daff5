"""When the writer of one car has work: at once if something happened, else when control or the decoder needs it."""

import asyncio
from math import inf
from typing import Final

from gateway.control.controller import Controller
from gateway.control.driver import Driver

MAX_SLEEP_S: Final = 3600.0
"""Maximum sleep of the writer: asyncio takes no infinite timer."""


class Wake:
    """Wakes the writer. Made in its loop."""

    def __init__(self, control: Controller[Driver]) -> None:
        self._control = control
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        self._at = self._loop.time()
        """When the writer wakes by itself."""

    def set(self) -> None:
        """Wake the writer now."""
        self._event.set()

    def set_if_due(self, now: float) -> None:
        """Wake the writer only if it has work. Waking it for every reading costs a third more CPU."""
        if self._control.has_records or self._due_at(now) < self._at:
            self._event.set()

    def clear(self) -> None:
        """Begin to work: what happens from now on wakes the writer again."""
        self._event.clear()

    async def wait(self, latest: float = inf) -> None:
        """Wait for work, until `latest` of the loop's clock."""
        now = self._loop.time()
        self._at = self._due_at(now)
        timer = self._loop.call_at(min(self._at, latest, now + MAX_SLEEP_S), self._event.set)
        await self._event.wait()
        timer.cancel()

    def _due_at(self, now: float) -> float:
        """Return when control or the decoder needs the loop next, if nothing else happens."""
        driver = self._control.driver
        return min(driver.next_at(now), driver.flush_at())

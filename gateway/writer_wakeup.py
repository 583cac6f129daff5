"""Wakes the writer of one car when it has work: after an event, or at the time that the driver asked for."""

import asyncio
from math import inf
from typing import Final

from gateway.control.controller import Controller
from gateway.control.driver import Driver

MAX_SLEEP_S: Final = 3600.0
"""Maximum sleep of the writer, even if the driver has nothing to do."""


class WriterWakeup:
    """Wakes the writer. Create it in the writer's loop."""

    def __init__(self, control: Controller[Driver]) -> None:
        self._control = control
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        self._at = self._loop.time()
        """When the writer wakes if no event wakes it earlier."""

    def set(self) -> None:
        """Wake the writer now."""
        self._event.set()

    def set_if_due(self, now: float) -> None:
        """Wake the writer only if it has work. To wake it for every reading would cost a third more CPU."""
        if self._control.has_records or self._due_at(now) < self._at:
            self._event.set()

    def clear(self) -> None:
        """Begin to work: an event from now on wakes the writer again."""
        self._event.clear()

    async def wait(self, latest: float = inf) -> None:
        """Wait for work, at most until `latest` (the loop's clock)."""
        now = self._loop.time()
        self._at = self._due_at(now)
        timer = self._loop.call_at(min(self._at, latest, now + MAX_SLEEP_S), self._event.set)
        await self._event.wait()
        timer.cancel()

    def _due_at(self, now: float) -> float:
        """Return when the driver next has something to write or to decode, if nothing else happens."""
        driver = self._control.driver
        return min(driver.next_at(now), driver.flush_at())

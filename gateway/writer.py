"""Writes to the car: only this module does, one frame at a time."""

import asyncio
from collections.abc import Callable

from gateway.bus.car_publisher import CarPublisher
from gateway.control.control_output import OutgoingFrame
from gateway.control.driver import Driver
from gateway.link import LinkLost
from gateway.link_loop import LinkLoop
from gateway.wake import Wake
from schemas.process.service_notifier import ServiceNotifier
from schemas.words import Reason


class Writer:
    """The frames to one car. `run` runs until it is cancelled."""

    def __init__(
        self,
        driver: Driver,
        link: LinkLoop,
        publisher: CarPublisher,
        wake: Wake,
        *,
        on_gap: Callable[[float], None],
        on_opened: Callable[[float], None],
        notifier: ServiceNotifier,
    ) -> None:
        """`on_gap` looks for a gap of the loop before a frame is chosen. `on_opened`: `Driver.opened_as` changed.

        `notifier`: is fed by each turn and each frame, and by nothing else. So if no frame can be written any more,
        systemd starts another gateway, which stops the car.
        """
        self._loop = asyncio.get_running_loop()
        self._driver = driver
        self._link = link
        self._publisher = publisher
        self._wake = wake
        self._on_gap = on_gap
        self._on_opened = on_opened
        self._notifier = notifier
        self.finished = asyncio.Event()
        """Set when the driver has finished after `shut_down`."""

    async def run(self, flush: Callable[[], None]) -> None:
        """Write frames when control needs it. After each turn, `flush` answers queries and publishes records."""
        while True:
            self._wake.clear()
            await self._write_due()
            flush()
            if self._driver.finished:
                self.finished.set()
            self._notifier.feed(self._loop.time())
            await self._wake.wait(self._notifier.due_at)

    async def _write_due(self) -> None:
        """Write the frames that are due."""
        now = self._loop.time()
        self._on_gap(now)  # before the decoder: reports that are read late may look like a pause
        self._link.on_events(self._driver.flush(now))
        while (link := self._link.link) is not None and (write := self._next_frame()) is not None:
            self._driver.sends(write.data, self._loop.time())  # an echo may arrive before the write returns
            try:
                await link.write(write.data)
            except LinkLost as error:
                reason = f"a write failed: {error}"
                now = self._loop.time()
                self._publisher.publish_frame(write, now, whole=False)
                self._driver.link_down(reason, now, cause=Reason.WRITE_FAILED)
                if self._link.link is link:  # else `keep_open` has noticed the loss already
                    self._link.lost(reason)
                await link.close()  # `keep_open` wakes and reopens it
                return
            now = self._loop.time()
            opened_as = self._driver.opened_as
            self._driver.on_written(write, now)
            if self._driver.opened_as != opened_as:  # the next gateway needs it to stop the car
                self._on_opened(now)
            self._link.health.on_written(len(write.data), now)
            self._publisher.publish_frame(write, now, whole=True)
            self._notifier.feed(now)

    def _next_frame(self) -> OutgoingFrame | None:
        """Return the frame to write now, if any. The computer may have slept since the last one."""
        now = self._loop.time()
        self._on_gap(now)
        return self._driver.poll(now)

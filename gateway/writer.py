"""Writes frames to the car, one at a time. In a gateway, only `stop_without_hub` writes to it, too."""

import asyncio
from collections.abc import Callable

from gateway.bus.car_publisher import CarPublisher
from gateway.control.control_output import OutgoingFrame
from gateway.control.driver import Driver
from gateway.link import LinkLost
from gateway.link_loop import LinkLoop
from gateway.writer_wakeup import WriterWakeup
from schemas.process.service_notifier import ServiceNotifier
from schemas.words import Reason


class Writer:
    """Writes the frames to one car. `run` runs until it is cancelled."""

    def __init__(
        self,
        driver: Driver,
        link: LinkLoop,
        publisher: CarPublisher,
        wake: WriterWakeup,
        *,
        on_gap: Callable[[float], None],
        on_urgent_change: Callable[[float], None],
        notifier: ServiceNotifier,
    ) -> None:
        """Make the writer of a car. `on_gap` is called before a frame is chosen, to detect a gap of the loop.

        `on_urgent_change` is called when `Driver.opened_as` or the speed of the car has changed. `notifier` tells
        systemd after each turn and each frame that the gateway works, and at no other time. So if no frame can be
        written any more, systemd starts another gateway, which stops the car.
        """
        self._loop = asyncio.get_running_loop()
        self._driver = driver
        self._link = link
        self._publisher = publisher
        self._wake = wake
        self._on_gap = on_gap
        self._on_urgent_change = on_urgent_change
        self._notifier = notifier
        self.finished = asyncio.Event()
        """Set when the driver has finished after `shut_down`."""

    async def run(self, flush: Callable[[], None]) -> None:
        """Write frames when they are due. Call `flush` after each turn, to publish records and answer queries."""
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
        self._on_gap(now)  # first, because reports that are decoded late look as if a frame had kept the car busy
        self._link.on_events(self._driver.flush(now))
        while (link := self._link.link) is not None and (write := self._next_frame()) is not None:
            self._driver.sends(write.data, self._loop.time())  # the car may repeat the bytes before the write returns
            try:
                await link.write(write.data)
            except LinkLost as error:
                reason = f"a write failed: {error}"
                now = self._loop.time()
                self._publisher.publish_frame(write, now, whole=False)
                self._driver.link_down(reason, now, cause=Reason.WRITE_FAILED)
                if self._link.link is link:  # `keep_open` may have noticed the loss first
                    self._link.lost(reason)
                await link.close()  # `keep_open` wakes and reopens it
                return
            now = self._loop.time()
            before = self._driver.opened_as, self._driver.model.outputs.speed
            self._driver.on_written(write, now)
            # The next gateway needs this to stop the car, and not to exceed `speed_max`.
            if (self._driver.opened_as, self._driver.model.outputs.speed) != before:
                self._on_urgent_change(now)
            self._link.health.on_written(len(write.data), now)
            self._publisher.publish_frame(write, now, whole=True)
            self._notifier.feed(now)

    def _next_frame(self) -> OutgoingFrame | None:
        """Return the frame to write now, if any. Look for a gap first: the computer may have slept meanwhile."""
        now = self._loop.time()
        self._on_gap(now)
        return self._driver.poll(now)

"""Keeps the link of one car open, and reads from it: the driver decodes the bytes into events.

Each event is first published, and then given to the driver, which updates its state. A lost link is opened again, for
ever.
"""

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Final

from gateway.bus.car_publisher import RAW_PER_S, CarPublisher
from gateway.control.controller import Controller
from gateway.control.driver import Driver, Echo, Event, Rejected, TextLine
from gateway.control.link_health import LinkHealth
from gateway.control.reconnect_delay import Attempts
from gateway.link import Busy, Link, LinkError, LinkLost, LinkUrl, open_link
from gateway.link.baud import BaudWatch
from gateway.writer_wakeup import WriterWakeup
from schemas.links import BAUD, SerialUrl, UsbUrl
from schemas.words import FrameVerdict, Level, LinkState, Motors

SLICE_BYTES: Final = 1024
"""Maximum bytes that are decoded before other tasks, such as a stop, get a turn. At 9600 baud, 960 come a second."""
MAX_BYTES_AGE_S: Final = 0.25
"""Maximum time from the reading of bytes to their decoding. Later they are discarded: newer ones matter more."""
MIN_DAMAGED: Final = 3
"""Number of damaged frames after which the link looks for the cause."""
LOOK_INTERVAL_S: Final = 10.0
"""Minimum interval at which the link looks for the cause of damage."""
FLOOD_LOG_PAUSE_S: Final = 10.0
"""Minimum time since the last bytes of a flood before another flood is logged."""
BITS_PER_BYTE: Final = 10
"""Bits of a byte on a UART: 8N1."""


class LinkLoop:
    """The link of one car. `keep_open` runs until it is cancelled."""

    def __init__(
        self,
        url: LinkUrl,
        control: Controller[Driver],
        publisher: CarPublisher,
        wake: WriterWakeup,
        *,
        log: Callable[[Level, str, str], None],
        on_gap: Callable[[float], None],
        log_open: Callable[[], None],
    ) -> None:
        """Make the loop of a link. `on_gap` is called before bytes are decoded, to detect a gap of the asyncio loop.

        `log` logs and publishes an event of the gateway: its level, its code, and its words.
        `log_open` logs that the link is open. It is called when the link opens. After a link that was lost before it
        was proven, it is called only when the new link is proven: by a reading or an echo, or by its age (see
        `Attempts`).
        """
        self._loop = asyncio.get_running_loop()
        now = self._loop.time()
        self.url = url
        self.link: Link | None = None
        """The open link, or None."""
        self.health = LinkHealth(since=now, bytes_per_s=control.driver.model.profile.baud / BITS_PER_BYTE)
        self._car = control.car
        self._control = control
        self._driver = control.driver
        self._publisher = publisher
        self._wake = wake
        self._on_gap = on_gap
        self._log = log
        self._log_open = log_open
        self._baud = BaudWatch(url)
        self._flood_until = now
        self._attempts = Attempts()
        self._trouble = ""
        """The last logged trouble of an open link."""
        self._damaged = 0
        """Frames that were rejected since the link last looked for trouble."""
        self._look_at = now

    async def keep_open(self, *, may_fail: bool, is_in_use: Callable[[], Awaitable[bool]]) -> None:
        """Keep the link open, and read from it. Without `may_fail`, raise LinkError if it does not open at the start.

        `is_in_use` returns True if another gateway, which has to end, may still have the port open. As long as it does,
        a failed attempt is repeated. After that, a busy port is tried once more.
        """
        looked_again = False
        while True:
            try:
                link = await open_link(self.url, first=self._may_move)
            except LinkError as error:
                if not may_fail and not await is_in_use():
                    if looked_again or not isinstance(error, Busy):
                        raise
                    looked_again = True  # the gateway that had the port may have ended meanwhile
                else:
                    self.lost(str(error))
                await self._pause()
                continue
            may_fail = True
            now = self._loop.time()
            self.link = link
            self._baud = BaudWatch(self.url)
            self.health.on_open(now)
            self._control.link_up(now)
            if self._attempts.on_open(now):
                self._log_open()
            self._wake.set()
            try:
                await self._read(link)
            except LinkLost as error:
                self.on_events(self._driver.drop_bytes())
                if self.link is link:
                    self.lost(str(error))
            await link.close()
            await self._pause()

    async def _pause(self) -> None:
        """Wait before the next attempt to open the link."""
        await asyncio.sleep(self._attempts.delay_s(random.random()))  # noqa: S311 - jitter, no secret

    @property
    def _may_move(self) -> bool:
        """True if the car may be moving while its link is down."""
        return self._control.was_open and self._driver.model.motors is not Motors.OFF

    async def _read(self, link: Link) -> None:
        """Decode bytes until the link is lost."""
        while True:
            data = await link.read()
            read_at = now = self._loop.time()
            self.health.on_bytes(len(data), now)
            self._on_gap(now)  # first, because reports that are read late look as if a frame had kept the car busy
            for start in range(0, len(data), SLICE_BYTES):
                if start:
                    await asyncio.sleep(0)
                    now = self._loop.time()
                if now > read_at + MAX_BYTES_AGE_S:
                    self.on_events(self._driver.drop_bytes())
                    self._on_flood("flood_bytes", len(data) - start, now)
                    break
                self.on_events(self._driver.feed(data[start : start + SLICE_BYTES], now))
            if (doubt := self._baud.on_bytes(data)) is not None:
                self.health.on_rejected(doubt.cause, 1)
                self._log(Level.WARNING, "no_frames", doubt.words)
            if self._publisher.is_outdated:
                self._wake.set()
            self._wake.set_if_due(now)

    def _on_flood(self, counted_as: str, count: int, now: float) -> None:
        """Count discarded data, and log each flood once."""
        self.health.on_rejected(counted_as, count)
        if now >= self._flood_until:
            words = (
                f"{self._car} sends more bytes than any car: another device, or a wrong baud rate? "
                f"The gateway publishes {RAW_PER_S:g} raw frames a second and counts the rest in state/link."
            )
            self._log(Level.WARNING, "flood", words)
        self._flood_until = now + FLOOD_LOG_PAUSE_S

    def on_events(self, events: list[Event]) -> None:
        """Publish the measurements of the events, then update the state of the car with them."""
        for event in events:
            if not self._publisher.publish_event(event):
                self._on_flood("raw_not_published", 1, event.at)
            self._driver.on_event(event, self._loop.time())
            if isinstance(event, TextLine):
                self.health.on_rejected(FrameVerdict.TEXT)  # text shows that a program runs, but not that it is a car's
                continue
            self.health.rx_frames += 1
            if isinstance(event, Rejected):
                self.health.on_rejected(event.cause)
                self._damaged += 1
                continue
            self._baud.on_frame()
            if not isinstance(event, Echo):
                self.health.on_reading(event.at)
            if self._attempts.check_proven(event.at, has_reading=True):
                self._log_open()

    def lost(self, reason: str) -> None:
        """Record that the link is down, and fail all commands."""
        now = self._loop.time()
        self.link = None
        self.health.on_lost(reason, now)
        self._driver.link_down(reason, now)
        if self._attempts.on_failed(reason):
            self._log(Level.WARNING, "link_lost", reason)
        self._wake.set()

    def check(self, now: float) -> None:
        """Log the opening of a link that is now proven, if this opening is not logged yet.

        If bytes are damaged or missing, let the link look for the cause. Log a cause unless it was logged last.
        """
        if self._attempts.check_proven(now, has_reading=False):
            self._log_open()
        if self.link is None:
            return
        is_stale = self.health.state is LinkState.STALE
        if now >= self._look_at and (is_stale or self._damaged >= MIN_DAMAGED):
            self._damaged, self._look_at = 0, now + LOOK_INTERVAL_S
            self.link.look_for_trouble()
        trouble = self.link.trouble
        if trouble and trouble != self._trouble:
            self._trouble = trouble
            self.health.on_rejected("port_shared")
            self._log(Level.WARNING, "port_shared", trouble)


def at_rate(url: LinkUrl, baud: int) -> LinkUrl:
    """Return a link with the baud rate of its car, unless its URL has another rate than the default, `BAUD`."""
    return url.at_rate(baud) if isinstance(url, SerialUrl | UsbUrl) and url.baud == BAUD else url

"""Listens to one link, probes it on request, and decides whether a car is on it. Prints nothing."""

import asyncio
import time
from collections.abc import Sequence

from msgspec import Struct, field

from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.frames import encode
from gateway.drivers.yahboom.protocol.modes import candidate_modes
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.wire_events import Event
from gateway.drivers.yahboom.stops.sequences import GENERAL, STOP_REPORT_TIMEOUT_S
from gateway.link import Busy, Link, LinkError, LinkUrl, open_link
from gateway.link.serial_port_list import SerialPort
from gateway.tools import cli_support
from gateway.tools.link_statistics import LinkStatistics
from schemas.words import LinkVerdict, Mode, Platform


class LinkProbe(Struct):
    """One link with its statistics and its verdict."""

    url: LinkUrl
    port: SerialPort | None = None
    link: Link | None = None
    statistics: LinkStatistics = field(default_factory=LinkStatistics)
    trouble: str | None = None
    busy: bool = False
    probed: bool = False
    answered: bool = False
    """True after a reading of mode 0. If the link was probed, only readings after the probe's last frame count."""
    _decoder: FrameSplitter = field(default_factory=FrameSplitter)
    _profile: Profile = field(default_factory=lambda: cli_support.profile_of(Platform.UNKNOWN))

    async def open(self) -> None:
        """Open the link. Store an error in `trouble`."""
        try:
            self.link = await open_link(self.url)
        except LinkError as error:
            self.trouble, self.busy = str(error), isinstance(error, Busy)
        else:
            self.statistics.since = time.monotonic()

    async def listen(self, seconds: float, *, until_answered: bool = False) -> None:
        """Read for this time, or until a reading of mode 0. If the link is lost, store the reason in `trouble`."""
        assert self.link is not None
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end and not (until_answered and self.answered):
            deadline = self._decoder.deadline()
            wait_s = end - now if deadline is None else min(end, max(now, deadline)) - now
            try:
                async with asyncio.timeout(wait_s):
                    data = await self.link.read()
            except TimeoutError:
                self._count(self._decoder.flush(time.monotonic()))
            except LinkError as error:
                self.trouble = str(error)
                break
            else:
                self.statistics.bytes += len(data)
                self._count(self._decoder.feed(data, time.monotonic()))
        self.statistics.until = time.monotonic()

    async def probe(self) -> None:
        """Send the stop of an unknown platform (docs/reference/protocol.md#stops) and wait for a reading of mode 0."""
        assert self.link is not None
        self.probed = True
        last = time.monotonic()
        for step in GENERAL.steps:
            await self.listen(last + step.after_s - time.monotonic())
            if self.trouble is not None:
                return
            data, last = encode(step.frame), time.monotonic()
            self._decoder.sends(data, last)
            try:
                await self.link.write(data)
            except LinkError as error:
                self.trouble = str(error)
                return
        self.answered = False
        await self.listen(STOP_REPORT_TIMEOUT_S, until_answered=True)

    def end(self) -> None:
        """Count the last events of the decoder."""
        self._count(self._decoder.end())

    @property
    def verdict(self) -> LinkVerdict:
        """The kind of the link, so far."""
        if self.link is None:
            return LinkVerdict.BUSY if self.busy else LinkVerdict.FAILED
        if self.statistics.readings:
            return LinkVerdict.CAR
        if self.trouble is not None:
            return LinkVerdict.FAILED
        return LinkVerdict.OTHER if self.statistics.bytes else LinkVerdict.SILENT

    def _count(self, events: Sequence[Event]) -> None:
        for event in events:
            self.statistics.count(event, self._profile)
            if isinstance(event, Sensors) and candidate_modes(event) == (Mode.MANUAL,):
                self.answered = True

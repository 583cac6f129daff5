"""One link that is listened to, and probed if wanted: what it is, by what came over it. Nothing is shown here."""

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.control.stops.sequences import STOP_REPORT_TIMEOUT_S, UNKNOWN
from gateway.link import Busy, Link, LinkError, LinkUrl, open_link
from gateway.protocol.decoder import Decoder
from gateway.protocol.enums import Mode
from gateway.protocol.events import Event, Sensors
from gateway.protocol.frames import encode
from gateway.protocol.platforms import Profile
from gateway.tools import cli_support
from gateway.tools.discovery import SerialPort
from gateway.tools.statistics import LinkStatistics


class LinkVerdict(StrEnum):
    """What a link is, by what came over it."""

    CAR = "car"
    OTHER = "other"
    SILENT = "silent"
    BUSY = "busy"
    FAILED = "failed"


@dataclass(slots=True)
class LinkProbe:
    """One link that is listened to, and what was heard."""

    url: LinkUrl
    port: SerialPort | None = None
    link: Link | None = None
    tally: LinkStatistics = field(default_factory=LinkStatistics)
    trouble: str | None = None
    busy: bool = False
    probed: bool = False
    answered: bool = False
    """A reading of mode 0 has come (after the last frame, if it was probed)."""
    _decoder: Decoder = field(default_factory=Decoder)
    _profile: Profile = field(default_factory=lambda: cli_support.profile_of("unknown"))

    async def open(self) -> None:
        """Open the link; trouble is noted, not raised."""
        try:
            self.link = await open_link(self.url)
        except LinkError as error:
            self.trouble, self.busy = str(error), isinstance(error, Busy)
        else:
            self.tally.since = time.monotonic()

    async def listen(self, seconds: float, *, until_answered: bool = False) -> None:
        """Take in what comes for so long, or until mode 0 has answered; a link that is lost is trouble."""
        assert self.link is not None
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end and not (until_answered and self.answered):
            deadline = self._decoder.deadline()
            wait_s = end - now if deadline is None else min(end, max(now, deadline)) - now
            try:
                async with asyncio.timeout(wait_s):
                    data = await self.link.read()
            except TimeoutError:
                self._count(self._decoder.tick(time.monotonic()))
            except LinkError as error:
                self.trouble = str(error)
                break
            else:
                self.tally.bytes += len(data)
                self._count(self._decoder.feed(data, time.monotonic()))
        self.tally.until = time.monotonic()

    async def probe(self) -> None:
        """Send an unknown car's stop (docs/reference/protocol.md#stops), and wait for a reading of mode 0."""
        assert self.link is not None
        self.probed = True
        last = time.monotonic()
        for step in UNKNOWN.steps:
            await self.listen(last + step.after_s - time.monotonic())
            if self.trouble is not None:
                return
            data, last = encode(step.frame), time.monotonic()
            self._decoder.sent(data, last)
            try:
                await self.link.write(data)
            except LinkError as error:
                self.trouble = str(error)
                return
        self.answered = False
        await self.listen(STOP_REPORT_TIMEOUT_S, until_answered=True)

    def end(self) -> None:
        """Take in what was held back."""
        self._count(self._decoder.end())

    @property
    def verdict(self) -> LinkVerdict:
        """What it is, so far."""
        if self.link is None:
            return LinkVerdict.BUSY if self.busy else LinkVerdict.FAILED
        if self.tally.readings:
            return LinkVerdict.CAR
        if self.trouble is not None:
            return LinkVerdict.FAILED
        return LinkVerdict.OTHER if self.tally.bytes else LinkVerdict.SILENT

    def _count(self, events: Sequence[Event]) -> None:
        for event in events:
            self.tally.count(event, self._profile)
            if isinstance(event, Sensors) and event.candidates == (Mode.MANUAL,):
                self.answered = True

"""Feeds the plots of the pages with every reading, at full rate, only while a page shows them."""

import asyncio
import json
import logging
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Final

from fleet.aio import Fleet
from fleet.console.bus_message import message_in
from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage
from fleet.console.plot_buffer import PlotBuffer, series_of
from schemas import keys, topics
from schemas.bus import BusError, Sample

_MAX_PLOT_SAMPLES: Final = 16_384
# A gateway lets only a few questions wait, and answers `busy` to any further one. Pages must not take all these places.
MAX_HISTORY_QUESTIONS: Final = 2
"""Maximum number of queries for history at a time, of all pages. Each page has at most one."""
MAX_PLOT_S: Final = 600
"""Maximum time that a plot shows, s."""

log = logging.getLogger("fleet")


class PlotFeed(PageFeed):
    """The plots of all pages."""

    def __init__(self, fleet: Fleet, spawn: Callable[[Coroutine[Any, Any, None]], object]) -> None:
        self._fleet = fleet
        self._spawn = spawn
        self._buffers: dict[int, PlotBuffer] = {}
        self._wanted: dict[int, tuple[PlotBuffer, float]] = {}
        """The newest plot of each page that still waits for its history, and how many seconds that history covers."""
        self._reading: set[int] = set()
        """The pages whose history is being read."""
        self._questions = asyncio.Semaphore(MAX_HISTORY_QUESTIONS)
        self._plotted: frozenset[str] = frozenset()
        """The keys of the bus that pages plot."""
        # Twenty cars send 500 samples a second. Waking the loop for each sample would cost more than decoding it.
        self._samples: deque[Sample] = deque(maxlen=_MAX_PLOT_SAMPLES)

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The message that plots some series on a page."""
        return {"plot": self._begin}

    def _begin(self, page: PageLink, message: PageMessage) -> None:
        """Plot these series on a page instead of the series before, and read their history from the gateways."""
        since_s = float(min(message.number("since_s"), MAX_PLOT_S))
        buffer = self._buffers[page.number] = PlotBuffer(series_of(message))
        self._note_plotted()
        self._wanted[page.number] = buffer, since_s
        self._spawn(self._read_histories(page.number))

    async def _read_histories(self, page: int) -> None:
        """Read the history for the newest plot of a page.

        If a history is being read for this page, do so afterwards.
        """
        if page in self._reading:
            return
        self._reading.add(page)
        try:
            while (wanted := self._wanted.pop(page, None)) is not None:
                await self._read_history(page, *wanted)
        finally:
            self._reading.discard(page)

    async def _read_history(self, page: int, buffer: PlotBuffer, since_s: float) -> None:
        for car, topic in buffer.keys:
            if topics.TOPICS[topic].history_size <= 1:
                continue
            async with self._questions:
                if self._buffers.get(page) is not buffer:  # the page has gone, or plots something else now
                    return
                try:
                    past = await self._fleet.history(f"{car}/{topic}", since_s=since_s)
                except (BusError, ValueError) as error:
                    log.warning("no history of %s/%s: %s", car, topic, error)
                    continue
            for reading in past:
                buffer.add(car, topic, reading.value)

    def end(self, page: int) -> None:
        """Stop plotting on a page."""
        self._wanted.pop(page, None)
        if self._buffers.pop(page, None) is not None:
            self._note_plotted()

    def on_sample(self, sample: Sample) -> None:
        """Note a sample if a page plots it. Runs on a Zenoh thread."""
        if sample.key in self._plotted:
            self._samples.append(sample)

    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """Give the samples since the last tick to the pages that plot them.

        A page whose last values still wait gets the new ones together with them.
        """
        for _ in range(len(self._samples)):
            if (found := message_in(self._samples.popleft())) is not None:
                key, message = found
                for buffer in self._buffers.values():
                    buffer.add(key.car, key.topic, message)

        for number, page in pages.items():
            wanted = self._buffers.get(number)
            if wanted is not None and not page.has_unsent("samples") and (values := wanted.take()):
                page.show("samples", json.dumps({"t": "samples", "values": values}, separators=(",", ":")))

    def _note_plotted(self) -> None:
        name = self._fleet.sync.name
        self._plotted = frozenset(
            keys.topic_key(name, car, topic) for buffer in self._buffers.values() for car, topic in buffer.keys
        )

"""Feeds the plots of the pages with every reading, at full rate, only while a page shows them."""

import json
import logging
from collections import deque
from collections.abc import Coroutine, Sequence
from typing import Any, Final

from fleet.aio import Fleet
from fleet.console.bus_message import message_in
from fleet.console.page_link import PageLink
from fleet.console.plot_buffer import PlotBuffer, Series
from schemas import keys, topics
from schemas.bus import BusError, Sample

_MAX_PLOT_SAMPLES: Final = 16_384

log = logging.getLogger("fleet")


class PlotFeed:
    """Which page plots what."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._buffers: dict[int, PlotBuffer] = {}
        self._plotted: frozenset[str] = frozenset()
        """The keys of the bus that pages plot."""
        # Twenty cars send 500 samples a second. To wake the loop for each would cost more than to decode it.
        self._samples: deque[Sample] = deque(maxlen=_MAX_PLOT_SAMPLES)

    def begin(self, page: int, series: Sequence[Series], since_s: float) -> Coroutine[Any, Any, None]:
        """Plot these series on a page instead of those before. Return what reads the gateways' history."""
        self._buffers[page] = PlotBuffer(series)
        self._note_plotted()
        return self._read_history(page, self._buffers[page], since_s)

    async def _read_history(self, page: int, buffer: PlotBuffer, since_s: float) -> None:
        for car, topic in buffer.keys:
            if self._buffers.get(page) is not buffer:  # it has gone, or plots something else
                return
            if topics.TOPICS[topic].history_size > 1:
                try:
                    past = await self._fleet.history(f"{car}/{topic}", since_s=since_s)
                except (BusError, ValueError) as error:
                    log.warning("no history of %s/%s: %s", car, topic, error)
                    continue
                for reading in past:
                    buffer.add(car, topic, reading.value)

    def end(self, page: int) -> None:
        """Plot nothing on a page."""
        if self._buffers.pop(page, None) is not None:
            self._note_plotted()

    def on_sample(self, sample: Sample) -> None:
        """Note a sample if a page plots it. Runs on a Zenoh thread."""
        if sample.key in self._plotted:
            self._samples.append(sample)

    def take_samples(self) -> None:
        """Give the samples since the last call to the pages that plot them."""
        for _ in range(len(self._samples)):
            if (found := message_in(self._samples.popleft())) is not None:
                key, message = found
                for buffer in self._buffers.values():
                    buffer.add(key.car, key.topic, message)

    def send(self, page: PageLink) -> None:
        """Send the new values to a page, unless the last ones still wait: then they go together."""
        buffer = self._buffers.get(page.number)
        if buffer is not None and not page.has_unsent("samples") and (values := buffer.take()):
            page.show("samples", json.dumps({"t": "samples", "values": values}, separators=(",", ":")))

    def _note_plotted(self) -> None:
        name = self._fleet.sync.name
        self._plotted = frozenset(
            keys.topic_key(name, car, topic) for buffer in self._buffers.values() for car, topic in buffer.keys
        )

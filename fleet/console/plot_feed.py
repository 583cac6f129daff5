"""Feeds the plots of the pages with every reading, at full rate, only while a page shows them."""

import asyncio
import json
import logging
from collections.abc import Sequence
from typing import Any, Final

from fleet.aio import Fleet
from fleet.console.bus_message import message_in
from fleet.console.page_link import PageLink
from fleet.console.plot_buffer import PlotBuffer, Series
from schemas import keys, topics
from schemas.bus import BusError, Handover, Sample

_MAX_PLOT_SAMPLES: Final = 16_384

log = logging.getLogger("fleet")


class PlotFeed:
    """Which page plots what."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._buffers: dict[int, PlotBuffer] = {}
        self._subscriptions: dict[tuple[str, str], Any] = {}

    async def begin(self, page: int, series: Sequence[Series], since_s: float) -> None:
        """Plot these series on a page instead of those before. The gateways' history comes first."""
        buffer = self._buffers[page] = PlotBuffer(series)
        for car, topic in buffer.keys:
            if (car, topic) not in self._subscriptions:
                samples = Handover[Sample](
                    asyncio.get_running_loop(), self._on_sample, limit=_MAX_PLOT_SAMPLES, newest=True
                )
                key = keys.topic_key(self._fleet.sync.name, car, topic)
                self._subscriptions[(car, topic)] = self._fleet.sync.bus.subscribe(key, samples)
        self._forget()
        for car, topic in buffer.keys:
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
            self._forget()

    def send(self, page: PageLink) -> None:
        """Send the new values to a page, unless the last ones still wait: then they go together."""
        buffer = self._buffers.get(page.number)
        if buffer is not None and not page.has_unsent("samples") and (values := buffer.take()):
            page.show("samples", json.dumps({"t": "samples", "values": values}, separators=(",", ":")))

    def _forget(self) -> None:
        used = {key for buffer in self._buffers.values() for key in buffer.keys}
        for key in set(self._subscriptions) - used:
            self._subscriptions.pop(key).undeclare()

    def _on_sample(self, sample: Sample) -> None:
        if (found := message_in(sample)) is not None:
            key, message = found
            for buffer in self._buffers.values():
                buffer.add(key.car, key.topic, message)

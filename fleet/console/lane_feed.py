"""Feeds the time line, and the bands of the plots, with what the cars have done since the console started.

A lane is one row of the time line.
"""

import json
import time
from collections.abc import Container, Mapping
from typing import Any, Final

from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage
from fleet.recording.tools.lanes import HELD_NS, LANE_TOPICS, Lanes
from schemas.keys import Key

LIVE_LANES_NS: Final = 900 * 1_000_000_000
"""How far back the live lanes go. A plot shows ten minutes. Five more are kept for a plot that is paused."""
TICKS_BETWEEN_LANES: Final = 10
"""Number of ticks from one message with lanes to the next: one second. That is enough, as nobody drives by them."""


class LaneFeed(PageFeed):
    """The live lanes, and the pages that show them."""

    def __init__(self) -> None:
        self._lanes = Lanes()
        self._pages: set[int] = set()
        self._ticks = 0

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The messages that show the lanes on a page, and hide them."""
        return {"lanes": self._begin, "lanes_end": lambda page, _: self._pages.discard(page.number)}

    def on_message(self, key: Key, message: Any) -> None:
        """Handle a message of a car."""
        if key.topic in LANE_TOPICS:
            self._lanes.add(key.car, key.topic, message, time.time_ns())

    def keep(self, cars: Container[str]) -> None:
        """Forget all cars but these, because anybody on the bus may invent cars."""
        self._lanes.keep(cars)

    def _begin(self, page: PageLink, _: PageMessage) -> None:
        self._pages.add(page.number)
        self._show(page, LIVE_LANES_NS)

    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """Show what has changed since the last time.

        If a page has not read the last message, the next one repeats it.
        """
        self._ticks += 1
        if self._ticks % TICKS_BETWEEN_LANES:
            return
        for number in self._pages & set(pages):
            # The last message may have been replaced before the page read it, so each message also covers the time
            # before.
            self._show(pages[number], 2 * HELD_NS)

    def end(self, page: int) -> None:
        """Forget a page."""
        self._pages.discard(page)

    def _show(self, page: PageLink, back_ns: int) -> None:
        now = time.time_ns()
        if page.has_unsent("lanes"):
            # This message replaces one that the page did not get. It may have been the first, which covers everything.
            back_ns = LIVE_LANES_NS
        spans = [span.as_list() for span in (*self._lanes.since(now - back_ns), *self._lanes.silences(now))]
        page.show("lanes", json.dumps({"t": "lanes", "spans": spans}, separators=(",", ":")))

"""Feeds the map with the places of the cars, five times a second.

While no page shows the map, only the trails (the recent paths of the cars) are kept.
"""

import json
import time
from collections.abc import Callable, Container, Mapping
from typing import Any, Final

from fleet.console.bus_message import message_in
from fleet.console.map_view import PLACE_TOPICS, MapView
from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage
from schemas.bus import Latest, Sample
from schemas.keys import SIMULATOR, Key

TICKS_BETWEEN_MAPS: Final = 2
"""Of ten ticks a second, each second one: five maps a second look like motion, and nobody steers by the map."""
_MAX_MAP_KEYS: Final = 1024


class MapFeed(PageFeed):
    """The live map, and the pages that show it. `may_show` returns True if pages may be told of a car."""

    def __init__(self, may_show: Callable[[str], bool]) -> None:
        self._view = MapView()
        self._may_show = may_show
        self._samples: Latest[Sample] = Latest(_MAX_MAP_KEYS)
        self._pages: dict[int, float] = {}
        """For each page: the time up to which it has the trails."""
        self._world = ""
        self._ticks = 0

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The messages with which a page shows the map, and hides it, with their handlers."""
        return {"map": self._begin, "map_end": lambda page, _: self.end(page.number)}

    def on_sample(self, sample: Sample) -> None:
        """Keep a message of a simulator, or of one of its cars, until the next map. Runs on a Zenoh thread."""
        self._samples(sample.key, sample)

    def on_message(self, key: Key, message: Any) -> None:
        """Handle a reading of a car."""
        if key.topic in PLACE_TOPICS:
            self._view.on_message(key.car, key.topic, message, time.time())

    def keep(self, cars: Container[str]) -> None:
        """Forget all cars but these."""
        self._view.keep(cars)

    def _begin(self, page: PageLink, _: PageMessage) -> None:
        self._pages[page.number] = 0.0
        if self._world:
            page.show("world", self._world)
        self._show(page, time.time())

    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """At each second tick, handle the messages that have come, and send the map to the pages that show it."""
        self._ticks += 1
        if self._ticks % TICKS_BETWEEN_MAPS:
            return
        now = time.time()
        for sample in self._samples.take().values():
            if (found := message_in(sample)) is not None:
                key, message = found
                if key.car == SIMULATOR:
                    self._view.on_message("", f"{key.car}/{key.topic}", message, now)
                elif self._may_show(key.car):
                    self._view.on_message(key.car, key.topic, message, now)
        looking = [pages[number] for number in self._pages if number in pages]
        if not looking:
            return
        world = json.dumps({"t": "world", "world": self._view.world(now)}, separators=(",", ":"))
        for page in looking:
            if world != self._world:
                page.show("world", world)
            self._show(page, now)
        self._world = world

    def end(self, page: int) -> None:
        """Forget a page, by its number."""
        self._pages.pop(page, None)

    def _show(self, page: PageLink, now: float) -> None:
        # If the last map has not been sent to the page yet, this one replaces it. Its points would be lost, so send all
        # points again.
        since = 0.0 if page.has_unsent("map") else self._pages[page.number]
        trails = self._view.trails(now, since)
        self._pages[page.number] = now
        shown = {"t": "map", "whole": since == 0.0, "cars": self._view.places(now), "trails": trails}
        page.show("map", json.dumps(shown, separators=(",", ":")))

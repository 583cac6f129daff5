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
"""Five maps a second are enough: they look like motion, and nobody drives by them."""
_MAX_MAP_KEYS: Final = 1024


class MapFeed(PageFeed):
    """The live map, and the pages that show it. `has_place` returns True if a page may be told of a car."""

    def __init__(self, has_place: Callable[[str], bool]) -> None:
        self._view = MapView()
        self._has_place = has_place
        self._samples: Latest[Sample] = Latest(_MAX_MAP_KEYS)
        self._pages: dict[int, float] = {}
        """The time up to which each page has the trails, by page."""
        self._world = ""
        self._ticks = 0

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The messages that show the map on a page, and hide it."""
        return {"map": self._begin, "map_end": lambda page, _: self.end(page.number)}

    def on_sample(self, sample: Sample) -> None:
        """Note a message of a simulator. Runs on a Zenoh thread."""
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
        """Handle the messages that have come, and show them on the pages with a map."""
        self._ticks += 1
        if self._ticks % TICKS_BETWEEN_MAPS:
            return
        now = time.time()
        for sample in self._samples.take().values():
            if (found := message_in(sample)) is not None:
                key, message = found
                if key.car == SIMULATOR:
                    self._view.on_message("", f"{key.car}/{key.topic}", message, now)
                elif self._has_place(key.car):
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
        """Forget a page."""
        self._pages.pop(page, None)

    def _show(self, page: PageLink, now: float) -> None:
        # This message replaces one that the page has not read yet. The points in that one would be lost, so send all
        # points again.
        since = 0.0 if page.has_unsent("map") else self._pages[page.number]
        trails = self._view.trails(now, since)
        self._pages[page.number] = now
        shown = {"t": "map", "whole": since == 0.0, "cars": self._view.places(now), "trails": trails}
        page.show("map", json.dumps(shown, separators=(",", ":")))

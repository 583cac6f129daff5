"""The cars that pages inspect. Their raw frames are subscribed to only while a page shows them."""

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from fleet.aio import Fleet
from fleet.console.bus_message import message_in
from fleet.console.car_view import CarView
from fleet.console.frame_log import FrameLog
from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage
from schemas import keys
from schemas.bus import Handover, Sample

_MAX_QUEUED_FRAMES = 1024


class Inspections(PageFeed):
    """Which page inspects which car."""

    def __init__(self, fleet: Fleet, view_of: Callable[[str], CarView]) -> None:
        self._fleet = fleet
        self._view_of = view_of
        self._cars: dict[int, str] = {}
        self._logs: dict[str, FrameLog] = {}
        self._subscriptions: dict[str, Any] = {}

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The messages that begin and end the inspection of a car."""
        return {"inspect": self._begin, "inspect_end": lambda page, _: self.end(page.number)}

    def _begin(self, page: PageLink, message: PageMessage) -> None:
        """Show this car on a page, instead of the car that it showed before."""
        car = self._cars[page.number] = message.cars()[0]
        if car not in self._logs:
            self._logs[car] = FrameLog()
            frames = Handover[Sample](asyncio.get_running_loop(), self._on_frame, limit=_MAX_QUEUED_FRAMES, newest=True)
            bus, name = self._fleet.sync.bus, self._fleet.sync.name
            self._subscriptions[car] = bus.subscribe(keys.topic_key(name, car, "frame/*"), frames)
        self._forget()

    def end(self, page: int) -> None:
        """Stop showing a car on this page."""
        if self._cars.pop(page, None) is not None:
            self._forget()

    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """Show on each page the car that it inspects."""
        by_car = {car: self._text(car) for car in self._logs}
        for page, car in self._cars.items():
            pages[page].show("inspection", by_car[car])

    def _text(self, car: str) -> str:
        view = self._view_of(car)
        shown = {
            "t": "inspection",
            "car": car,
            "frames": self._logs[car].as_list(),
            "ledger": list(reversed(view.ledger)),
            "commands": view.commands.as_list(),
            "doctor": view.diagnose(time.monotonic()),
            "gateway": view.describe_gateway(),
        }
        return json.dumps(shown, separators=(",", ":"))

    def _forget(self) -> None:
        for car in set(self._logs) - set(self._cars.values()):
            self._subscriptions.pop(car).undeclare()
            del self._logs[car]

    def _on_frame(self, sample: Sample) -> None:
        if (found := message_in(sample)) is not None and found[0].car in self._logs:
            key, frame = found
            self._logs[key.car].on_frame(key.topic, frame)
            if key.topic == "frame/tx":
                self._view_of(key.car).commands.on_frame(frame)

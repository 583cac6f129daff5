"""The console's state: pages, presses, and the views of the cars. It wires the pure parts to the bus and the pages.

A press is a motion that a person holds down at a page.
"""

import asyncio
import json
import logging
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from msgspec import to_builtins

from fleet.aio import Fleet
from fleet.client.client import default_sender
from fleet.client.command_tracker import PendingCommand
from fleet.client.commands import CommandRequest, estop_request, pause_request, plain_request, stop_request
from fleet.client.lease import LEASE_RENEWAL_INTERVAL_S
from fleet.client.supervision import SUPERVISOR_STATUS, ask_status_briefly, colors_of, groups_of
from fleet.console.budgets import MAX_OPEN_COMMANDS, Budgets, StopMerge
from fleet.console.bus_message import is_shown, message_in
from fleet.console.car_view import MAX_OTHER_CARS, FleetView
from fleet.console.connection_limit import LogLimit
from fleet.console.hold_to_drive import TICK_INTERVAL_S, TOO_LATE, HeldPress, PressBook, PressRefused
from fleet.console.inspect_feed import Inspections
from fleet.console.lane_feed import LaneFeed
from fleet.console.map_feed import MapFeed
from fleet.console.operator import ConsoleOperator
from fleet.console.operators import Operators
from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import BadPageMessage, PageMessage
from fleet.console.past_api import PastApi
from fleet.console.people_book import MAX_GUESTS, PagePerson
from fleet.console.plan_feed import PlanFeed
from fleet.console.plot_buffer import plottable
from fleet.console.plot_feed import PlotFeed
from fleet.console.rights_in_words import GUEST_REFUSAL, guest_rights, management_refusal, rights_of
from fleet.console.sessions_api import SessionsApi
from fleet.console.setup_api import SetupApi
from fleet.console.stop_report import StopReport
from schemas.bus import Handover, Latest, Sample
from schemas.colors import Rgb, car_color, hex_color
from schemas.commands import STOPS, Verb
from schemas.keys import SIMULATOR, person_of, replay_token, topic_key
from schemas.process.computer_sleep import SleepWatch, clock_pair
from schemas.rights import People
from schemas.topics import TOPICS
from schemas.words import MODE_TEXTS, Phase, Rank, Reason, Scope

MAX_PAGES: Final = 96
"""Maximum number of connected pages."""
MAX_PAGES_OF_DEVICE: Final = 8
"""Maximum number of connected pages of one device on the network."""
MAX_PAGES_OF_GUEST: Final = 2
"""Maximum number of connected pages of one guest. All guests together may have MAX_GUESTS pages, so that some
places are left for persons."""
KEPT_FOR_LEADS: Final = 8
KEPT_FOR_THIS_COMPUTER: Final = 8
"""Number of pages that are reserved for leads and for this computer."""
STOP_ANSWER_TIMEOUT_S: Final = 1.0
"""Timeout for the first answer to a STOP by POST. With fifty gateways on two busy cores, the last takes 0.11 s."""
_MAX_EVENTS: Final = 4096
_MAX_LISTS: Final = 16
"""Number of `fleet up` whose cars are remembered."""
_MAX_MERGES: Final = 256
"""Maximum number of remembered merges of stops, by sender and verb."""
_MAX_STOP_IDS: Final = 256
"""Number of remembered ids of STOPs. Each STOP arrives twice: over the socket and by fetch."""

GUEST_MESSAGES: Final = frozenset(
    {"echo", "ping", Verb.STOP, "plot", "lanes", "lanes_end", "map", "map_end", "inspect", "inspect_end"}
)
"""Messages that a page of a guest may send, besides stops of some cars. A guest only watches."""

OnOutcomes = Callable[[list[dict[str, Any]]], object]
_BUS_LOST: Final = "The console has lost the bus. Press again when it is back."

log = logging.getLogger("fleet")


class TooManyPages(Exception):
    """No more pages may connect. The text says why."""


class Console:
    """Everything that the pages share. All methods run on the loop."""

    def __init__(self, fleet: Fleet, place: Path, file: Path, sleep: SleepWatch | None = None) -> None:
        self._fleet = fleet
        self._sleep = sleep or SleepWatch(clock_pair())
        self.sessions = SessionsApi(fleet, place, self.management_refusal)
        self.setup = SetupApi(fleet, file)
        self.past = PastApi(place, self._shown_colors)
        self._presses = PressBook()
        self._view = FleetView(self._color_of)
        self._colors: Mapping[str, Rgb] = {}
        """The colors of the cars in the running fleet. `fleet reload` may change them."""
        self.groups: Mapping[str, Sequence[str]] = {}
        """The cars of each group in the running fleet."""
        self._lists: dict[str, frozenset[str]] = {}
        """The cars that each `fleet up` has listed last, by its boot id. A fleet may have one on each computer."""
        self._unrecorded = ""
        """Why not everything is recorded, in the words of the running fleet."""
        self._replays: set[str] = set()
        """The tokens of replays in this fleet."""
        self._said_left_out = False
        self._operators = Operators(fleet)
        self._report: StopReport | None = None
        """The course of the last STOP."""
        self._newest_stop: PendingCommand | None = None
        self.budgets = Budgets()
        self._merges: dict[tuple[str, ...], StopMerge] = {}
        self._waiting_stops: dict[tuple[str, str], list[tuple[tuple[str, ...], OnOutcomes]]] = {}
        """Stops of some cars that wait to be merged, by sender and verb. Each has its cars, and the function that gets
        its answer."""
        self._bad_messages = LogLimit()
        self._stop_ids: dict[str, None] = {}
        self._stops = 0
        self._pages: dict[int, PageLink] = {}
        self._last_page = 0
        self._readings: Latest[Sample] = Latest()
        self.plan = PlanFeed(
            fleet, file, self.operator, self.sender_of, self.management_refusal, self._newest_samples, self._is_late
        )
        self._plots = PlotFeed(fleet, self.operator.spawn)
        self._lanes = LaneFeed()
        self._map = MapFeed(self._view.may_show)
        inspections = Inspections(fleet, self._view.look_up)
        self._feeds: Sequence[PageFeed] = (self._plots, self._lanes, self._map, inspections, self.plan)
        self._statuses: Handover[Sample] = Handover(
            asyncio.get_running_loop(), self._on_status, limit=_MAX_EVENTS, newest=True
        )
        self._events: Handover[Sample] = Handover(
            asyncio.get_running_loop(), self._on_event, limit=_MAX_EVENTS, newest=True
        )
        self._handlers: dict[str, Handler] = {
            "echo": self._on_echo,
            "press": self._on_press,
            "release": self._on_release,
            # A page sends it to measure how long its messages take.
            "ping": lambda page, message: page.answer(t="pong", id=message.number("id")),
            Verb.STOP: lambda page, message: self.stop_all(message.text_if_valid("id"), page.operator),
            Verb.ESTOP: self._on_estop,
            Verb.PAUSE: self._on_pause,
            Verb.UNPAUSE: self._on_unpause,
            "take": self._on_take,
            "give_back": self._on_give_back,
            "do": self._on_command,
        }
        for feed in self._feeds:
            self._handlers |= feed.messages

    # ------------------------------------------------------------------ the bus

    async def run(self) -> None:
        """Serve the pages until the task is cancelled."""
        bus, name = self._fleet.sync.bus, self._fleet.sync.name
        # Do this before any message comes, because a car keeps its first color.
        for status in await self._fleet.call(ask_status_briefly, bus, name):
            self._take_fleet(status)
        for family in ("sensor", "state"):
            bus.subscribe(f"{name}/*/{family}/*", self._on_reading)
        bus.subscribe(f"{name}/*/event/*", self._events)
        for place in ("*/sim/truth", f"{SIMULATOR}/world"):
            bus.subscribe(f"{name}/{place}", self._map.on_sample)
        bus.subscribe(f"{name}/{SUPERVISOR_STATUS.name}", self._statuses)
        await self._fleet.call(bus.watch_tokens, replay_token(name), self._on_replay)
        await self.plan.begin()
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._tick())
            tasks.create_task(self._renew_leases())

    def _on_replay(self, token: str, alive: bool) -> None:  # noqa: FBT001 - as `Bus.watch_tokens` calls it
        """Note a replay that began or ended. Runs on a Zenoh thread."""
        if alive:
            self._replays.add(token)
        else:
            self._replays.discard(token)

    def _color_of(self, car: str, index: int) -> str:
        return hex_color(self._colors.get(car) or car_color(car, index))

    def _shown_colors(self) -> dict[str, str]:
        """Return the color of each car, as the pages show it."""
        listed = {name: hex_color(color) for name, color in self._colors.items()}
        return listed | {name: self._view.look_up(name).color for name in self._view.names}

    def _on_status(self, sample: Sample) -> None:
        if (found := message_in(sample, logging.WARNING)) is None:
            return
        self._unrecorded = found[1].unrecorded
        self._take_fleet(found[1])

    def _take_fleet(self, status: Any) -> None:
        """Note the cars with their colors, and the groups, that a fleet.v1.Supervision lists."""
        self.groups = groups_of(status)
        if colors := colors_of(status):
            self._colors = colors
            removed = self._lists.pop(status.boot_id, frozenset()) - colors.keys()
            self._lists[status.boot_id] = frozenset(colors)
            while len(self._lists) > _MAX_LISTS:
                del self._lists[next(iter(self._lists))]
            self._view.list_cars(colors, removed)
            self._view.update_colors()

    async def _renew_leases(self) -> None:
        while True:
            await asyncio.sleep(LEASE_RENEWAL_INTERVAL_S)
            for operator in self._operators:
                operator.renew_leases()

    def _on_reading(self, sample: Sample) -> None:
        """Note a reading. Runs on a Zenoh thread."""
        self._readings(sample.key, sample)
        self._plots.on_sample(sample)

    def _newest_samples(self) -> Iterator[tuple[float, Sample]]:
        """Yield the newest samples of the cars from the bus, each after its age in s."""
        name = self._fleet.sync.name
        for car, topic, age_s, message in self._view.newest(time.monotonic()):
            encoding = TOPICS[topic].encoding
            yield age_s, Sample(topic_key(name, car, topic), message.SerializeToString(), encoding, 0, 0)

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        next_at = loop.time()
        while True:
            now = time.monotonic()
            self._end_presses_of_sleep()
            if not self._fleet.sync.bus.connected:  # a press still held must not drive when the bus is back
                for press in self._presses.on_bus_lost():
                    self._end(press, _BUS_LOST)
            for press in self._presses.expire(now):
                self._end(press, "The page did not answer for 0.3 s.")
            tick = f'{{"t":"tick","n":{self._presses.tick(now)}}}'
            for page in self._pages.values():
                page.show("tick", tick)
            self._take_readings(now)
            if self._pages:
                self._show("state", self._state(now))
                self._show_rights()
            for feed in self._feeds:
                feed.tick(self._pages)
            next_at = max(next_at + TICK_INTERVAL_S, loop.time())
            await asyncio.sleep(next_at - loop.time())

    def _end_presses_of_sleep(self) -> None:
        """End every press if this computer slept. Its clock stood still during the sleep, so no echo looks late."""
        if self._sleep.take() > 0:
            for press in self._presses.on_sleep():
                self._end(press, "The computer of the console slept.")

    def _show_rights(self) -> None:
        """Show each page what its person may not do, if that has changed. End presses that are no longer allowed."""
        authority = self._view.authority
        rights = {
            sender: rights_of(sender, authority) for sender in {page.operator.sender for page in self._pages.values()}
        }
        of_guests = guest_rights(authority)
        for page in self._pages.values():
            page.show_new("rights", of_guests if page.person.is_guest else rights[page.operator.sender])
            page.show_new("groups", {"groups": self.groups})
        for press in self._presses.alive:
            page = self._pages[press.client]
            refused = rights[page.operator.sender]["cars"]
            words = [refused.get(car, {}).get("move") for car in press.cars]
            if all(words) and self._presses.release(press.client, press.id):
                self._end(press, str(words[0]))

    def _show(self, kind: str, text: str) -> None:
        for page in self._pages.values():
            page.show(kind, text)

    def _take_readings(self, now: float) -> None:
        wall_ns = None if self._replays else time.time_ns()  # a replay does not show whether a clock is right
        for sample in self._readings.take().values():
            if (found := message_in(sample, logging.WARNING)) is not None:
                key, message = found
                self._view.on_message(key.car, key.topic, message, now, wall_ns)
                if self._view.may_show(key.car):
                    self._lanes.on_message(key, message)
                    self._map.on_message(key, message)
                if key.topic == "state/safety" and self._report is not None:
                    self._report.on_safety(key.car, message, now)
        present = self._present
        self._view.on_presence(present, now)
        names = frozenset(self._view.names)
        self._lanes.keep(names)
        self._map.keep(names)
        if self._view.left_out and not self._said_left_out:
            self._said_left_out = True
            log.warning(
                "the pages do not show %s and further cars: more than %d that the running fleet does not list are on "
                "the bus. Each of them is stopped by STOP",
                self._view.left_out, MAX_OTHER_CARS,
            )  # fmt: skip
        if self._report is not None:
            self._report.on_presence(present)

    def _state(self, now: float) -> str:
        report = self._report
        state = {
            "t": "state",
            "fleet": self._fleet.sync.name,
            "hub": self._fleet.sync.bus.connected,
            "pages": len(self._pages),
            "cars": self._view.as_list(now),
            "stop": None if report is None else report.as_dict(),
            "unrecorded": self._unrecorded,
            "at_ms": time.time_ns() // 1_000_000,
            "zone_s": time.localtime().tm_gmtoff,
        }
        return json.dumps(state, separators=(",", ":"))

    def _on_event(self, sample: Sample) -> None:
        if (found := message_in(sample, logging.WARNING)) is None:
            return
        (key, event), now = found, time.monotonic()
        self._view.on_message(key.car, key.topic, event, now)
        if self._view.may_show(key.car):
            self._lanes.on_message(key, event)
        if key.topic != "event/command":
            return
        if self._report is not None:
            self._report.on_event(key.car, event, now)
        if (event.verb, event.phase, event.reason) == (Verb.DRIVE, Phase.REJECTED, Reason.LAPSED):
            for press in self._presses.alive:
                page = self._pages[press.client]
                if event.sender == page.operator.sender and key.car in press.cars:
                    self._presses.release(press.client, press.id)
                    self._end(press, event.words)

    # ------------------------------------------------------------------ the pages

    @property
    def _present(self) -> list[str]:
        """The cars whose gateways are on the bus."""
        return [name for name in self._fleet.sync.cars() if is_shown(name)]

    @property
    def person(self) -> PagePerson:
        """The person of the pages on this computer."""
        return PagePerson(self._operators.person)

    @property
    def operator(self) -> ConsoleOperator:
        """The operator of the pages on this computer."""
        return self._operators.own

    def operator_of(self, person: PagePerson | None) -> ConsoleOperator:
        """Return the operator of a request. `person` is None if the request comes from this computer."""
        return self.operator if person is None else self._operators.of(person.name)

    def sender_of(self, person: PagePerson | None) -> str:
        """Return the name under which a request of this person acts, even if the person has no open page."""
        sender = self.operator_of(person).sender
        return sender if person is None or person_of(sender) == person.name else default_sender(person.name)

    @property
    def people(self) -> People | None:
        """The people of the fleet. None if no gateway has named them yet."""
        return self._view.people

    def management_refusal(self, person: PagePerson | None) -> str:
        """Return why this person may not start and stop the recorder and plans.

        A `person` of None means this computer.
        """
        return management_refusal(self._view.authority, (person or self.person).name)

    def _check_room(self, person: PagePerson | None, device: str) -> None:
        """Raise TooManyPages if this device may not connect another page."""
        most = MAX_PAGES
        if person is not None:
            most -= KEPT_FOR_THIS_COMPUTER + (0 if person.rank == Rank.LEAD else KEPT_FOR_LEADS)
        if len(self._pages) >= most:
            raise TooManyPages("too many pages are open")
        is_guest = person is not None and person.is_guest
        most_of_device = MAX_PAGES_OF_GUEST if is_guest else MAX_PAGES_OF_DEVICE
        if device and sum(page.device == device for page in self._pages.values()) >= most_of_device:
            raise TooManyPages(f"this device has {most_of_device} pages open: close one")
        if is_guest and sum(page.person.is_guest for page in self._pages.values()) >= MAX_GUESTS:
            raise TooManyPages("too many pages of guests are open")

    async def add_page(
        self, send: Callable[[str], Awaitable[None]], person: PagePerson | None = None, device: str = ""
    ) -> PageLink:
        """Add a page of a person, or of this computer if `person` is None. Raises TooManyPages and BusError.

        `device` is the id of the device on the network.
        """
        self._check_room(person, device)
        whose = person or self.person
        operator = await self._operators.join(whose.acts_as)
        try:
            self._check_room(person, device)  # other pages may have connected meanwhile
        except TooManyPages:
            self._operators.leave(whose.acts_as)
            raise
        self._last_page += 1
        page = self._pages[self._last_page] = PageLink(self._last_page, send, whose, operator, device)
        # All guests share one sender, so a stop with this sender may come from another guest.
        names = {"sender": None if whose.is_guest else operator.sender, "fleet": self._fleet.sync.name}
        words = {"plottable": plottable(), "modes": MODE_TEXTS}
        page.answer(t="hello", page=page.number, **names, person=to_builtins(page.person), **words)
        for feed in self._feeds:
            feed.on_page(page)
        return page

    def remove_page(self, page: PageLink) -> None:
        """Remove a page that has gone, and stop the cars that it drives."""
        if page.number not in self._pages:
            return
        for feed in self._feeds:
            feed.end(page.number)
        for press in self._presses.drop_client(page.number):
            self._end(press, "The page has gone.")
        self._count(page, page.operator.release_leases(page.number))
        del self._pages[page.number]
        self._operators.leave(page.person.acts_as)

    def on_text(self, page: PageLink, text: str) -> None:
        """Handle one message of a page. A bad message is answered, and changes nothing."""
        try:
            self._on_message(page, PageMessage.of(text))
        except BadPageMessage as error:
            shown = self._bad_messages.words(f"page {page.number} sent a bad message: {error}", time.monotonic())
            if shown is not None:
                log.warning("%s", shown)
            page.answer(t="bad", words=str(error))

    def stop_all(
        self, stop_id: str, operator: ConsoleOperator | None = None, request: CommandRequest | None = None
    ) -> None:
        """Stop every car.

        Calls with an id that was used before do nothing, because a page sends each STOP twice, over its socket and by
        fetch. Without an id, every call counts.

        operator: the operator of the page, or None for this computer. request: an e-stop, a pause, or None for a stop.
        """
        if stop_id in self._stop_ids:
            return
        if stop_id:
            self._stop_ids[stop_id] = None
        if len(self._stop_ids) > _MAX_STOP_IDS:
            del self._stop_ids[next(iter(self._stop_ids))]
        operator, request = operator or self.operator, request or stop_request()
        who = (request.sender or operator.sender, request.verb)
        self._merge_stop(who, partial(self._stop_all, operator, request))

    def _merge_stop(self, who: tuple[str, ...], stop: Callable[[], object]) -> None:
        """Stop at once. Further stops of the same kind within MERGE_S are sent as one stop at the end of that time."""
        if len(self._merges) >= _MAX_MERGES:
            del self._merges[next(iter(self._merges))]
        delay_s = self._merges.setdefault(who, StopMerge()).delay_s(time.monotonic())
        if delay_s == 0.0:
            stop()
        elif delay_s is not None:
            asyncio.get_running_loop().call_later(delay_s, stop)

    def _stop_all(self, operator: ConsoleOperator, request: CommandRequest) -> None:
        now = time.monotonic()
        for press in self._presses.on_stop(now):
            self._end(press, "All cars were paused." if request.verb == Verb.PAUSE else "All cars were stopped.")
        self._stops += 1
        self._view.on_presence(self._present, now)
        at_ms, sender = time.time_ns() // 1_000_000, request.sender or operator.sender
        self._report = StopReport(self._stops, request.verb, sender, self._view.names, now, at_ms)
        self._newest_stop = operator.stop(request, self._report, self._view.may_show)

    async def is_stop_taken(self) -> bool:
        """Wait until a gateway has answered the newest STOP of all cars. Return False if none answers in time.

        If a newer STOP comes while this one waits, wait for the newer one, which stops the same cars. If there is no
        car, do not wait.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(STOP_ANSWER_TIMEOUT_S):
                while (command := self._newest_stop) is not None:
                    taken = await asyncio.shield(asyncio.wrap_future(command.arrived))
                    if taken or command is self._newest_stop:
                        return taken
        return False

    def _stop_cars(self, operator: ConsoleOperator, request: CommandRequest, who: tuple[str, str]) -> None:
        """Send one stop for all cars whose stops wait.

        Answer each of the waiting stops with the outcomes of its own cars.
        """
        if not (waiting := self._waiting_stops.pop(who, [])):
            return  # `_merges` forgot a merge, so there were two calls: the first one has sent these stops

        def answer_all(outcomes: list[dict[str, Any]]) -> None:
            for cars, answer in waiting:
                answer([outcome for outcome in outcomes if outcome["car"] in cars])

        operator.command(request, sorted({car for cars, _ in waiting for car in cars}), answer_all)

    def _on_message(self, page: PageLink, message: PageMessage) -> None:
        now = time.monotonic()
        self._end_presses_of_sleep()
        if message.needs_budget:
            if message.kind != "give_back" and self._is_late(message):
                raise BadPageMessage(TOO_LATE)
            cars = () if message.kind == Verb.UNPAUSE else message.cars()
            if words := self._command_refusal(page, cars, now):
                raise BadPageMessage(words)
        stops_some = message.kind == "do" and message.fields.get("verb") == Verb.STOP
        if page.person.is_guest and not stops_some and message.kind not in GUEST_MESSAGES:
            raise BadPageMessage(GUEST_REFUSAL)
        handle = self._handlers.get(message.kind)
        if handle is None:
            raise BadPageMessage(f"unknown message {message.kind!r}")
        handle(page, message)

    def _on_echo(self, page: PageLink, message: PageMessage) -> None:
        now = time.monotonic()
        press = self._presses.echo(page.number, message.number("press"), message.number("n"), now)
        if press is not None:
            page.operator.renew_press(press, now)

    def _on_release(self, page: PageLink, message: PageMessage) -> None:
        released = self._presses.release(page.number, message.number("press"))
        if released is not None:
            page.operator.end_press(released)

    def _on_estop(self, page: PageLink, message: PageMessage) -> None:
        request = estop_request(message.reason, Scope.FLEET)
        self.stop_all(message.text_if_valid("id"), page.operator, request)

    def _on_pause(self, page: PageLink, message: PageMessage) -> None:
        if refused := rights_of(page.operator.sender, self._view.authority)["pause"]:
            raise BadPageMessage(refused)  # a refused pause stops no car, so it ends no press
        self.stop_all(message.text_if_valid("id"), page.operator, pause_request(message.reason))

    def _on_unpause(self, page: PageLink, message: PageMessage) -> None:
        answer = self._answer_to(page, message)
        self._count(page, page.operator.command(plain_request(Verb.UNPAUSE), None, answer))

    def _on_take(self, page: PageLink, message: PageMessage) -> None:
        self._count(page, page.operator.take_lease(page.number, message.cars(), self._answer_to(page, message)))

    def _on_give_back(self, page: PageLink, message: PageMessage) -> None:
        self._end_all(self._presses.drop_cars_of(set(message.cars()), page.person.name), "The car was given back.")
        self._count(page, page.operator.release_leases(page.number, message.cars(), self._answer_to(page, message)))

    def _on_command(self, page: PageLink, message: PageMessage) -> None:
        request = message.request()
        if request.verb in STOPS:
            cars, answer = message.stopped_cars(), self._answer_to_stop(page, message)
            self._end_all(self._presses.on_cars_stopped(set(cars)), "The car was stopped.")
            who = (page.operator.sender, request.verb)
            self._waiting_stops.setdefault(who, []).append((cars, answer))
            self._merge_stop(("cars", *who), partial(self._stop_cars, page.operator, request, who))
            return
        cars, answer = message.cars(), self._answer_to(page, message)
        if request.verb == Verb.MODE:
            theirs = self._presses.drop_cars_of(set(cars), page.person.name, self._view.people_of(cars))
            self._end_all(theirs, "The car is in a mode.")
        self._count(page, page.operator.command(request, cars, answer))

    def is_late(self, tick: int | None) -> bool:
        """Return True if a page pressed something so long ago that nobody expects its effect any more.

        A link that recovers delivers what was pressed while it hung. What names no tick has no age.
        """
        return tick is not None and self._presses.is_late(tick, time.monotonic())

    def _is_late(self, message: PageMessage) -> bool:
        return self.is_late(message.number("n") if "n" in message.fields else None)

    def _command_refusal(self, page: PageLink, cars: Sequence[str], now: float) -> str:
        """Count a command to these cars. Return why it must not be sent, or an empty text if it may be."""
        # A query for an unknown car would block a thread until its timeout.
        if unknown := set(cars).difference(self._view.names, self._present):
            return f"There is no car {min(unknown)}."
        if not self.budgets.may_open_command(page.device or None):
            return f"{MAX_OPEN_COMMANDS} commands have no result yet. Wait for them."
        if not self.budgets.may_command(page.device or None, now):
            return "Too many commands. Wait a few seconds."
        return ""

    def _count(self, page: PageLink, command: "asyncio.Task[None] | None") -> None:
        """Count a command of this page's device until it has an outcome. None means that nothing was sent."""
        if command is not None:
            device = page.device or None
            self.budgets.on_command_begun(device)
            command.add_done_callback(lambda _: self.budgets.on_command_ended(device))

    def _on_press(self, page: PageLink, message: PageMessage) -> None:
        now = time.monotonic()
        press_id, cars, motion = message.number("press"), message.cars(), message.motion()
        before, person = self._presses.current(page.number), page.person.name
        if not self._fleet.sync.bus.connected:
            page.answer(t="over", press=press_id, words=_BUS_LOST)
            return
        if words := self._command_refusal(page, cars, now):
            page.answer(t="over", press=press_id, words=words)
            return
        try:
            press, taken = self._presses.begin(
                page.number,
                press_id,
                cars,
                motion,
                message.number("n"),
                now,
                person=person,
                people=self._view.people_of(cars),
            )
        except PressRefused as error:
            page.answer(t="over", press=press_id, words=str(error))
            return
        for other in taken:  # the other page's stop would be refused for the cars that the lead drives from now on
            words = f"{person} drives {' and '.join(car for car in other.cars if car in cars)} now."
            self._end(other, words, [car for car in other.cars if car not in cars])
        if before is not None:  # another direction, so stop only the cars that are no longer driven
            page.operator.end_press(before, [car for car in before.cars if car not in cars])
        driving = page.operator.begin_press(
            press, lambda outcome: page.answer(t="refused", press=press_id, outcome=asdict(outcome))
        )
        self._count(page, driving)

    def _answer_to(self, page: PageLink, message: PageMessage) -> Callable[[list[dict[str, Any]]], None]:
        request_id = message.number("id")
        return lambda outcomes: page.answer(t="done", id=request_id, outcomes=outcomes)

    def _answer_to_stop(self, page: PageLink, message: PageMessage) -> Callable[[list[dict[str, Any]]], None]:
        try:
            return self._answer_to(page, message)
        except BadPageMessage:  # a page that has given no number waits for no answer
            return lambda _: None

    def _end_all(self, presses: Iterable[HeldPress], words: str) -> None:
        for press in presses:
            self._end(press, words)

    def _end(self, press: HeldPress, words: str, cars: Sequence[str] | None = None) -> None:
        """End a press: stop its cars, or all cars if `cars` is None, and tell its page why."""
        page = self._pages[press.client]
        page.operator.end_press(press, cars)
        page.answer(t="over", press=press.id, words=words)

    async def close(self) -> None:
        """Stop the cars that pages drive, and wait for their outcomes, for at most 3 s."""
        for press in self._presses.alive:
            self._pages[press.client].operator.end_press(press)
        await self._operators.close()
        await self.plan.close()
        await self.past.close()
        await self.sessions.close()

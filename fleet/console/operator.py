"""Sends the commands of one person's pages: drives while a button is held (a press), STOP, and single commands."""

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from dataclasses import asdict
from typing import Any, Final

from msgspec import Struct

from fleet.aio import Fleet
from fleet.client.command_tracker import PendingCommand
from fleet.client.commands import CommandRequest, drive_request, lease_request
from fleet.client.outcome import Outcome
from fleet.client.services import ask_coordinator
from fleet.console.hold_to_drive import HeldPress
from fleet.console.stop_report import StopReport
from schemas import keys, messages
from schemas.bus import Failure
from schemas.commands import COMMANDS, Verb
from schemas.words import Motion, Phase, Reason

# The gateway is the watchdog of our loop: if the loop blocks, the last drive expires there.
DRIVE_TTL_S: Final = 0.5
"""Duration of each drive of a press. If no further drive follows, the gateway stops the car."""
STREAM_INTERVAL_S: Final = 0.15
"""Minimum interval of the drives of one press."""
STREAM_MAX_AGE_S: Final = 0.3
"""Maximum age of a drive when it arrives at the gateway."""
log = logging.getLogger("fleet")


class _Take(Struct, eq=False):
    """Some cars that a page takes over. `wanted` are those that it has not given back meanwhile."""

    page: int
    wanted: set[str]


class ConsoleOperator:
    """The client of the bus under whose name the pages of one person act."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._tasks: set[asyncio.Task[None]] = set()
        self._streams: dict[tuple[int, int], tuple[float, int, tuple[str, ...]]] = {}
        """Time of the last drive, number of drives, and cars, by press."""
        self._leases: dict[str, int] = {}
        """The page that has taken each car over, by car."""
        self._takes: list[_Take] = []
        """The cars that pages are taking over, without an answer of a gateway yet."""
        self._stops: dict[tuple[str, str], PendingCommand] = {}
        """The newest stop of all cars that has no outcome yet, by sender and verb."""
        self._renewals: set[str] = set()
        """Cars whose lease is being renewed."""

    @property
    def sender(self) -> str:
        """The name of this operator on the bus."""
        return self._fleet.sync.sender

    # ------------------------------------------------------------------ driving

    def begin_press(self, press: HeldPress, on_refusal: Callable[[Outcome], object]) -> "asyncio.Task[None]":
        """Start the cars of a press. If a car refuses, this is reported, and the other cars drive.

        Return the task that waits for the outcomes of the start.
        """
        self._streams.pop((press.client, press.id), None)
        self.renew_press(press, time.monotonic())
        return self.spawn(self._ask_first_drive(press, on_refusal))

    def renew_press(self, press: HeldPress, now: float) -> None:
        """Send the next drive of a press, unless the last drive is recent."""
        sent_at, count, _ = self._streams.get((press.client, press.id), (float("-inf"), 0, ()))
        if now - sent_at < STREAM_INTERVAL_S:
            return
        self._streams[(press.client, press.id)] = now, count + 1, press.cars
        request = drive_request(press.motion, DRIVE_TTL_S)
        # Only the first drive of a press may start a car. So a press is over if the bus hangs for longer than a drive
        # lasts.
        request.message.continues = count > 0
        self._stream(press.cars, request, STREAM_MAX_AGE_S, count + 1)

    def end_press(self, press: HeldPress, cars: Iterable[str] | None = None) -> None:
        """Stop the cars of a press, or some of them.

        Send the stop twice: at once in the stream of the drives, and then as a query, which has an outcome.
        """
        stopped = tuple(press.cars if cars is None else cars)
        _, count, _ = self._streams.pop((press.client, press.id), (0.0, 0, ()))
        if stopped:
            self._stream(stopped, drive_request(Motion.STOP), None, count + 1)
            self.spawn(self._ask_to_end(stopped))

    def _stream(self, cars: Sequence[str], request: CommandRequest, ttl_s: float | None, sequence: int) -> None:
        message = request.message
        message.sender, message.kind = self._fleet.sync.sender, self._fleet.sync.kind
        message.asked.seconds, message.asked.nanos = divmod(time.time_ns(), 1_000_000_000)
        if ttl_s is not None:
            message.ttl_s = ttl_s
        payload = message.SerializeToString()
        encoding = messages.encoding_of(COMMANDS[Verb.DRIVE].message)
        fleet, bus = self._fleet.sync.name, self._fleet.sync.bus
        for car in cars:
            key = keys.command_key(fleet, car, Verb.DRIVE, bus.identity)
            bus.put_command(key, payload, encoding, sequence)

    async def _ask_first_drive(self, press: HeldPress, on_refusal: Callable[[Outcome], object]) -> None:
        # A gateway reports only the first rejection of a stream, but it always answers a query.
        outcomes = await self._fleet.ask(drive_request(press.motion, DRIVE_TTL_S, wait=False), press.cars)
        for outcome in outcomes:
            if not outcome.ok and outcome.reason != Reason.SUPERSEDED:
                on_refusal(outcome)
        if (press.client, press.id) not in self._streams:
            # The press has ended meanwhile. The end was sent in the stream, and our query may have overtaken it. So end
            # the drive again, but not for cars that a newer press drives.
            driven = {car for _, _, cars in self._streams.values() for car in cars}
            await self._ask_to_end([car for car in press.cars if car not in driven])

    async def _ask_to_end(self, cars: Sequence[str]) -> None:
        if cars:
            await self._fleet.ask(drive_request(Motion.STOP), cars)

    # ------------------------------------------------------------------ STOP

    def stop(self, request: CommandRequest, report: StopReport, is_shown: Callable[[str], bool]) -> PendingCommand:
        """Stop every car, and return the command. The report gets the outcomes of the cars that pages show."""
        command = self._fleet.sync.send(request)
        report.command_id = command.id
        self.spawn(self._report_stop(request, command, report, is_shown))
        return command

    async def _report_stop(
        self, request: CommandRequest, command: PendingCommand, report: StopReport, is_shown: Callable[[str], bool]
    ) -> None:
        # To wait for a stop blocks a thread until the slowest car stands. Ten stops a second would need 60 threads. So
        # wait only for a person's newest stop, which concerns the same cars as the earlier ones.
        who = (report.sender, request.verb)
        if (earlier := self._stops.get(who)) is not None:
            earlier.abandon()
        self._stops[who] = command
        try:
            outcomes = await self._fleet.call(self._fleet.sync.outcomes, command)
        finally:
            if self._stops.get(who) is command:
                del self._stops[who]
        shown = [each for each in outcomes if is_shown(each.car)]
        report.on_outcomes(shown, time.monotonic(), lost_bus=command.lost_bus)

    # ------------------------------------------------------------------ the rest

    def command(
        self, request: CommandRequest, cars: Sequence[str] | None, on_outcomes: Callable[[list[dict[str, Any]]], object]
    ) -> "asyncio.Task[None]":
        """Send a command to these cars (None: all), and report the outcomes. Return the task that waits for them."""
        return self.spawn(self._command(request, cars, on_outcomes))

    async def _command(
        self, request: CommandRequest, cars: Sequence[str] | None, on_outcomes: Callable[[list[dict[str, Any]]], object]
    ) -> None:
        outcomes = await self._fleet.ask(request, cars)
        on_outcomes([asdict(outcome) for outcome in outcomes])

    def take_lease(
        self, client: int, cars: Sequence[str], on_outcomes: Callable[[list[dict[str, Any]]], object]
    ) -> "asyncio.Task[None]":
        """Take cars over for a page, and renew their leases until the page gives them back or has gone.

        Return the task that waits for the outcomes.
        """
        take = _Take(client, set(cars))
        self._takes.append(take)

        def keep(outcomes: list[dict[str, Any]]) -> None:
            self._keep(take, {outcome["car"] for outcome in outcomes if outcome["ok"]})
            on_outcomes(outcomes)

        taking = self.command(lease_request(take=True), cars, keep)
        taking.add_done_callback(lambda _: self._takes.remove(take))
        return taking

    def _keep(self, take: _Take, taken: set[str]) -> None:
        """Keep the leases that a page still wants. Give the others back: without a page, nobody else would."""
        self._leases |= dict.fromkeys(taken & take.wanted, take.page)
        others = (each.wanted for each in self._takes if each is not take)
        if unwanted := sorted(taken - set(self._leases).union(*others)):
            self.command(lease_request(release=True), unwanted, lambda _: None)

    def release_leases(
        self,
        client: int,
        cars: Iterable[str] | None = None,
        on_outcomes: Callable[[list[dict[str, Any]]], object] = lambda _: None,
    ) -> "asyncio.Task[None] | None":
        """Give these cars back, or all cars that this page has taken if `cars` is None.

        Return the task that waits for the outcomes, or None if there are no such cars.
        """
        taken = [car for car, by in self._leases.items() if by == client]
        released = taken if cars is None else list(cars)
        for car in released:
            self._leases.pop(car, None)
        for take in self._takes:  # the gateways may answer when nobody waits any more
            if cars is not None:
                take.wanted.difference_update(released)
            elif take.page == client:
                take.wanted.clear()
        return self.command(lease_request(release=True), released, on_outcomes) if released else None

    def renew_leases(self) -> None:
        """Renew the leases of the pages. If another sender has taken a car over, its lease is lost."""
        for car in self._leases.keys() - self._renewals:
            self._renewals.add(car)
            self.spawn(self._renew_lease(car))

    async def _renew_lease(self, car: str) -> None:
        """Renew one lease. A gateway that hangs must not delay the other leases of a page, which would expire."""
        try:
            (outcome,) = await self._fleet.ask(lease_request(), [car])
            if not outcome.ok:
                self._leases.pop(car, None)
        finally:
            self._renewals.discard(car)

    async def ask_coordinator(self, verb: str, text: str = "", sender: str = "") -> tuple[bool, str] | None:
        """Send a request to the coordinator.

        Return True if it was carried out, and the words of the answer. Return None if no plan is running.
        text: the text of a plan to set.
        """
        answer = await self._fleet.call(ask_coordinator, self._fleet.sync, verb, text, sender)
        if answer is None:
            return None
        return not isinstance(answer, Failure) and answer.status == Phase.SENT, answer.words

    def spawn(self, work: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        """Run a coroutine as a task. Its errors are logged, and do not end the connection of a page."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_done)
        return task

    async def close(self) -> None:
        """Wait for the commands that have no outcome yet, for at most 3 s."""
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=3.0)

    def _on_done(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("a command of the console failed: %s", error)

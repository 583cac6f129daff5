"""The gateway of one car: joins link, decoder, control and bus in one asyncio loop. Read this file first.

Up: `LinkLoop` reads bytes from the link, and the driver decodes them into events. `CarPublisher` publishes the
measurements, and the driver updates its state. Down: the bus hands a query on `@cmd` over to the loop. `CommandHandler`
passes the command to control, and answers it after the writer has had a turn. `Writer` writes to the car, one frame at
a time.
"""

import asyncio
import contextlib
import gc
import logging
import random
import sys
import time
from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

import zenoh
from msgspec import Struct, field

from gateway import drivers
from gateway.bus.car_publisher import BUS_LOSS_GAP_S, CarPublisher
from gateway.bus.car_service import AlreadyServed, CarService
from gateway.bus.command_handler import CommandHandler
from gateway.bus.estop_sync import EstopSync
from gateway.bus.revocation_watch import RevocationWatch
from gateway.control.battery import BatteryPolicy
from gateway.control.controller import Controller
from gateway.control.driver import TICK_S
from gateway.control.safety_state import PersistedSafety
from gateway.learned_file import LearnedFile
from gateway.link import LinkError, LinkUrl
from gateway.link_loop import LinkLoop, at_rate
from gateway.safety_state_file import SafetyStateFile
from gateway.stop_without_hub import stop_alone
from gateway.writer import Writer
from gateway.writer_wakeup import WriterWakeup
from schemas import bus
from schemas.keys import car_token
from schemas.limits import DEFAULT_MAX_DRIVE_S, SHUTDOWN_S
from schemas.links import car_link
from schemas.process import json_log, signals
from schemas.process.computer_sleep import MONOTONIC_COUNTS_SLEEP, SleepWatch, clock_pair
from schemas.process.parent import has_ended
from schemas.process.service_notifier import ServiceNotifier
from schemas.rights import NO_PEOPLE, People
from schemas.running_cars import RunningMark
from schemas.words import Level, Shows

RIVAL_CHECK_DELAY_S: Final = 0.5
"""Delay of the second check for another gateway of the car. By then, both gateways must be declared on the bus
(docs/reference/keys.md#one-gateway-per-car)."""
RIVAL_SHUTDOWN_S: Final = SHUTDOWN_S + 2.0
"""Maximum time that the remaining gateway waits for the port. In this time, the gateway that has to end must notice the
conflict, stop the car and close the port."""
HEALTH_INTERVAL_S: Final = 1.0
LEARNED_INTERVAL_S: Final = 10.0
"""Minimum time between two saves of what was learned about the car, unless one must be saved at once."""
ANSWER_PAUSE_S: Final = 0.005
"""Pause after each slice of a long answer, so that Zenoh can send it. Zenoh drops what exceeds its buffer."""
CANCEL_RETRY_S: Final = 0.5
"""Time after which a cancelled task that still runs is cancelled again."""

log = logging.getLogger("gateway")


class Settings(Struct, frozen=True):
    """The settings of `gateway run`."""

    car: str
    url: LinkUrl
    platform: str
    """As in the fleet file, such as `arduino+arm`, or `auto` if the gateway has to find out."""
    fleet: str
    state_dir: Path
    retry: bool
    """True to try again if the first attempt to open the link fails."""
    battery: BatteryPolicy = field(default_factory=BatteryPolicy)
    speed_max: float = 1.0
    people: People = NO_PEOPLE
    longest_drive_s: float = DEFAULT_MAX_DRIVE_S
    parent: int | None = None
    """Process id of the parent; the gateway ends with it."""
    holds_of: str = ""
    """Name under which the holds and loans of the car are saved. Empty: they are saved under the link of the car."""


class CarGateway:
    """One car's gateway. `run` returns after `stop`, when the stop of the car is over or was given up."""

    def __init__(
        self, settings: Settings, opened: bus.Bus, service: CarService, sleep: SleepWatch | None = None
    ) -> None:
        self._settings = settings
        self._sleep = sleep or SleepWatch(clock_pair())
        self._bus = opened
        self._service = service
        self._loop = asyncio.get_running_loop()
        now = self._loop.time()
        holds_of = settings.holds_of or car_link(settings.url)
        state_file = SafetyStateFile(settings.state_dir, settings.fleet, settings.car, holds_of)
        self._learned_file = LearnedFile(
            settings.state_dir, settings.fleet, settings.car, link=car_link(settings.url), platform=settings.platform
        )
        self._control = Controller(
            settings.car,
            self._learned_file.load(partial(drivers.driver_of, settings.platform)),
            persisted=state_file.load(now_ns := time.time_ns()),
            battery_policy=settings.battery,
            speed_max=settings.speed_max,
            people=settings.people,
            now=now,
            now_ns=now_ns,
        )
        self._driver = self._control.driver
        self._state_damage, self._other_link_words = state_file.damage, state_file.other_link_words
        self._mark = RunningMark(settings.state_dir, settings.fleet, settings.car)
        self._mark.renew()
        self._estop_sync = EstopSync(opened, settings.fleet, settings.car)
        url = at_rate(settings.url, self._driver.model.profile.baud)
        self._revocation = RevocationWatch(opened, car_token(settings.fleet, settings.car))
        self._publisher = CarPublisher(opened, settings.fleet, settings.car, self._control, str(url))
        self._wake = WriterWakeup(self._control)
        self._commands = CommandHandler(
            settings.fleet,
            settings.car,
            self._control,
            self._publisher,
            self._estop_sync,
            save=state_file.save,
            longest_drive_s=settings.longest_drive_s,
            clock=self._loop.time,
            wake=self._wake.set,
            on_gap=self._on_gap,
        )
        self._link = LinkLoop(
            url,
            self._control,
            self._publisher,
            self._wake,
            log=self._commands.log,
            on_gap=self._on_gap,
            log_open=self._log_link_open,
        )
        self._notifier = ServiceNotifier()
        self._writer = Writer(
            self._driver,
            self._link,
            self._publisher,
            self._wake,
            on_gap=self._on_gap,
            on_urgent_change=partial(self._save_learned, at_once=True),
            notifier=self._notifier,
        )
        self._hub_lost = asyncio.Event()
        self._no_hub = ""
        """Why the last try to reach the hub failed, since the link to it was lost. Empty while there is one."""
        self._values_due, self._histories_due = asyncio.Event(), asyncio.Event()
        self._ending = False
        self._began_at = self._alive_at = now
        self._learned_due_at = now
        self._worst_lag_s = 0.0

    async def run(self) -> bool:
        """Serve the car until `stop`, then until its stop is over. Return False if the car could not be stopped.

        Raises AlreadyServed (see bus/car_service.py), and LinkError if the link cannot be opened at the start.
        """
        now = self._loop.time()
        self._publish_states(now)
        if self._state_damage:
            self._commands.log(Level.WARNING, "state_unreadable", self._state_damage)
        if self._other_link_words:
            self._commands.log(Level.WARNING, "other_link", self._other_link_words)
        self._service.attach(
            self._loop,
            values=self._values_due,
            histories=self._histories_due,
            command=self._commands.on_request,
            senders=self._on_sender_tokens,
            cars=self._estop_sync.on_tokens,
            poses=self._on_poses,
        )
        keeping = asyncio.ensure_future(
            self._link.keep_open(may_fail=self._settings.retry, is_in_use=self._is_port_in_use)
        )
        writing = asyncio.ensure_future(self._writer.run(self._flush))
        work = (
            self._tick(),
            self._keep_hub(),
            self._check_rival(),
            self._estop_sync.keep_synced(self._merge),
            *([self._revocation.run(self._on_revoked, self._on_certificate_end)] if self._bus.identity else []),
            self._answer(self._service.values),
            self._answer(self._service.histories),
        )
        tasks = [keeping, writing, *map(asyncio.ensure_future, work)]
        stopped = asyncio.ensure_future(self._writer.finished.wait())
        try:
            done, _ = await asyncio.wait([stopped, *tasks], return_when=asyncio.FIRST_COMPLETED)
            failed = [task for task in done if task is not stopped and task.exception() is not None]
            if failed:
                if self._control.was_open and not writing.done():  # the car can still be stopped
                    if not self._ending:
                        self.stop()
                    await asyncio.wait([stopped, writing], return_when=asyncio.FIRST_COMPLETED)
                if writing.done():  # nothing can be written any more
                    self._fail_commands()
                failed[0].result()
        finally:
            await self._end({stopped, *tasks})
        return not self._driver.not_stopped

    async def _end(self, tasks: set[asyncio.Future[Any]]) -> None:
        """End all tasks, close the link, save what the next gateway needs, and publish the last states."""
        running = tasks
        # wait_for of Python 3.11 may swallow a cancellation. `keep_open` would then reopen the link for ever.
        while running:
            for task in running:
                task.cancel()
            _, running = await asyncio.wait(running, timeout=CANCEL_RETRY_S)
        await asyncio.gather(*tasks, return_exceptions=True)
        self._notifier.close()
        if self._link.link is not None:
            await self._link.link.close()
        self._save_learned(self._loop.time(), at_once=True)
        self._mark.end()
        self._flush()
        self._publisher.on_bus_connected(self._loop.time(), at_once=True)
        self._publish_states(self._loop.time(), force=True)

    def stop(self) -> None:
        """Stop the car, then end. A second call ends at once."""
        if self._ending:
            log.error("%s may still be moving: its gateway was ended twice", self._settings.car)
            self._driver.link_down("the gateway was ended twice", self._loop.time())
        self._ending = True
        self._driver.shut_down(self._loop.time())
        if not self._driver.finished:
            confirms = self._driver.model.shows is not Shows.NO
            wait = f" It takes up to {SHUTDOWN_S:g} s until the car confirms it." if confirms else ""
            log.info("%s: stopping.%s A second Ctrl-C ends at once.", self._settings.car, wait)
        self._wake.set()

    def _fail_commands(self) -> None:
        """Fail all commands, and claim nothing about the car any more. Ignore errors: the driver may have failed."""
        with contextlib.suppress(Exception):
            self._driver.link_down("its gateway failed", self._loop.time())

    def _on_revoked(self) -> None:
        """Stop the car, because nobody can command it any more, and it may be moving in a mode."""
        car, who = self._settings.car, self._bus.identity
        why = f"the hub passes nothing on for {who}: its certificate was revoked, or {car} was invited elsewhere"
        words = f"{self._needs_certificate(why)}; then start this gateway again."
        self._commands.log(Level.ERROR, "revoked", words)
        self._halt(words)

    def _on_certificate_end(self, ended: datetime) -> None:
        """Stop the car, because nobody can command it until there is a new certificate, and it may be moving."""
        why = f"the certificate of {self._bus.identity} ended on {ended:%Y-%m-%d}, so the hub refuses this gateway"
        words = f"{self._needs_certificate(why)}."
        self._commands.log(Level.ERROR, "certificate_ended", words)
        self._halt(words)

    def _needs_certificate(self, why: str) -> str:
        """Return why the car is stopped, and how to make another certificate, without the last period."""
        car = self._settings.car
        return (
            f"{why}. Nobody can command {car} from here, so it is stopped. `fleet hub invite --car {car}` on the hub's "
            "computer and `fleet join` here make another certificate"
        )

    def _halt(self, words: str) -> None:
        self._control.halt(words, self._loop.time())
        self._wake.set()

    async def _check_rival(self) -> None:
        """Check a second time for another gateway. If two started together, the one with the higher boot id ends."""
        await asyncio.sleep(RIVAL_CHECK_DELAY_S)
        await self._has_rival()  # raises AlreadyServed if this gateway has to end
        await self._writer.finished.wait()

    async def _has_rival(self) -> bool:
        """Return True if another gateway of the car has to end. Raise AlreadyServed if this one has to end."""
        return await asyncio.to_thread(self._service.singleton.raise_unless_first)

    async def _is_port_in_use(self) -> bool:
        """Return True if another gateway, which has to end, may still have the port open."""
        return self._loop.time() < self._began_at + RIVAL_SHUTDOWN_S and await self._has_rival()

    def _log_link_open(self) -> None:
        """Log that the link is open. If saved knowledge about the car is not used, log why."""
        if self._learned_file.trouble:
            self._commands.log(Level.INFO, "learns_again", self._learned_file.trouble)
            self._learned_file.trouble = ""
        self._commands.log(Level.INFO, "link_open", f"{self._link.url} is open. The gateway stops the car first.")

    # ------------------------------------------------------------------ commands

    async def _answer(self, backlog: bus.Backlog[tuple[str, zenoh.Query]]) -> None:
        """Answer queries of values, one at a time. Let the loop serve the car between them."""
        while True:
            family, query = await backlog.next()
            try:
                for _ in self._publisher.answer_query(family, query):
                    await asyncio.sleep(ANSWER_PAUSE_S)
            except Exception:  # a bad query must not end the gateway
                log.exception("a query could not be answered")
            await asyncio.sleep(0)

    def _flush(self) -> None:
        """Publish records and states, save the safety state, and answer the pending queries."""
        self._commands.flush()
        self._publish_states(self._loop.time())

    def _on_sender_tokens(self, changed: Mapping[str, bool]) -> None:
        """Pass changes of liveliness tokens to control."""
        now = self._loop.time()
        for name, alive in changed.items():
            self._control.on_sender_token(name, alive=alive, now=now)
        self._wake.set()

    def _on_poses(self, newest: Mapping[str, bus.Sample]) -> None:
        """Store a pose that somebody else published, to answer queries with it."""
        for sample in newest.values():
            self._publisher.keep_pose(sample, self._loop.time())

    def _merge(self, other: PersistedSafety, source: str) -> None:
        now = self._loop.time()
        self._control.merge_estops(other.estops, other.ended, source, now)
        self._control.merge_pauses(other.pauses, other.ended_pauses, source, now)
        self._wake.set()

    # ------------------------------------------------------------------ time, and the hub

    async def _tick(self) -> None:
        """Check for silence and changed states, and publish the health of the process once a second."""
        next_health = self._loop.time()
        while True:
            due = self._loop.time() + TICK_S
            await asyncio.sleep(TICK_S)
            now = self._loop.time()
            self._worst_lag_s = max(self._worst_lag_s, now - due)
            self._on_gap(now)
            self._alive_at = now
            if has_ended(self._settings.parent) and not self._ending:
                self._commands.log(
                    Level.WARNING,
                    "parent_gone",
                    "the process that started this gateway has ended, so the gateway stops the car and ends too",
                )
                self.stop()
            if self._bus.connected:
                self._no_hub = ""
                self._publisher.on_bus_connected(now)
            else:
                self._publisher.on_bus_lost(now)
                self._hub_lost.set()
            self._link.check(now)
            self._control.tick(now)
            self._wake.set_if_due(now)
            model = self._driver.model
            changed = self._link.health.update(
                now=now,
                limit_s=model.silence_limit_s,
                unheard_s=model.unheard_s(now),
                why_quiet=model.why_quiet,
                is_heard=model.is_heard,
            )
            if changed or self._publisher.is_outdated or now >= next_health:
                self._publish_states(now)
            if now >= next_health:
                self._save_learned(now)
                self._mark.renew()
                next_health = now + HEALTH_INTERVAL_S
                self._publish_health(now)
                self._worst_lag_s = 0.0

    def _on_gap(self, now: float) -> None:
        """Handle a time in which the loop did not run (a gap), or in which the computer slept.

        The bus may have been lost meanwhile, and a driven car must be stopped.
        """
        if (slept_s := self._sleep.take()) > 0:
            self._publisher.on_bus_lost(now)
            if not MONOTONIC_COUNTS_SLEEP:
                self._publisher.on_slept(slept_s, now)
            self._control.on_sleep(slept_s, now, counted=MONOTONIC_COUNTS_SLEEP)
            self._wake.set()
        gap_s = now - self._alive_at - TICK_S
        if gap_s > BUS_LOSS_GAP_S:
            self._publisher.on_bus_lost(now)
        if gap_s > 0:
            self._driver.on_stall(gap_s, now)

    def _save_learned(self, now: float, *, at_once: bool = False) -> None:
        """Save what was learned about the car for its next gateway."""
        if not at_once and now < self._learned_due_at:
            return
        self._learned_due_at = now + LEARNED_INTERVAL_S
        try:
            self._learned_file.save(self._driver.kept())
        except OSError as error:
            log.debug("what was learned about %s could not be saved: %s", self._settings.car, error)

    def _publish_states(self, now: float, *, force: bool = False) -> None:
        """Publish changed states. Before them, publish a new finding about the car, because the states rest on it."""
        if self._publisher.has_new_findings:
            self._publish_health(now)
        self._publisher.publish_states(self._control, self._link.health, now, force=force)

    def _publish_health(self, now: float) -> None:
        drops = self._service.dropped + self._publisher.dropped
        self._publisher.publish_health(now, loop_lag_s=self._worst_lag_s, bus_drops=drops)

    async def _keep_hub(self) -> None:
        """Restart a lost hub. Jitter keeps a hundred gateways from starting it at once."""
        while True:
            await self._hub_lost.wait()
            await asyncio.sleep(bus.HUB_RESTART_DELAY_S * (1 + random.random()))  # noqa: S311 - jitter, no secret
            self._hub_lost.clear()
            if self._bus.connected:
                continue
            try:
                await asyncio.to_thread(bus.ensure_hub, self._bus.endpoint)
            except bus.BusError as error:
                if str(error) != self._no_hub:  # the hub may be away for a weekend
                    self._no_hub = str(error)
                    self._commands.log(Level.ERROR, "no_hub", self._no_hub)


def begin_logging() -> None:
    """Begin to log, as lines for a person or as JSON."""
    if not json_log.begin("gateway"):
        logging.basicConfig(
            format="%(asctime)s %(levelname)s %(message)s",
            datefmt="%H:%M:%S %Z",
            level=logging.INFO,
            stream=sys.stderr,
        )


async def serve(settings: Settings, opened: bus.Bus, service: CarService) -> bool:
    """Serve one car until a signal, or until the parent ends.

    Return False if the car could not be stopped, or if the gateway failed. Raises AlreadyServed or LinkError.
    """
    car = CarGateway(settings, opened, service)
    # Imported objects live as long as the process. Without this, the garbage collector scans them again and again while
    # readings wait.
    gc.freeze()
    loop = asyncio.get_running_loop()
    signals.calls_in(loop, lambda _: car.stop())
    try:
        return await car.run()
    except (AlreadyServed, LinkError):
        raise
    except Exception:  # a driver may come from another package, and must not leave a moving car alone
        log.exception("the gateway of %s failed; a new driver is started now to stop its car", settings.car)
        where = (settings.car, settings.url, settings.platform, settings.fleet, settings.state_dir)
        log.error("%s", await stop_alone(*where))
        return False

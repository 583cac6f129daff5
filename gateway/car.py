"""One car: its link, decoder, control and publications in one asyncio loop. Read this file first.

Up: `_read` takes bytes from the link, the decoder makes events of them, `CarPublisher` publishes what was measured,
and control takes them as evidence. Down: a query on `@cmd` is handed over to the loop, parsed, given to control, and
answered when control has had the chance to write. `_pump` is the only place that writes to the car: what control says,
one frame at a time.
"""

import asyncio
import gc
import logging
import os
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import zenoh

from gateway.bus import requests
from gateway.bus.estop_sync import EstopSync
from gateway.bus.publisher import RAW_PER_S, STALLED_S, CarPublisher
from gateway.bus.service import CarService
from gateway.control.backoff import Attempts
from gateway.control.commands import Answer, Command, EmergencyStop, Phase
from gateway.control.controller import Controller
from gateway.control.estimate.battery import BatteryPolicy
from gateway.control.estimate.link_health import LinkHealth
from gateway.control.events import Level, LogRecord
from gateway.control.executor import SHUTDOWN_S
from gateway.control.safety import Estop
from gateway.link import Link, LinkError, LinkLost, LinkUrl, open_link
from gateway.protocol.decoder import Decoder
from gateway.protocol.events import Echo, Event, Rejected
from gateway.protocol.platforms import Profile
from gateway.state_file import SafetyStateFile
from schemas import bus, keys, messages, topics
from schemas.gen import fleet_v1_pb2 as pb
from schemas.process import signals

TICK_S: Final = 0.2
"""How often silence is weighed, states are looked at, and the loop notes that it was not stalled."""
LONGEST_SLEEP_S: Final = 3600.0
"""No timer may lie at infinity."""
HUB_GONE_S: Final = 0.5
LOOK_AGAIN_S: Final = 0.5
"""Two gateways that started at the same moment see each other when both have declared.

See docs/reference/keys.md#one-gateway-per-car."""
YIELDS_S: Final = SHUTDOWN_S + 2.0
"""Maximum time that the gateway that remains waits for the link that the other one has open. The other one must notice
the conflict, and waits until the car has shown its stop."""
HEALTH_EVERY_S: Final = 1.0
TURN_BYTES: Final = 1024
"""Bytes that are looked at before others get their turn, a stop above all; a car sends 960 a second."""
PAUSE_S: Final = 0.005
"""Between the slices of a long answer: the link takes one meanwhile, and drops what it has no room for."""
CANCEL_S: Final = 0.5
"""A task that goes on for so long after it was cancelled is cancelled again."""
FRESH_S: Final = 0.25
"""Bytes that could not be looked at so soon are not looked at: what comes after them matters more."""
FLOOD_OVER_S: Final = 10.0
"""A flood is told of again when it was over for so long."""
_LEVELS: Final = {
    Level.DEBUG: logging.DEBUG,
    Level.INFO: logging.INFO,
    Level.WARNING: logging.WARNING,
    Level.ERROR: logging.ERROR,
}

log = logging.getLogger("gateway")


@dataclass(frozen=True, slots=True)
class Settings:
    """What `gateway run` was told."""

    car: str
    url: LinkUrl
    profile: Profile
    auto: bool
    """Find out which platform the car is; `profile` is the unknown one."""
    fleet: str
    state_dir: Path
    retry: bool
    """Keep trying when the first attempt to open the link fails."""
    battery: BatteryPolicy = field(default_factory=BatteryPolicy)
    speed_max: float = 1.0
    longest_drive_s: float = requests.LONGEST_DRIVE_S
    parent: int | None = None
    """Process id of the starter, with which this ends."""


@dataclass(frozen=True, slots=True)
class _PendingQuery:
    """A query that waits for its answer."""

    query: zenoh.Query
    key: str
    command_id: str
    answer: Answer
    as_json: bool


class CarGateway:
    """One car's gateway. `run` returns when it was told to stop and the car's stop is written."""

    def __init__(self, settings: Settings, opened: bus.Bus, doors: CarService) -> None:
        self._settings = settings
        self._bus = opened
        self._doors = doors
        self._loop = asyncio.get_running_loop()
        now = self._loop.time()
        self._store = SafetyStateFile(settings.state_dir, settings.fleet, settings.car)
        self._control = Controller(
            settings.car,
            settings.profile,
            auto=settings.auto,
            kept=self._store.load(time.time_ns()),
            battery_policy=settings.battery,
            speed_max=settings.speed_max,
        )
        self._saved = self._control.safety.kept
        self._neighbours = EstopSync(opened, settings.fleet, settings.car)
        self._health = LinkHealth(since=now)
        self._decoder = Decoder()
        self._flood_until = now
        self._link: Link | None = None
        self._attempts = Attempts()
        self._out = CarPublisher(opened, settings.fleet, settings.car, self._control, str(settings.url))
        self._asked: list[_PendingQuery] = []
        self._sent: set[str] = set()
        """Ids of commands whose first frame went out since the last answers."""
        self._wake = asyncio.Event()
        self._wake_at = now
        """Until when the writer sleeps, if nothing wakes it."""
        self._hub_gone = asyncio.Event()
        self._values_asked, self._histories_asked = asyncio.Event(), asyncio.Event()
        self._ending = False
        self._stopped = asyncio.Event()
        self._began_at = self._alive_at = now

    async def run(self) -> bool:
        """Serve the car until `stop` and until its stop is written; False if it could not be stopped.

        Raises AlreadyServed (see doors.py), and LinkError if the link cannot be opened at the start.
        """
        now = self._loop.time()
        self._publish_health(now, 0.0)
        self._out.states(self._control, self._health, now)
        self._doors.attach(
            self._loop,
            values=self._values_asked,
            histories=self._histories_asked,
            command=self._query,
            streamed=self._streamed,
            senders=self._senders,
            cars=self._neighbours.changed,
        )
        work = (
            self._connect(),
            self._write_frames(),
            self._tick(),
            self._keep_hub(),
            self._look_again(),
            self._neighbours.keep_united(self._unite),
            self._answer(self._doors.values),
            self._answer(self._doors.histories),
        )
        tasks = [asyncio.ensure_future(each) for each in work]
        stopped = asyncio.ensure_future(self._stopped.wait())
        try:
            done, _ = await asyncio.wait([stopped, *tasks], return_when=asyncio.FIRST_COMPLETED)
            failed = [task for task in done if task is not stopped and task.exception() is not None]
            if failed:
                if self._control.was_open:
                    if not self._ending:
                        self.stop()
                    await asyncio.wait([stopped, tasks[1]], return_when=asyncio.FIRST_COMPLETED)
                failed[0].result()
        finally:
            running = {stopped, *tasks}
            # Python 3.11's wait_for may swallow a cancellation: a link that closed just then was opened again for ever.
            while running:
                for task in running:
                    task.cancel()
                _, running = await asyncio.wait(running, timeout=CANCEL_S)
            await asyncio.gather(stopped, *tasks, return_exceptions=True)
            if self._link is not None:
                await self._link.close()
            self._flush()
            self._out.bus_back(self._loop.time(), at_once=True)
            self._out.states(self._control, self._health, self._loop.time(), force=True)
        return not self._control.not_stopped

    def stop(self) -> None:
        """Begin to end: the car is stopped first. Told again, end without waiting for it."""
        if self._ending:
            log.error("%s: told twice to end: its stop may be incomplete", self._settings.car)
            self._control.link_down("the gateway was told twice to end", self._loop.time())
        self._ending = True
        self._control.shutdown(self._loop.time())
        self._wake.set()

    async def _look_again(self) -> None:
        """Of two gateways that started at the same moment, the one with the higher id yields."""
        await asyncio.sleep(LOOK_AGAIN_S)
        await self._has_rival()
        await self._stopped.wait()

    async def _has_rival(self) -> bool:
        """Whether another gateway serves the car that is to yield; raises AlreadyServed if this one is."""
        others = await asyncio.to_thread(self._doors.others)
        self._doors.refuse([other for other in others if other.boot_id < self._bus.boot_id])
        return bool(others)

    async def _is_yielded_to(self) -> bool:
        """Whether the link that cannot be opened may still be another's that has not looked again yet."""
        return self._loop.time() < self._began_at + YIELDS_S and await self._has_rival()

    # ------------------------------------------------------------------ the link

    async def _connect(self) -> None:
        """Keep the link open, and read it."""
        may_fail = self._settings.retry
        while True:
            try:
                link = await open_link(self._settings.url)
            except LinkError as error:
                if not may_fail and not await self._is_yielded_to():
                    raise
                self._lost(str(error))
                await asyncio.sleep(self._attempts.delay_s(random.random()))  # noqa: S311 - jitter, no secret
                continue
            may_fail = True
            now = self._loop.time()
            self._link = link
            self._decoder = Decoder()
            self._health.up(now)
            self._control.link_up(now)
            if self._attempts.opened(now):
                self._tell_open()
            self._wake.set()
            try:
                await self._read(link)
            except LinkLost as error:
                self._events(self._decoder.end())
                if self._link is link:
                    self._lost(str(error))
            await link.close()
            await asyncio.sleep(self._attempts.delay_s(random.random()))  # noqa: S311 - jitter, no secret

    def _tell_open(self) -> None:
        self._log(Level.INFO, "link_open", f"{self._settings.url} is open: bringing the car to a known state")

    async def _read(self, link: Link) -> None:
        """Bytes to events, until the link is lost."""
        while True:
            data = await link.read()
            came_at = now = self._loop.time()
            self._health.received(len(data), now)
            shown = self._shown
            for start in range(0, len(data), TURN_BYTES):
                if start:
                    await asyncio.sleep(0)
                    now = self._loop.time()
                if now > came_at + FRESH_S:
                    self._events(self._decoder.end())
                    self._flood("flood_bytes", len(data) - start, now)
                    break
                self._events(self._decoder.feed(data[start : start + TURN_BYTES], now))
            if self._shown != shown:
                self._wake.set()
            self._wake_if_due(now)

    def _flood(self, counted_as: str, count: int, now: float) -> None:
        """More came than can be told: counted, and said once for each flood."""
        self._health.rejected(counted_as, count)
        if now >= self._flood_until:
            words = (
                f"{self._settings.car} sends more than any car does: {RAW_PER_S:g} raw frames a second are published, "
                "and what is left out is counted in state/link (another device, or another baud rate?)"
            )
            self._log(Level.WARNING, "flood", words)
        self._flood_until = now + FLOOD_OVER_S

    def _events(self, events: list[Event]) -> None:
        """Publish what was measured, which does not wait for what it means, and take it as evidence."""
        for event in events:
            confirmed = self._control.mode.confirmed
            if not self._out.event(event, confirmed, loaded=self._control.motors != "off"):
                self._flood("raw_not_published", 1, event.at)
            self._control.heard(event, self._loop.time())
            self._out.profile = self._control.profile
            self._health.rx_frames += 1
            if isinstance(event, Rejected):
                self._health.rejected(event.cause)
                continue
            if not isinstance(event, Echo):
                self._health.heard(event.at)
            if self._attempts.proven(event.at, heard=True):
                self._tell_open()

    def _lost(self, reason: str) -> None:
        now = self._loop.time()
        self._link = None
        self._health.down(reason, now)
        self._control.link_down(reason, now)
        if self._attempts.failed(reason):
            self._log(Level.WARNING, "link_lost", reason)
        self._wake.set()

    # ------------------------------------------------------------------ frames to the car

    async def _write_frames(self) -> None:
        """Write what control wants when it wants it, answer queries, publish records."""
        while True:
            self._wake.clear()
            await self._pump()
            self._flush()
            if self._control.finished:
                self._stopped.set()
            now = self._loop.time()
            self._wake_at = self._due_at(now)
            timer = self._loop.call_at(min(self._wake_at, now + LONGEST_SLEEP_S), self._wake.set)
            await self._wake.wait()
            timer.cancel()

    @property
    def _shown(self) -> tuple[object, ...]:
        """What a reading, or silence, may change of the states."""
        return self._control.mode.verdict, self._control.mode.inferred, self._control.motors, self._control.basis

    def _wake_if_due(self, now: float) -> None:
        """Wake the writer if it has something to do: for each reading, which seldom needs it, it would cost a third."""
        if self._control.has_records or self._due_at(now) < self._wake_at:
            self._wake.set()

    def _due_at(self, now: float) -> float:
        """When there is something to write, or to be made of what has come, if nothing else happens."""
        deadline = self._decoder.deadline()
        return min(self._control.next_at(now), float("inf") if deadline is None else deadline)

    async def _pump(self) -> None:
        now = self._loop.time()
        self._woke(now - self._alive_at - TICK_S, now)
        self._events(self._decoder.tick(now))
        while (link := self._link) is not None and (write := self._control.poll(self._loop.time())) is not None:
            self._decoder.sent(write.data, self._loop.time())  # an echo may be there before the write returns
            try:
                await link.write(write.data)
            except LinkLost as error:
                reason = f"a write failed: {error}"
                now = self._loop.time()
                self._out.written(write, now, whole=False)
                self._control.write_failed(reason, now)
                if self._link is link:  # what reads it may have met its end first
                    self._lost(reason)
                await link.close()  # what reads it wakes, and opens it again
                return
            now = self._loop.time()
            self._control.wrote(write, now)
            self._health.wrote(len(write.data), now)
            self._out.written(write, now, whole=True)

    # ------------------------------------------------------------------ commands

    async def _answer(self, asked: bus.Backlog[tuple[str, zenoh.Query]]) -> None:
        """Answer queries of readings, one at a time, the car's own work in between."""
        while True:
            family, query = await asked.next()
            try:
                for _ in self._out.answers(family, query):
                    await asyncio.sleep(PAUSE_S)
            except Exception:  # whatever was asked: the car's own work goes on
                log.exception("a question could not be answered")
            await asyncio.sleep(0)

    def _query(self, came: tuple[zenoh.Query, str]) -> None:
        """Take a command that came as a query; it is answered when control has had the chance to write."""
        query, unread = came
        expression = str(query.key_expr)
        verb = expression.rpartition("/")[2]
        encoding = str(query.encoding) if query.encoding is not None and not unread else ""
        payload = query.payload.to_bytes() if query.payload is not None and not unread else None
        as_json = query.parameters.get("format") == "json" or not encoding.startswith(topics.PROTOBUF)
        if "*" in verb:
            with query:
                query.reply_err(f"{expression}: name the command, there is no command {verb}", encoding="text/plain")
            return
        longest_s = self._settings.longest_drive_s
        by_wildcard = "*" in expression
        request = requests.ParsedRequest(
            verb,
            payload,
            encoding,
            time.time_ns(),
            longest_drive_s=longest_s,
            by_wildcard=by_wildcard,
            unread=unread,
        )
        before = self._control.safety.kept
        command, answer = self._command(request)
        if not request.by_wildcard:
            self._neighbours.pass_on(command, before, self._control.safety.kept)
        elif isinstance(command.what, EmergencyStop) and command.what.fleet_wide:
            self._neighbours.ask_soon()  # what one gateway made of it, or did not hear, the others show
        key = keys.command_key(self._settings.fleet, self._settings.car, verb)
        self._asked.append(_PendingQuery(query, key, command.id, answer, as_json))
        self._wake.set()

    def _streamed(self, sample: bus.Sample) -> None:
        """Take a drive that came as a publication."""
        if not sample.deleted:
            request = requests.ParsedRequest(
                "drive",
                sample.payload,
                sample.encoding,
                time.time_ns(),
                sampled_ns=sample.time_ns,
                longest_drive_s=self._settings.longest_drive_s,
                by_wildcard="*" in sample.key,
                unread=sample.unread,
            )
            self._command(request)
            self._wake.set()

    def _command(self, request: requests.ParsedRequest) -> tuple[Command, Answer]:
        """Parse a request and give it to control; its first record carries the request as it came."""
        now = self._loop.time()
        try:
            command = requests.parse(request)
            answer = self._control.command(command, now)
        except requests.BadRequest as error:
            command = error.command
            answer = self._control.refused(command, error.reason, error.words, now)
        self._publish_records(command.id, request)
        return command, answer

    def _reply(self, asked: _PendingQuery, sent: set[str]) -> None:
        answer = asked.answer
        status = Phase.SENT if asked.command_id in sent and answer.status is Phase.QUEUED else answer.status
        result = pb.Result(
            id=asked.command_id,
            car=self._settings.car,
            status=status,
            reason=answer.reason or "",
            words=answer.words,
            worst_case_s=answer.worst_case_s or None,  # left out unless a stop was announced
        )
        with asked.query as query:
            if asked.as_json:
                bus.reply(query, asked.key, messages.to_json(result).encode(), messages.JSON)
            else:
                bus.reply(query, asked.key, result.SerializeToString(), messages.encoding_of("fleet.v1.Result"))

    def _flush(self) -> None:
        """Publish records and states, answer what waits for an answer, keep what must survive a restart."""
        self._publish_records()
        self._save()
        sent, self._sent = self._sent, set()
        asked, self._asked = self._asked, []
        for each in asked:
            self._reply(each, sent)
        self._out.states(self._control, self._health, self._loop.time())

    def _save(self) -> None:
        """Before anybody is answered: who is told that an e-stop is latched may pull the plug."""
        kept = self._control.safety.kept
        if kept == self._saved:
            return
        self._saved = kept
        try:
            self._store.save(kept)
        except OSError as error:
            words = f"hold and e-stops will not survive a restart: {error}"
            self._log(Level.ERROR, "not_saved", words)
            for index, each in enumerate(self._asked):
                answer = replace(each.answer, words="; ".join(filter(None, (each.answer.words, f"not saved: {error}"))))
                self._asked[index] = replace(each, answer=answer)

    def _publish_records(self, command_id: str = "", request: requests.ParsedRequest | None = None) -> None:
        for record in self._control.take_records():
            if isinstance(record, LogRecord):
                log.log(_LEVELS[record.level], "%s: %s", self._settings.car, record.words)
                self._out.log(record)
                continue
            first = request if request is not None and record.command.id == command_id else None
            self._out.command(record, None if first is None else (first.payload or b"", first.encoding))
            request = None if first is not None else request
            if record.phase is Phase.SENT:
                self._sent.add(record.command.id)

    def _log(self, level: Level, code: str, words: str) -> None:
        log.log(_LEVELS[level], "%s: %s", self._settings.car, words)
        self._out.log(LogRecord(level, code, words, self._loop.time()))

    def _senders(self, changed: Mapping[str, bool]) -> None:
        """Liveliness tokens of senders appeared or went."""
        now = self._loop.time()
        for name, alive in changed.items():
            self._control.sender_alive(name, alive=alive, now=now)
        self._wake.set()

    def _unite(self, estops: Sequence[Estop], ended: Sequence[str], told_by: str) -> None:
        self._control.unite(estops, ended, told_by, self._loop.time())
        self._wake.set()

    # ------------------------------------------------------------------ time, and the hub

    async def _tick(self) -> None:
        """Weigh silence, look at the states, say once a second how the process does."""
        next_health = self._loop.time()
        worst = 0.0
        while True:
            due = self._loop.time() + TICK_S
            await asyncio.sleep(TICK_S)
            now = self._loop.time()
            worst = max(worst, now - due)
            self._woke(now - due, now)
            self._alive_at = now
            if self._attempts.proven(now, heard=False):
                self._tell_open()
            if self._settings.parent not in (None, os.getppid()) and not self._ending:
                self._log(Level.WARNING, "parent_gone", "the process that started this gateway has ended: ending, too")
                self.stop()
            if self._bus.connected:
                self._out.bus_back(now)
            else:
                self._out.bus_away(now)
                self._hub_gone.set()
            shown = self._shown
            self._control.tick(now)
            self._wake_if_due(now)
            mode = self._control.mode
            changed = self._health.judge(
                now=now,
                limit_s=mode.silence_limit(fan=bool(self._control.believed.fan)),
                unheard_s=mode.unheard_s(now),
                why_quiet=f"{mode.asked or 'an unknown mode'} is silent",
                is_heard=self._control.is_heard,
            )
            if changed or self._shown != shown or now >= next_health:
                self._out.states(self._control, self._health, now)
            if now >= next_health:
                next_health = now + HEALTH_EVERY_S
                self._publish_health(now, worst)
                worst = 0.0

    def _woke(self, gap_s: float, now: float) -> None:
        """The loop slept for so long."""
        if gap_s > STALLED_S:
            self._out.bus_away(now)
        self._control.stalled(gap_s, now)

    def _publish_health(self, now: float, lag_s: float) -> None:
        drops = self._doors.dropped + self._out.dropped
        self._out.health(now, loop_lag_s=lag_s, bus_drops=drops, platform=self._control.platform)

    async def _keep_hub(self) -> None:
        """Bring a hub back that is gone for half a second; jitter keeps a hundred gateways from trying at once."""
        while True:
            await self._hub_gone.wait()
            await asyncio.sleep(HUB_GONE_S * (1 + random.random()))  # noqa: S311 - jitter, no secret
            self._hub_gone.clear()
            if self._bus.connected:
                continue
            try:
                await asyncio.to_thread(bus.ensure_hub, self._bus.endpoint)
            except bus.BusError as error:
                self._log(Level.ERROR, "no_hub", str(error))


async def serve(settings: Settings, opened: bus.Bus, doors: CarService) -> bool:
    """Serve one car until a signal ends it; False if it could not be stopped. Raises AlreadyServed or LinkError."""
    car = CarGateway(settings, opened, doors)
    # What was imported stays: the collector need not look at it again while readings wait.
    gc.freeze()
    loop = asyncio.get_running_loop()
    signals.calls_in(loop, lambda _: car.stop())
    return await car.run()

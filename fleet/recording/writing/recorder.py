"""Records all messages of one fleet into sessions. The recorder is one more subscriber, and selects nothing.

It runs three threads:
- The reader drains the subscriptions and never touches a disk. So if the disk hangs, messages are dropped here, but the
  publishers do not stall.
- The backfill asks publishers for missed messages (backfill.py).
- The writer writes (session_writer.py), flushes and publishes the status every second, and answers queries.
"""

import contextlib
import json
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, Final

import zenoh
from msgspec import Struct

from fleet.fleetfile.fleet_file import PinRule
from fleet.policy.plan_requests import RequestRefused, check_sender
from fleet.recording.session_dir import MAX_MARK_CHARACTERS
from fleet.recording.writing.backfill import Backfill
from fleet.recording.writing.pin_watch import PinWatch
from fleet.recording.writing.receive_clock import ReceiveClock
from fleet.recording.writing.recorder_service import (
    MARK_TOPIC,
    STATUS_TIMEOUT_S,
    STATUS_TOPIC,
    AnotherRecorder,
    RecorderService,
)
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas import keys, messages
from schemas.bus import Bus, SampleChannel, messages_of, reply_value, sequence_of
from schemas.gen import fleet_v1_pb2
from schemas.identity import NotTheSender, sender_for
from schemas.rights import Authority, People
from schemas.words import Level, RecorderState, RecorderVerb

MAX_QUEUED_MESSAGES: Final = 100_000
MAX_QUEUED_BYTES: Final = 64 << 20
"""Maximum size of the queue to the writer. It holds what 100 cars publish in some seconds, and needs little memory even
on a small computer."""
FLUSH_INTERVAL_S: Final = 1.0
"""Interval of flush and status. A crash loses at most the messages of this time."""
READ_INTERVAL_S: Final = 0.01
"""Interval at which subscriptions are drained. A log_time has this resolution, while a publish_time is exact."""
WRITE_INTERVAL_S: Final = 0.05
"""Interval at which the queue is written."""
SUBSCRIBER_QUEUE_SIZE: Final = 16_384
"""Maximum number of messages in the queue of one subscription: three seconds of 100 cars."""
MAX_READ_BATCH: Final = 4_096
"""Maximum number of messages that are read from one subscription before the next one."""
SHUTDOWN_DRAIN_S: Final = 0.3
"""At shutdown, wait this long for messages in transit, and then at most this long for an answer of the hub."""
MAX_DRAIN_DELAY_S: Final = 0.2
"""Maximum time for both waits beyond SHUTDOWN_DRAIN_S. If they last longer, the hub or the recorder stood still, and
both waits are repeated."""
MAX_SHUTDOWN_DRAIN_S: Final = 5.0
"""Maximum time for all repetitions, on a machine that stays too busy."""
RIVAL_S: Final = 5.0
"""Time after the start in which another recorder may be heard that has started at the same moment."""
MAX_PENDING_QUERIES: Final = 64
MAX_STOP_S: Final = 8.0
"""Maximum time for which a session that is to be closed waits for its missing messages. Before that, the recorder may
ask the gateways who may stop it (STATUS_TIMEOUT_S). Clients wait 15 s for the answer to both."""


class RecordingFailed(Exception):
    """The session could not be written to its end. The message gives the cause and the recorded part."""


class _CommandRefused(Exception):
    """A command over the bus was rejected. The message is the answer."""


class RecordingOutcome(Struct, frozen=True):
    """Result of a recording. The counts by key contain only keys with losses."""

    session: Path
    messages: int
    bytes: int
    drops: Mapping[str, int]
    missed: Mapping[str, int]
    error: str = ""
    """Losses at the end of the session because the disk was full."""


_Item = tuple[str, bytes, zenoh.Encoding, "zenoh.Timestamp | None", "zenoh.SourceInfo | None", int]


class Recorder:
    """Records from `start` to `close`. If the disk fails, `ended` is set and `close` raises RecordingFailed.

    If another recorder has started at the same moment, one of the two closes its session and sets `ended`, and its
    `close` raises AnotherRecorder.

    If the disk is full, also at the start, the recorder waits for space, and `full` gives the reason.

    `notify` is called with news for a person: a full disk, a removed old session, a new session.
    """

    def __init__(
        self,
        bus: Bus,
        fleet: str,
        root: Path,
        options: Options | None = None,
        *,
        site: str = "",
        pins: Sequence[PinRule] = (),
        people: Callable[[], People | None] = lambda: None,
        max_messages: int = MAX_QUEUED_MESSAGES,
        max_bytes: int = MAX_QUEUED_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
        notify: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._bus = bus
        self._fleet = keys.check_name(fleet, "fleet name")
        self._service = RecorderService(bus, fleet, site)
        self._root = root
        self._options = options or Options()
        self._pin_rules = pins
        self._read_people = people
        """Returns the people in the fleet file, who may start and stop the recorder. If it returns None, the people
        whom the gateways know may."""
        self._pin_watch = PinWatch(pins)
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._now = ReceiveClock(wall_ns).ns
        self._notify = notify
        self._reported: dict[str, str] = {}
        self._lock = threading.Lock()
        self._queue: list[_Item] = []
        self._writing: Iterator[_Item] = iter(())
        self._queued_messages = 0
        self._queued_bytes = 0
        self._queries: list[tuple[zenoh.Query, str]] = []
        self._stops: list[tuple[zenoh.Query, str]] = []
        """Requests to stop, which are answered when the session is closed."""
        self._is_closing = False
        self._closing = threading.Event()
        self._reader_done = threading.Event()
        self._reader_error: Exception | None = None
        self._subscribers: list[SampleChannel] = []
        self._error = ""
        self._rival: AnotherRecorder | None = None
        """Set if another recorder has started at the same moment, and goes on alone."""
        self._alone_from = inf
        self._recording = True
        self.ended = threading.Event()
        """Set when the writer has closed the session or failed."""

    def start(self) -> Path:
        """Declare all subscriptions, and return the directory of the session.

        Raises AnotherRecorder, and OSError if the session cannot be created. A full disk does not raise.
        """
        self._service.refuse_a_second()
        for expression in keys.recorded_keys(self._fleet):
            self._subscribers.append(self._bus.subscribe_channel(expression, SUBSCRIBER_QUEUE_SIZE))
        self._session = SessionWriter(self._root, self._fleet, self._options, self._now())
        self._overflow: dict[tuple[str, Hashable], tuple[int, int]] = {}
        """Messages that did not fit into the queue, by key and sender: their count and the number of the last one."""
        session = self._session.path
        self._service.declare_publishers()
        self._last = self._status()
        self._backfill = self._new_backfill()
        self._reader = threading.Thread(target=self._read, name="bus-reader")
        self._writer = threading.Thread(target=self._write, name="mcap-writer")
        self._reader.start()
        self._writer.start()
        self._backfill.start()
        self._service.open(self._on_query)
        self._alone_from = time.monotonic() + RIVAL_S
        return session

    @property
    def full(self) -> str:
        """Return why writing pauses, or an empty text if it does not."""
        return self._session.full

    def close(self) -> RecordingOutcome:
        """Write all received messages, and close the session. Raises RecordingFailed and AnotherRecorder."""
        if not self.ended.is_set():
            self._await_messages_in_transit()
        with self._lock:
            self._is_closing = True
        self._backfill.close()
        self._closing.set()
        self._reader.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
        self._writer.join()
        if self._error:
            raise RecordingFailed(self._error)
        if self._rival is not None:
            raise self._rival
        session = self._session
        return RecordingOutcome(
            session.path, session.messages, session.bytes, dict(session.drops), session.missed, session.cost
        )

    def _new_backfill(self) -> Backfill:
        session, recorded = self._session, keys.recorded_keys(self._fleet)
        # Not further back than the interrupted session: the publishers of fast clocks would answer with older messages.
        age_s = (self._now() - session.resume_since_ns) / 1e9
        return Backfill(self._bus, recorded, resumes_s=age_s if session.description.continues else None)

    def _await_messages_in_transit(self) -> None:
        began = time.monotonic()
        end = began + MAX_SHUTDOWN_DRAIN_S
        while began < end:
            time.sleep(SHUTDOWN_DRAIN_S)
            self._service.wait_for_hub(SHUTDOWN_DRAIN_S)
            began, before = time.monotonic(), began
            if began - before < SHUTDOWN_DRAIN_S + MAX_DRAIN_DELAY_S:
                return

    def _on_query(self, query: zenoh.Query, key: str) -> bool:
        """Queue a query, on a Zenoh thread. Return False if too many are pending."""
        with self._lock:
            if self.ended.is_set():
                return True  # no thread is left to answer
            if len(self._queries) >= MAX_PENDING_QUERIES:
                return False
            self._queries.append((query, key))
        return True

    # ------------------------------------------------------------------ the reader's thread

    def _read(self) -> None:
        try:
            while not self._closing.is_set():
                if not self._read_batch():
                    time.sleep(READ_INTERVAL_S)  # Event.wait costs several times as much CPU
            while self._read_batch():
                pass
        except Exception as error:  # noqa: BLE001 - the writer reports it and ends
            self._reader_error = error
        finally:
            self._reader_done.set()

    def _read_batch(self) -> bool:
        """Move received messages to the queue. Return True if there may be more."""
        with self._lock:
            messages, size = self._queued_messages, self._queued_bytes
        batch: list[_Item] = []
        overflow: list[tuple[str, zenoh.SourceInfo | None]] = []
        more = False
        for subscriber in self._subscribers:
            receive = subscriber.try_recv
            for _ in range(MAX_READ_BATCH):
                sample = receive()
                if sample is None:
                    break
                # Copy the payload: a ZBytes keeps its whole network batch in memory, beyond the byte limit.
                payload = sample.payload.to_bytes()
                key = str(sample.key_expr)
                if messages >= self._max_messages or size + len(payload) > self._max_bytes:
                    overflow.append((key, sample.source_info))
                    continue
                messages += 1
                size += len(payload)
                batch.append((key, payload, sample.encoding, sample.timestamp, sample.source_info, self._now()))
            else:
                more = True
        if batch or overflow:
            taken = sum(len(item[1]) for item in batch)
            with self._lock:
                self._queued_messages += len(batch)
                self._queued_bytes += taken
                self._queue += batch
                for key, source in overflow:
                    sender = None if source is None else (source.source_id.zid, source.source_id.eid)
                    count, _ = self._overflow.get((key, sender), (0, 0))
                    self._overflow[key, sender] = (count + 1, 0 if source is None else sequence_of(source))
        return more

    # ------------------------------------------------------------------ the writer's thread

    def _write(self) -> None:
        try:
            due = time.monotonic()
            while not self._rival and not self._reader_done.wait(WRITE_INTERVAL_S):
                self._drain()
                if time.monotonic() >= due:
                    due = max(due + FLUSH_INTERVAL_S, time.monotonic())
                    self._tick()
                self._answer()
            self._drain()
            if self._reader_error is not None:
                self._fail(f"{type(self._reader_error).__name__}: {self._reader_error}")
                return
            if self._recording:
                self._end_session(self._session)
            self._publish(RecorderState.CLOSED)
        except OSError as error:
            self._fail(f"{error.filename or self._session.path}: {error.strerror or error}")
        except Exception as error:  # noqa: BLE001 - a recorder must never stop silently, whatever the cause
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            self.ended.set()
            self._answer()

    def _drain(self) -> None:
        with self._lock:
            batch, self._queue = self._queue, []
            overflow, self._overflow = self._overflow, {}
            has_room = self._queued_messages <= self._max_messages / 2 and self._queued_bytes <= self._max_bytes / 2
        backfilled, answered_ns = self._backfill.take_answers(), self._now()
        if self._recording:
            add = self._session.add
            self._writing = iter(batch)
            for item in self._writing:
                add(*item)
            self._pin(batch)
            self._take_marks(batch)
            self._look_for_rival(batch)
            self._add_backfilled(backfilled, answered_ns)
            for (key, sender), (count, number) in overflow.items():
                self._session.drop_received(key, sender, number, count)
            if self._session.gaps and has_room:  # without room, the answers would delay the writer even more
                now_ns = self._now()
                self._backfill.request({key: (now_ns - before) / 1e9 for key, before in self._session.gaps.items()})
                self._session.gaps.clear()
            if self._session.newcomers and has_room:
                self._backfill.request_newcomers(self._session.newcomers)
                self._session.newcomers.clear()
        # Do this last, because messages count against the limit until they are written.
        with self._lock:
            self._queued_messages -= len(batch)
            self._queued_bytes -= sum(len(item[1]) for item in batch)

    def _pin(self, batch: Sequence[_Item]) -> None:
        """Add the pins that new messages cause."""
        watch = self._pin_watch
        for key, payload, encoding, stamp, _, received_ns in batch:
            if watch.is_watched(key):
                published_ns = received_ns if stamp is None else stamp.get_time_as_ntp64().as_nanos()
                for pin in watch.add(key, str(encoding), payload, published_ns, received_ns):
                    self._session.pin(pin)

    def _look_for_rival(self, batch: Sequence[_Item]) -> None:
        """End if another recorder that has started at the same moment is to go on."""
        if time.monotonic() > self._alone_from:
            return
        for key, payload, encoding, *_ in batch:
            if key == self._service.own_status:
                try:
                    self._service.yield_to_another(payload, str(encoding))
                except AnotherRecorder as rival:
                    self._rival, self._session.description.error = rival, str(rival)

    def _take_marks(self, batch: Sequence[_Item]) -> None:
        """Add marks that the recorder of another site has set, so that this session is kept, too."""
        if self._service.speaks_for_fleet:
            return  # this recorder sets the marks itself
        for key, payload, encoding, _, _, received_ns in batch:
            if key == self._service.mark_key:
                with contextlib.suppress(messages.BadPayload, OSError):  # the message itself is recorded in any case
                    mark: Any = messages.parse(MARK_TOPIC.message, payload, str(encoding))
                    self._session.mark(mark.message[:MAX_MARK_CHARACTERS], mark.name[:MAX_MARK_CHARACTERS], received_ns)

    def _add_backfilled(self, answers: Sequence[tuple[zenoh.Sample, bool]], answered_ns: int) -> None:
        """Write answers of publishers. `answered_ns` is when they were taken: later messages wait in the queue."""
        late: list[tuple[int, str, str, bytes]] = []
        for sample, is_of_all in answers:
            new = self._session.add_backfilled(sample, answered_ns, is_of_all=is_of_all)
            key = str(sample.key_expr)
            if new and sample.timestamp is not None and self._pin_watch.is_watched(key):
                published_ns = sample.timestamp.get_time_as_ntp64().as_nanos()
                late.append((published_ns, key, str(sample.encoding), sample.payload.to_bytes()))
        if late:
            for pin in self._pin_watch.add_late(late, self._now()):
                self._session.pin(pin)

    def _tick(self) -> None:
        session = self._session
        if self._recording:
            session.tick(self._now())
            if session.over and not session.full and not self._stops:
                self._begin_session(after=session)
                self._end_session(session)
        self._report_news(self._session)
        self._publish()

    def _begin_session(self, after: SessionWriter | None = None) -> None:
        """Begin the next session, which follows `after` without a pause. Raises OSError if it cannot be created."""
        self._session = SessionWriter(self._root, self._fleet, self._options, self._now(), after=after)
        if not self._session.full:
            self._notify(f"recording {keys.describe_fleet(self._fleet)} to {self._session.path}")

    def _end_session(self, session: SessionWriter) -> None:
        """Close a session, and report its last news."""
        session.close(self._now())
        self._report_news(session)

    def _report_news(self, session: SessionWriter) -> None:
        """Report removals by the quota, failed copies, and each new state once."""
        for words in (*session.quota_news, *session.uncopied):
            self._notify(words)
        session.quota_news.clear()
        session.uncopied.clear()
        # Numbers in the texts change all the time. So report a pause once, and a warning once for each text before its
        # comma.
        now = {"full": session.full} if session.full else {}
        if session.warning:
            now["warning"] = session.warning.partition(",")[0]
        for kind, text in now.items():
            if kind not in self._reported or (kind == "warning" and text != self._reported[kind]):
                self._notify(f"{kind}: {text}")
        if "full" in self._reported and not session.full and self._recording:
            self._notify(f"there is room again: recording continues to {session.path}")
        self._reported = now

    def _fail(self, words: str) -> None:
        with self._lock:
            self._max_messages = 0
            unwritten, self._queue = [*self._writing, *self._queue], []
        for item in unwritten:
            self._session.drop(item[0])
        self._error = self._session.abandon(f"recording to {self._session.path} failed: {words}", self._now())
        # Reuse the last status: reading the disk may fail again.
        self._last.state, self._last.error, self._last.messages = (
            RecorderState.FAILED,
            self._error,
            self._session.messages,
        )
        self._last.drops.update(self._session.drops)
        with contextlib.suppress(zenoh.ZError):  # the bus may be the cause; `close` and session.json report the failure
            self._service.publish(self._last, self._now())

    @property
    def _state(self) -> RecorderState:
        if not self._recording:
            return RecorderState.STOPPED
        return RecorderState.FULL if self._session.full else RecorderState.RECORDING

    def _status(self, state: str = "") -> fleet_v1_pb2.Recording:
        session = self._session
        return fleet_v1_pb2.Recording(
            session=str(session.path),
            state=state or self._state,
            bytes=session.bytes,
            messages=session.messages,
            drops=dict(session.drops),
            free_bytes=session.free_bytes,
            error=self._error
            or session.cost
            or (f"{session.full.rstrip('.')}; {session.waiting} messages wait" if session.full else ""),
            missed=session.missed,
            recovered=session.recovered,
            segments=session.segments,
            warning=session.warning,
        )

    def _publish(self, state: str = "") -> None:
        self._last = self._status(state)
        self._service.publish(self._last, self._now())

    # ------------------------------------------------------------------ queries and commands

    def _answer(self) -> None:
        with self._lock:
            queries, self._queries = self._queries, []
        for query, key in queries:
            with contextlib.ExitStack() as answered:
                answered.enter_context(query)
                verb = key.rpartition("/")[2] if "/@cmd/" in key else RecorderVerb.STATUS
                try:
                    self._handle(verb, query)
                except _CommandRefused as refused:
                    query.reply_err(str(refused), encoding="text/plain")
                    continue
                if verb == RecorderVerb.STOP:
                    answered.pop_all()
                    self._stops.append((query, key))
                else:
                    self._reply(query, key)
        self._finish_stop()

    def _reply(self, query: zenoh.Query, key: str) -> None:
        reply_value(query, key, self._last.SerializeToString(), STATUS_TOPIC)

    def _handle(self, verb: str, query: zenoh.Query) -> None:
        if self.ended.is_set() and verb != RecorderVerb.STATUS:
            raise _CommandRefused("the recorder is ending")
        match verb:
            case RecorderVerb.START:
                self._check_sender(query, verb)
                self._start_session()
            case RecorderVerb.STOP:
                self._check_sender(query, verb)
                self._begin_stop()
            case RecorderVerb.MARK:
                self._mark(query)
            case RecorderVerb.STATUS:
                if not self.ended.is_set():
                    self._last = self._status()
            case _:
                raise _CommandRefused(f"There is no command {verb}: allowed are {', '.join(RecorderVerb)}.")

    def _check_sender(self, query: zenoh.Query, verb: str) -> None:
        """Refuse the command if its sender may not send it. The rule is that of the plan: only leads may.

        Without `people:` everyone may.
        """
        people = self._people()
        if people.roles is None:
            return
        try:
            fields = json.loads(query.payload.to_bytes()) if query.payload is not None else {}
            by = str(fields.get("sender", ""))
        except (ValueError, AttributeError):
            raise _CommandRefused('A command is JSON, such as {"sender": "ann"}') from None
        try:
            check_sender(people, sender_for(keys.identity_of(str(query.key_expr)), by, verb))
        except (NotTheSender, RequestRefused) as error:
            raise _CommandRefused(str(error)) from None

    def _people(self) -> People:
        listed = self._read_people()
        if listed is not None:
            return listed
        states = self._bus.query(f"{self._fleet}/*/state/safety", timeout_s=STATUS_TIMEOUT_S)
        return People.merged(Authority.of(each).people for each in messages_of(states))

    def _start_session(self) -> None:
        if self._stops:
            raise _CommandRefused(f"{self._session.path} is being closed: ask again in a moment.")
        if self._recording:
            raise _CommandRefused(
                f"{keys.describe_fleet(self._fleet).capitalize()} is recorded already, to {self._session.path}"
            )
        try:
            self._begin_session()
        except OSError as error:
            raise _CommandRefused(f"No session can be made in {self._root}: {error.strerror}") from None
        with self._lock:
            if not self._is_closing:
                self._backfill = self._new_backfill()
                self._backfill.start()
        self._recording = True
        self._pin_watch = PinWatch(self._pin_rules)  # begin anew: between the sessions, no message was watched
        self._publish()

    def _begin_stop(self) -> None:
        """Ask for missing messages one last time. The session records until the answers have come."""
        if not self._recording:
            raise _CommandRefused(f"Nothing is being recorded. The last session is {self._session.path}.")
        self._backfill.end(MAX_STOP_S)

    def _finish_stop(self) -> None:
        """Close the session if a stop was requested, and the last answers have come. Answer the request."""
        if not self._stops or (self._backfill.is_running and not self.ended.is_set()):
            return
        if self._recording and not self.ended.is_set():
            self._drain()
            self._end_session(self._session)
            self._recording = False
            losses = f"; {self._session.cost}" if self._session.cost else ""
            self._notify(f"{self._session.path} is closed by request{losses}")
            self._publish()
        stops, self._stops = self._stops, []
        for query, key in stops:
            with query:
                self._reply(query, key)

    def _mark(self, query: zenoh.Query) -> None:
        if not self._recording:
            raise _CommandRefused("Nothing is being recorded. `fleet record start` begins a session.")
        try:
            request = json.loads(query.payload.to_bytes()) if query.payload is not None else {}
            text, by = request["text"], request.get("by", "anonymous")
        except (ValueError, KeyError, TypeError, AttributeError):
            raise _CommandRefused('A mark is JSON, such as {"text": "the cat came", "by": "me"}') from None
        if not (
            isinstance(text, str)
            and isinstance(by, str)
            and 0 < len(text) <= MAX_MARK_CHARACTERS
            and len(by) <= MAX_MARK_CHARACTERS
        ):
            raise _CommandRefused(
                f"`text` must have 1 to {MAX_MARK_CHARACTERS} characters, `by` at most {MAX_MARK_CHARACTERS}"
            )
        now = self._now()
        self._service.publish_mark(messages.log_message(now, Level.INFO, by, text), now)
        with contextlib.suppress(OSError):  # the disk is full: the bus has the mark, and `close` writes it
            self._session.mark(text, by, now)
        self._last = self._status()

"""The recorder: everything of one fleet that comes over the bus, into sessions. One more subscriber, no policy.

Three threads. One takes what comes off Zenoh's channels and never touches a disk: a disk that hangs must show as drops
here, not as a session that stalls its senders. One asks publishers again for what was missed (recall.py). The third
writes (tape.py), flushes and tells the status each second, and answers.
"""

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import zenoh

from fleet.recording.writing.backfill import Backfill
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas import keys, messages
from schemas.bus import Bus, Sample, reply_value
from schemas.gen import fleet_v1_pb2
from schemas.topics import TOPICS

LIMIT_MESSAGES: Final = 100_000
LIMIT_BYTES: Final = 64 << 20
"""What may wait for the writer: some seconds of a hundred cars, and little beside the memory of a small computer."""
PERIOD_S: Final = 1.0
"""Flush and status; what a crash loses at most."""
TICK_S: Final = 0.01
"""How long messages gather before they are taken. Their log_time is that moment; their publish_time is exact."""
WRITE_S: Final = 0.05
"""How long they gather again before they are written."""
CHANNEL: Final = 16_384
"""What a channel holds until it is taken: three seconds of a hundred cars."""
ROUND: Final = 4_096
"""Taken from one channel before the others have their turn."""
LINGER_S: Final = 0.3
"""What was published before we were told to end is still under way."""
ANSWER_S: Final = 5.0
"""Another recorder answers between two looks at its disk, which may take a while."""
QUESTIONS: Final = 64
LONGEST_MARK: Final = 1000

STATUS: Final = TOPICS["@recorder/status"]
MARK: Final = TOPICS["@recorder/mark"]
VERBS: Final = ("start", "stop", "status", "mark")
"""Under `<fleet>/@recorder/@cmd/`; mark takes JSON: `text`, and `by` whom."""


class AnotherRecorder(Exception):
    """This fleet is being recorded already; its text says where."""


class RecordingFailed(Exception):
    """The session could not be written to its end; its text says why, and what is there."""


class _Refused(Exception):
    """What was asked over the bus cannot be; its text is the answer."""


@dataclass(frozen=True, slots=True)
class RecordingOutcome:
    """What a recording holds; numbers by key only where something was lost."""

    session: Path
    messages: int
    bytes: int
    drops: Mapping[str, int]
    missed: Mapping[str, int]
    error: str = ""
    """What the end cost for want of room."""


_Item = tuple[str, bytes, zenoh.Encoding, "zenoh.Timestamp | None", "zenoh.SourceInfo | None", int]


class Recorder:
    """Records from `start` to `close`. If the disk fails, `ended` is set and `close` raises RecordingFailed.

    A disk that is full is waited for, also at the start: `full` says so then.

    `tell` hears what a person should know: a full disk, an old session that was removed, a session that begins.
    """

    def __init__(
        self,
        bus: Bus,
        fleet: str,
        root: Path,
        options: Options | None = None,
        *,
        limit_messages: int = LIMIT_MESSAGES,
        limit_bytes: int = LIMIT_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
        tell: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._bus = bus
        self._fleet = keys.check_name(fleet, "fleet name")
        self._root = root
        self._options = options or Options()
        self._limit_messages = limit_messages
        self._limit_bytes = limit_bytes
        self._now = wall_ns
        self._tell = tell
        self._told: set[str] = set()
        self._lock = threading.Lock()
        self._waiting: list[_Item] = []
        self._writing: Iterator[_Item] = iter(())
        self._held_messages = 0
        self._held_bytes = 0
        self._questions: list[zenoh.Query] = []
        self._closing = threading.Event()
        self._taken = threading.Event()
        self._reader_error: Exception | None = None
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        self._error = ""
        self._recording = True
        self.ended = threading.Event()
        """The writer has ended: closed, or failed."""

    def start(self) -> Path:
        """Return the session's directory once every subscription is declared.

        Raises AnotherRecorder, and OSError if the session cannot be made for anything but want of room.
        """
        self._refuse_a_second()
        for expression in keys.recorded(self._fleet):
            self._subscribers.append(self._bus.subscribe_channel(expression, CHANNEL))
        self._tape = SessionWriter(self._root, self._fleet, self._options, self._now())
        self._drops = self._tape.drops
        session = self._tape.path
        key = keys.topic_key(self._fleet, keys.RECORDER, STATUS.name.partition("/")[2])
        self._publisher = self._bus.publisher(key, STATUS, keys.RECORDER)
        marks = keys.topic_key(self._fleet, keys.RECORDER, MARK.name.partition("/")[2])
        self._marks = self._bus.publisher(marks, MARK, keys.RECORDER)
        self._last = self._status()
        self._recall = Backfill(self._bus, keys.recorded(self._fleet), follows=bool(self._tape.description.continues))
        self._reader = threading.Thread(target=self._read, name="bus-reader")
        self._writer = threading.Thread(target=self._write, name="mcap-writer")
        self._reader.start()
        self._writer.start()
        self._recall.start()
        self._bus.queryable(key, self._ask)
        self._bus.queryable(keys.command_key(self._fleet, keys.RECORDER, "*"), self._ask)
        token = keys.car_token(self._fleet, keys.RECORDER)
        self._bus.token(token)
        # Declaring does not wait for the hub. Its answer comes after it has passed our subscriptions on to all.
        self._bus.tokens(token)
        return session

    @property
    def full(self) -> str:
        """Why nothing is written for now; empty if it is."""
        return self._tape.full

    def close(self) -> RecordingOutcome:
        """Write what has come until now, and close the session whole; raises RecordingFailed."""
        if not self.ended.is_set():
            time.sleep(LINGER_S)
        self._recall.close()
        self._closing.set()
        self._reader.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        self._subscribers.clear()
        self._writer.join()
        if self._error:
            raise RecordingFailed(self._error)
        tape = self._tape
        return RecordingOutcome(tape.path, tape.messages, tape.bytes, dict(tape.drops), tape.missed, tape.cost)

    def _refuse_a_second(self) -> None:
        if not self._bus.tokens(keys.car_token(self._fleet, keys.RECORDER)):
            return
        where = "it does not say where to"
        for answer in self._bus.query(f"{self._fleet}/{STATUS.name}", timeout_s=ANSWER_S):
            if isinstance(answer, Sample):
                message: Any = answer.message()
                where = f"to {message.session}"
        raise AnotherRecorder(f"fleet {self._fleet!r} is being recorded already, {where}: one recorder is enough")

    def _ask(self, query: zenoh.Query) -> bool:
        """On a Zenoh thread; False if too many wait."""
        with self._lock:
            if self.ended.is_set():
                return True  # nobody answers any more
            if len(self._questions) >= QUESTIONS:
                return False
            self._questions.append(query)
        return True

    # ------------------------------------------------------------------ the reader's thread

    def _read(self) -> None:
        try:
            while not self._closing.is_set():
                if not self._take():
                    time.sleep(TICK_S)  # an Event's wait costs several times as much
            while self._take():
                pass
        except Exception as error:  # noqa: BLE001 - handed to the writer, which says it: never silently
            self._reader_error = error
        finally:
            self._taken.set()

    def _take(self) -> bool:
        """Take what has come; whether there may be more."""
        with self._lock:
            messages, size = self._held_messages, self._held_bytes
        batch: list[_Item] = []
        more = False
        for subscriber in self._subscribers:
            receive = subscriber.try_recv
            for _ in range(ROUND):
                sample = receive()
                if sample is None:
                    break
                # Copied here: a payload that is kept keeps the network batch it came in, and the byte limit would lie.
                payload = sample.payload.to_bytes()
                key = str(sample.key_expr)
                if messages >= self._limit_messages or size + len(payload) > self._limit_bytes:
                    self._drops[key] = self._drops.get(key, 0) + 1
                    continue
                messages += 1
                size += len(payload)
                batch.append((key, payload, sample.encoding, sample.timestamp, sample.source_info, self._now()))
            else:
                more = True
        if batch:
            taken = sum(len(item[1]) for item in batch)
            with self._lock:
                self._held_messages += len(batch)
                self._held_bytes += taken
                self._waiting += batch
        return more

    # ------------------------------------------------------------------ the writer's thread

    def _write(self) -> None:
        try:
            due = time.monotonic()
            while not self._taken.wait(WRITE_S):
                self._drain()
                if time.monotonic() >= due:
                    due = max(due + PERIOD_S, time.monotonic())
                    self._each_second()
                self._answer()
            self._drain()
            if self._reader_error is not None:
                self._fail(f"{type(self._reader_error).__name__}: {self._reader_error}")
                return
            if self._recording:
                self._end(self._tape)
            self._publish("closed")
        except OSError as error:
            self._fail(f"{error.filename or self._tape.path}: {error.strerror or error}")
        except Exception as error:  # noqa: BLE001 - a recorder that stops must never do so silently, whatever the cause
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            self.ended.set()
            self._answer()

    def _drain(self) -> None:
        with self._lock:
            batch, self._waiting = self._waiting, []
        recalled = self._recall.taken()
        if self._recording:
            add = self._tape.add
            self._writing = iter(batch)
            for item in self._writing:
                add(*item)
            for sample in recalled:
                self._tape.add_recalled(sample, self._now())
            if self._tape.gaps:
                # What found no room here would find none again.
                self._recall.ask(self._tape.gaps.difference(self._drops))
                self._tape.gaps.clear()
        # Only now: what is being written is still held.
        with self._lock:
            self._held_messages -= len(batch)
            self._held_bytes -= sum(len(item[1]) for item in batch)

    def _each_second(self) -> None:
        tape = self._tape
        if self._recording:
            tape.tick(self._now())
            if tape.over and not tape.full:
                self._begin()
                self._end(tape)
        self._say_once(self._tape)
        self._publish()

    def _begin(self) -> None:
        """The next session; raises OSError if none can be made."""
        self._tape = SessionWriter(self._root, self._fleet, self._options, self._now())
        self._drops = self._tape.drops
        if not self._tape.full:
            self._tell(f"recording fleet {self._fleet} to {self._tape.path}")

    def _end(self, tape: SessionWriter) -> None:
        """Close a session."""
        tape.close(self._now())
        self._say_once(tape)

    def _say_once(self, tape: SessionWriter) -> None:
        """Tell what is new of what should be known."""
        for session in tape.removed:
            self._tell(f"{session} was removed: the oldest that nobody marked, to keep the quota")
        for words in tape.uncopied:
            self._tell(words)
        tape.removed.clear()
        tape.uncopied.clear()
        states = {"full": tape.full, "warning": "" if tape.full else tape.warning.partition(",")[0]}
        now = {f"{kind}: {text}" for kind, text in states.items() if text}
        for text in sorted(now - self._told):
            self._tell(text)
        if any(text.startswith("full") for text in self._told) and not tape.full and self._recording:
            self._tell(f"there is room again: recording goes on to {tape.path}")
        self._told = now

    def _fail(self, words: str) -> None:
        with self._lock:
            self._limit_messages = 0
            unwritten, self._waiting = [*self._writing, *self._waiting], []
        for item in unwritten:
            self._tape.drop(item[0])
        self._error = self._tape.abandon(f"recording to {self._tape.path} failed: {words}", self._now())
        # From the last status: asking the disk again may fail again.
        self._last.state, self._last.error, self._last.messages = "failed", self._error, self._tape.messages
        self._last.drops.update(self._tape.drops)
        with contextlib.suppress(zenoh.ZError):  # the bus may be why; `close` says it, and session.json
            self._publisher.put(self._last, self._now())

    def _status(self, state: str = "") -> fleet_v1_pb2.Recording:
        tape = self._tape
        return fleet_v1_pb2.Recording(
            session=str(tape.path),
            state=state or ("stopped" if not self._recording else "full" if tape.full else "recording"),
            bytes=tape.bytes,
            messages=tape.messages,
            drops=dict(tape.drops),
            free_bytes=tape.free_bytes,
            error=self._error or tape.cost or (f"{tape.full}; {tape.waiting} messages wait" if tape.full else ""),
            missed=tape.missed,
            recovered=tape.recovered,
            segments=tape.segments,
            warning=tape.warning,
        )

    def _publish(self, state: str = "") -> None:
        self._last = self._status(state)
        self._publisher.put(self._last, self._now())

    # ------------------------------------------------------------------ what is asked

    def _answer(self) -> None:
        with self._lock:
            questions, self._questions = self._questions, []
        for query in questions:
            with query:
                key = str(query.key_expr)
                verb = key.rpartition("/")[2] if "/@cmd/" in key else "status"
                try:
                    self._do(verb, query)
                except _Refused as refused:
                    query.reply_err(str(refused), encoding="text/plain")
                else:
                    reply_value(query, key, self._last.SerializeToString(), STATUS)

    def _do(self, verb: str, query: zenoh.Query) -> None:
        if self.ended.is_set() and verb != "status":
            raise _Refused("the recorder is ending")
        match verb:
            case "start":
                self._start_again()
            case "stop":
                self._stop()
            case "mark":
                self._mark(query)
            case "status":
                if not self.ended.is_set():
                    self._last = self._status()
            case _:
                raise _Refused(f"{verb!r} is not known: allowed are {', '.join(VERBS)}")

    def _start_again(self) -> None:
        if self._recording:
            raise _Refused(f"fleet {self._fleet!r} is being recorded already, to {self._tape.path}")
        try:
            self._begin()
        except OSError as error:
            raise _Refused(f"no session can be made in {self._root}: {error.strerror}") from None
        self._recording = True
        self._publish()

    def _stop(self) -> None:
        if not self._recording:
            raise _Refused(f"nothing is being recorded; the last session is {self._tape.path}")
        self._drain()
        self._end(self._tape)
        self._recording = False
        self._tell(f"{self._tape.path} is closed, as was asked{'; ' * bool(self._tape.cost)}{self._tape.cost}")
        self._publish()

    def _mark(self, query: zenoh.Query) -> None:
        if not self._recording:
            raise _Refused("nothing is being recorded: `fleet record start` begins a session")
        try:
            asked = json.loads(query.payload.to_bytes()) if query.payload is not None else {}
            text, by = asked["text"], asked.get("by", "anonymous")
        except (ValueError, KeyError, TypeError, AttributeError):
            raise _Refused('a mark is JSON, as {"text": "the cat came", "by": "me"}') from None
        if not (isinstance(text, str) and isinstance(by, str) and 0 < len(text) <= LONGEST_MARK >= len(by)):
            raise _Refused(f"text must have 1 to {LONGEST_MARK} characters, and by at most so many")
        now = self._now()
        message: Any = messages.message_class("foxglove.Log")()
        message.timestamp.seconds, message.timestamp.nanos = divmod(now, 1_000_000_000)
        message.level, message.name, message.message = 2, by, text
        self._marks.put(message, now)
        with contextlib.suppress(OSError):  # no room for it now: it is told on the bus, and written at the end
            self._tape.mark(text, by, now)

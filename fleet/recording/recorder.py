"""The recorder: everything of one fleet that comes over the bus, into one session. One more subscriber, no policy.

Two threads. One takes what comes off Zenoh's channels and never touches a disk: a disk that hangs must show as drops
here, not as a session that stalls its senders. The other writes: file, flush and status each second, answers.
"""

import contextlib
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import zenoh

from fleet.recording import directory
from fleet.recording.segment import Segment
from schemas import keys
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
LINGER_S: Final = 0.1
"""What was published before we were told to end is still under way."""
QUESTIONS: Final = 64

STATUS: Final = TOPICS["@recorder/status"]


class AnotherRecorder(Exception):
    """This fleet is being recorded already; its text says where."""


class RecordingFailed(Exception):
    """The session could not be written to its end; its text says why, and what is there."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a recording holds; numbers by key only where something was lost."""

    session: Path
    messages: int
    bytes: int
    drops: Mapping[str, int]
    missed: Mapping[str, int]


_Item = tuple[str, bytes, zenoh.Encoding, "zenoh.Timestamp | None", "zenoh.SourceInfo | None", int]


class Recorder:
    """Records from `start` to `close`. If the disk fails, `ended` is set and `close` raises RecordingFailed."""

    def __init__(
        self,
        bus: Bus,
        fleet: str,
        root: Path,
        *,
        limit_messages: int = LIMIT_MESSAGES,
        limit_bytes: int = LIMIT_BYTES,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._bus = bus
        self._fleet = keys.check_name(fleet, "fleet name")
        self._root = root
        self._limit_messages = limit_messages
        self._limit_bytes = limit_bytes
        self._now = wall_ns
        self._lock = threading.Lock()
        self._waiting: list[_Item] = []
        self._held_messages = 0
        self._held_bytes = 0
        self._drops: dict[str, int] = {}
        self._questions: list[zenoh.Query] = []
        self._closing = threading.Event()
        self._taken = threading.Event()
        self._reader_error: Exception | None = None
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        self._error = ""
        self.ended = threading.Event()
        """The writer has ended: closed, or failed."""

    def start(self) -> Path:
        """Return the session's directory once every subscription is declared.

        Raises AnotherRecorder, and OSError if the session cannot be made.
        """
        self._refuse_a_second()
        self.session, self._description = directory.create(self._root, self._fleet, self._wall())
        about = {"fleet": self._fleet, "started": self._description.started, "host": self._description.host}
        self._segment = Segment(
            directory.segment(self.session, 1), {**about, **self._description.versions, "format": str(directory.FORMAT)}
        )
        key = keys.topic_key(self._fleet, keys.RECORDER, STATUS.name.partition("/")[2])
        self._publisher = self._bus.publisher(key, STATUS, keys.RECORDER)
        self._last = self._status("recording")
        for expression in keys.recorded(self._fleet):
            self._subscribers.append(self._bus.subscribe_channel(expression, CHANNEL))
        self._reader = threading.Thread(target=self._read, name="bus-reader")
        self._writer = threading.Thread(target=self._write, name="mcap-writer")
        self._reader.start()
        self._writer.start()
        self._bus.queryable(key, self._ask)
        token = keys.car_token(self._fleet, keys.RECORDER)
        self._bus.token(token)
        # Declaring does not wait for the hub. Its answer comes after it has passed our subscriptions on to all.
        self._bus.tokens(token)
        return self.session

    def close(self) -> Outcome:
        """Write what has come until now, and close the session whole; raises RecordingFailed."""
        if not self.ended.is_set():
            time.sleep(LINGER_S)
        self._closing.set()
        self._reader.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub has no return type
        self._subscribers.clear()
        self._writer.join()
        if self._error:
            raise RecordingFailed(self._error)
        return Outcome(self.session, self._segment.messages, self._size, dict(self._drops), dict(self._segment.missed))

    def _refuse_a_second(self) -> None:
        if not self._bus.tokens(keys.car_token(self._fleet, keys.RECORDER)):
            return
        where = "it does not say where to"
        for answer in self._bus.query(f"{self._fleet}/{STATUS.name}"):
            if isinstance(answer, Sample):
                message: Any = answer.message()
                where = f"to {message.session}"
        raise AnotherRecorder(f"fleet {self._fleet!r} is being recorded already, {where}: one recorder is enough")

    def _wall(self) -> datetime:
        return datetime.fromtimestamp(self._now() / 1e9, UTC)

    def _ask(self, query: zenoh.Query) -> None:
        with self._lock:
            if len(self._questions) < QUESTIONS and not self.ended.is_set():
                self._questions.append(query)

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
                    self._segment.flush()
                    self._publish("recording")
                self._answer()
            self._drain()
            if self._reader_error is not None:
                self._fail(f"{type(self._reader_error).__name__}: {self._reader_error}")
                return
            self._segment.finish(dict(self._drops))
            self._describe(closed=True)
            self._publish("closed")
        except OSError as error:
            self._fail(f"{error.filename or self._segment.path}: {error.strerror or error}")
        except Exception as error:  # noqa: BLE001 - a recorder that stops must never do so silently, whatever the cause
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            self._answer()
            self.ended.set()

    def _drain(self) -> None:
        with self._lock:
            batch, self._waiting = self._waiting, []
        add = self._segment.add
        size = 0
        for item in batch:
            add(*item)
            size += len(item[1])
        # Only now: what is being written is still held.
        with self._lock:
            self._held_messages -= len(batch)
            self._held_bytes -= size

    def _fail(self, words: str) -> None:
        self._error = f"recording to {self.session} failed: {words}. What was written until then is whole"
        self._limit_messages = 0
        self._segment.abandon()
        # From the last status: asking the disk again may fail again.
        self._last.state, self._last.error, self._last.messages = "failed", self._error, self._segment.messages
        self._publisher.put(self._last, self._now())
        with contextlib.suppress(OSError):  # the disk that failed; said already
            self._describe(closed=False)

    def _describe(self, *, closed: bool) -> None:
        description = self._description
        description.ended, description.closed = directory.iso(self._wall()), closed
        description.messages, description.error = self._segment.messages, self._error
        description.drops = dict(self._drops)
        description.missed = dict(self._segment.missed)
        description.write(self.session)

    @property
    def _size(self) -> int:
        return self._segment.path.stat().st_size

    def _status(self, state: str) -> fleet_v1_pb2.Recording:
        return fleet_v1_pb2.Recording(
            session=str(self.session),
            state=state,
            bytes=self._size,
            messages=self._segment.messages,
            drops=dict(self._drops),
            free_bytes=shutil.disk_usage(self.session).free,
            error=self._error,
            missed=self._segment.missed,
        )

    def _publish(self, state: str) -> None:
        self._last = self._status(state)
        self._publisher.put(self._last, self._now())

    def _answer(self) -> None:
        with self._lock:
            questions, self._questions = self._questions, []
        for query in questions:
            with query:
                reply_value(query, self._publisher.key, self._last.SerializeToString(), STATUS)

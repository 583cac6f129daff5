"""Shows a running fleet in Rerun, as one more subscriber of the bus.

Twice a second the new messages are written to a small MCAP file, which then passes Rerun's reader, the lenses and the
drawings as a recording does. A thread drains the subscriptions. If the viewer stalls, further messages are counted and
dropped, so that memory stays bounded.
"""

import tempfile
import threading
import time
from collections.abc import Callable
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Final

import rerun as rr
import rerun.chunk as rrc
from google.protobuf.message import DecodeError
from mcap.writer import CompressionType, Writer

from fleet.client.supervision import ask_colors
from fleet.recording.left_out import LeftOut, LeftOutCause, has_unknown_enum, may_have_enum
from fleet.replay.panels import ON_CHANGE_TOPICS
from fleet.replay.rerun import blueprint
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import lenses
from fleet.replay.rerun.rrd_export import APPLICATION
from schemas import keys, messages, topics
from schemas.bus import Bus, Sample, sample_of

VIEW_INTERVAL_S: Final = 0.5
VIEW_READ_INTERVAL_S: Final = 0.02
VIEW_QUEUE_SIZE: Final = 16_384
"""Maximum number of messages in the queue of one subscription."""
MAX_WAITING_MESSAGES: Final = 50_000
"""Maximum number of messages in the queue to the viewer."""
MAX_PATH_POINTS: Final = 3_000
"""Maximum number of points of the path of each car: five minutes of a simulated car, which publishes ten a second."""
DEFAULT_VIEW_S: Final = 120.0
"""Time span that the view shows by default. It can also show all."""
VIEWER_FLUSH_TIMEOUT_S: Final = 2.0
COORDINATOR_TIMEOUT_S: Final = 3.0
"""Timeout for the coordinator's answer. If there is no coordinator, nobody waits."""


class Live:
    """Follows one fleet from `start` to `close`. `step` sends new messages to the viewer or file."""

    def __init__(
        self, bus: Bus, fleet: str, sink: Callable[[rr.RecordingStream], None], last_s: float | None = DEFAULT_VIEW_S
    ) -> None:
        self._bus = bus
        self._fleet = keys.check_name(fleet, "fleet name")
        self._drawing = Drawing(MAX_PATH_POINTS, ask_colors(bus, self._fleet))
        self._last_s = last_s
        self._layout_contents: frozenset[object] = frozenset()
        self._lock = threading.Lock()
        self._queue: list[Sample] = []
        self._closing = threading.Event()
        self._subscribers: list[Any] = []
        self._reader = threading.Thread(target=self._read, name="bus-reader")
        self._viewer_stalled = False
        self._batch = 0
        self._scratch = tempfile.TemporaryDirectory(prefix="fleet-view-")
        self.dropped = 0
        """Messages dropped because the viewer stalled."""
        self.left_out = LeftOut()
        """Messages that Rerun does not show."""
        self._recording = rr.RecordingStream(
            APPLICATION, recording_id=f"live {time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
        )
        sink(self._recording)

    def start(self) -> None:
        """Subscribe, and query the topics of ON_CHANGE_TOPICS."""
        for expression in keys.recorded_keys(self._fleet):
            self._subscribers.append(self._bus.subscribe_channel(expression, VIEW_QUEUE_SIZE))
        self._reader.start()
        for topic in ON_CHANGE_TOPICS:
            found = self._bus.query(f"{self._fleet}/{topic}", timeout_s=COORDINATOR_TIMEOUT_S)
            answers = [each for each in found if isinstance(each, Sample)]
            with self._lock:
                self._queue += answers

    def step(self) -> int:
        """Send the new messages that Rerun can show, and return the number of all new ones."""
        if self._viewer_stalled and not self._flush():
            return 0
        with self._lock:
            batch, self._queue = self._queue, []
        if batch:
            path = Path(self._scratch.name) / f"{self._batch % 2}.mcap"
            self._batch += 1
            _write(path, batch, self.left_out)
            chunks = self._drawing.follow(rrc.McapReader(path).stream())
            self._recording.send_chunks(
                rrc.LazyChunkStream.from_iter(chunks).lenses(lenses(), output_mode="forward_all")
            )
            self._recording.send_chunks(
                rrc.LazyChunkStream.from_iter(chain(self._drawing.ends(), self._drawing.static()))
            )
        self._update_layout()
        self._viewer_stalled = not self._flush()
        return len(batch)

    @property
    def sent(self) -> int:
        """Return the number of messages sent."""
        return self._drawing.counts.total()

    @property
    def cars(self) -> tuple[str, ...]:
        """Return the cars seen so far."""
        return tuple(self._drawing.contents().cars)

    def close(self, *, send: bool = True) -> None:
        """End the connection to the viewer. If `send`, send the queued messages first."""
        self._closing.set()
        if self._reader.is_alive():
            self._reader.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        if send:
            if self._last_s is None:
                self._layout_contents = frozenset()  # the layout needs the whole time span, which is known only now
            self.step()
        self._recording.disconnect()
        self._scratch.cleanup()

    def _update_layout(self) -> None:
        """Send a new layout, but only if there is new content, because it replaces what the user has arranged."""
        contents = frozenset(self._drawing.counts) | self._drawing.tracks
        if contents == self._layout_contents:
            return
        self._layout_contents = contents
        self._recording.send_blueprint(
            blueprint.layout(self._drawing, last_s=self._last_s), make_active=True, make_default=True
        )

    def _flush(self) -> bool:
        try:
            self._recording.flush(timeout_sec=VIEWER_FLUSH_TIMEOUT_S)
        except RuntimeError:  # Rerun's error for a timeout
            return False
        return True

    # ------------------------------------------------------------------ the reader's thread

    def _read(self) -> None:
        while not self._closing.is_set():
            if not self._read_batch():
                time.sleep(VIEW_READ_INTERVAL_S)
        self._read_batch()

    def _read_batch(self) -> int:
        batch: list[Sample] = []
        for subscriber in self._subscribers:
            while len(batch) < VIEW_QUEUE_SIZE and (sample := subscriber.try_recv()) is not None:
                batch.append(sample_of(sample))
        with self._lock:
            free = max(0, MAX_WAITING_MESSAGES - len(self._queue))
            self._queue += batch[:free]
            self.dropped += max(0, len(batch) - free)
        return len(batch)


def _write(path: Path, batch: list[Sample], left_out: LeftOut) -> None:
    """Write to an MCAP file the messages of a batch that Rerun can show, and count the rest."""
    now = time.time_ns()
    schemas: dict[str, int] = {}
    channels: dict[str, tuple[str, int]] = {}
    with path.open("wb") as file:
        # Without compression and CRCs: we read the file back at once.
        writer: Any = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start()
        for sample in batch:
            if sample.deleted:
                continue
            name = messages.name_in(sample.encoding)
            cause = _why_not_shown(sample, name)
            if cause is None and name is not None:
                if name not in schemas:
                    schemas[name] = writer.register_schema(name, "protobuf", messages.descriptor_set(name))
                if sample.key not in channels:
                    channels[sample.key] = name, writer.register_channel(sample.key, "protobuf", schemas[name])
                # Rerun reads all messages of a key with one schema, chosen at random.
                first, channel = channels[sample.key]
                if name == first:
                    writer.add_message(channel, now, sample.payload, sample.time_ns, sample.sequence)
                    continue
                cause = LeftOutCause.OTHER_TYPE
            left_out.add(sample.key, cause or LeftOutCause.NOT_PROTOBUF)
        writer.finish()


def _why_not_shown(sample: Sample, name: str | None) -> LeftOutCause | None:
    if name is None:
        return LeftOutCause.NOT_PROTOBUF
    topic = topics.of_key(sample.key)
    if topic is not None and name != topic.message:
        return LeftOutCause.OTHER_TYPE
    try:
        message_class = messages.message_class(name)
        message = message_class.FromString(sample.payload)
        if _may_have_enum(name) and has_unknown_enum(message):
            return LeftOutCause.UNKNOWN_ENUM
    except KeyError:
        return LeftOutCause.BAD_SCHEMA
    except DecodeError:
        return LeftOutCause.UNREADABLE
    return None


@cache
def _may_have_enum(name: str) -> bool:
    return may_have_enum(messages.message_class(name).DESCRIPTOR)

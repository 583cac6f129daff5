"""The fleet as it is now, in Rerun: one more subscriber of the bus, that may come and go.

Twice a second what came becomes a small MCAP, and goes the way of a recording: Rerun's reader, the same lenses, the
same drawings. One thread takes what comes off Zenoh's channels; who sends may wait for a viewer that hangs: what then
finds no room is counted and left out, so memory stays within bounds.
"""

import tempfile
import threading
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any, Final

import rerun as rr
import rerun.chunk as rrc
from mcap.writer import CompressionType, Writer

from fleet.replay.rerun import blueprint
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.export import APPLICATION
from fleet.replay.rerun.lenses import lenses
from schemas import keys, messages
from schemas.bus import Bus, Sample, sample_of

BATCH_S: Final = 0.5
TICK_S: Final = 0.02
CHANNEL: Final = 16_384
"""What a channel of the bus holds until it is taken."""
LIMIT: Final = 50_000
"""Messages that wait for the viewer."""
WAY: Final = 3_000
"""Points of each simulated car's way that are shown: five minutes."""
SHOWN_S: Final = 120.0
"""Of curves and lanes so much is in view, unless it is to be the whole time."""
FLUSH_S: Final = 2.0
_KEPT: Final = (f"{keys.COORDINATOR}/plan", f"{keys.COORDINATOR}/assignment")
"""Published only when they change: asked for at the start."""
ANSWER_S: Final = 3.0
"""A coordinator that is slow to answer is waited for; where there is none nothing is."""


class Live:
    """Follows one fleet from `start` to `close`; `step` brings what came to the viewer or file."""

    def __init__(
        self, bus: Bus, fleet: str, sink: Callable[[rr.RecordingStream], None], last_s: float | None = SHOWN_S
    ) -> None:
        self._bus = bus
        self._fleet = keys.check_name(fleet, "fleet name")
        self._drawing = Drawing(WAY)
        self._last_s = last_s
        self._shown: frozenset[object] = frozenset()
        self._lock = threading.Lock()
        self._waiting: list[Sample] = []
        self._closing = threading.Event()
        self._subscribers: list[Any] = []
        self._reader = threading.Thread(target=self._read, name="bus-reader")
        self._stuck = False
        self._batch = 0
        self._scratch = tempfile.TemporaryDirectory(prefix="fleet-view-")
        self.dropped = 0
        """What found no room because the viewer did not take it."""
        self._recording = rr.RecordingStream(
            APPLICATION, recording_id=f"live {time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
        )
        sink(self._recording)

    def start(self) -> None:
        """Subscribe, and ask for what is published only when it changes."""
        for expression in keys.recorded(self._fleet):
            self._subscribers.append(self._bus.subscribe_channel(expression, CHANNEL))
        self._reader.start()
        for topic in _KEPT:
            found = self._bus.query(f"{self._fleet}/{topic}", timeout_s=ANSWER_S)
            kept = [each for each in found if isinstance(each, Sample)]
            with self._lock:
                self._waiting += kept

    def step(self) -> int:
        """Send what has come; how many messages that were."""
        if self._stuck and not self._flushed():
            return 0
        with self._lock:
            batch, self._waiting = self._waiting, []
        if batch:
            path = Path(self._scratch.name) / f"{self._batch % 2}.mcap"
            self._batch += 1
            _write(path, batch)
            chunks = self._drawing.follow(rrc.McapReader(path).stream())
            self._recording.send_chunks(
                rrc.LazyChunkStream.from_iter(chunks).lenses(lenses(), output_mode="forward_all")
            )
            self._recording.send_chunks(
                rrc.LazyChunkStream.from_iter(chain(self._drawing.ends(), self._drawing.still()))
            )
        self._lay_out()
        self._stuck = not self._flushed()
        return len(batch)

    @property
    def held(self) -> int:
        """Messages that were sent."""
        return self._drawing.held.total()

    @property
    def cars(self) -> tuple[str, ...]:
        """The cars that were seen."""
        return tuple(self._drawing.contents().cars)

    def close(self, *, send: bool = True) -> None:
        """Send what came until now, if there is somebody to send it to, and end."""
        self._closing.set()
        if self._reader.is_alive():
            self._reader.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        if send:
            if self._last_s is None:
                self._shown = frozenset()  # the whole time is known only now
            self.step()
        self._recording.disconnect()
        self._scratch.cleanup()

    def _lay_out(self) -> None:
        """A layout for what there is; only when there is something new, since it takes the place of the user's."""
        there = frozenset(self._drawing.held) | self._drawing.lanes
        if there == self._shown:
            return
        self._shown = there
        self._recording.send_blueprint(
            blueprint.layout(self._drawing, last_s=self._last_s), make_active=True, make_default=True
        )

    def _flushed(self) -> bool:
        try:
            self._recording.flush(timeout_sec=FLUSH_S)
        except RuntimeError:  # how it says that the viewer did not take it in time
            return False
        return True

    # ------------------------------------------------------------------ the reader's thread

    def _read(self) -> None:
        while not self._closing.is_set():
            if not self._take():
                time.sleep(TICK_S)
        self._take()

    def _take(self) -> int:
        taken: list[Sample] = []
        for subscriber in self._subscribers:
            while len(taken) < CHANNEL and (sample := subscriber.try_recv()) is not None:
                taken.append(sample_of(sample))
        with self._lock:
            room = max(0, LIMIT - len(self._waiting))
            self._waiting += taken[:room]
            self.dropped += max(0, len(taken) - room)
        return len(taken)


def _write(path: Path, batch: list[Sample]) -> None:
    """A batch as an MCAP."""
    now = time.time_ns()
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    with path.open("wb") as file:
        # Neither compressed nor checked: it is read back at once, by us.
        writer: Any = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start()
        for sample in batch:
            name = messages.name_in(sample.encoding)
            if name is None or sample.deleted:
                continue  # Rerun shows protobuf only
            if name not in schemas:
                try:
                    descriptors = messages.descriptor_set(name)
                except KeyError:
                    continue
                schemas[name] = writer.register_schema(name, "protobuf", descriptors)
            where = (sample.key, name)
            if where not in channels:
                channels[where] = writer.register_channel(sample.key, "protobuf", schemas[name])
            writer.add_message(channels[where], now, sample.payload, sample.time_ns, sample.sequence)
        writer.finish()

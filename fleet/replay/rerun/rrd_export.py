"""Exports a session to an .rrd file with its layout, using Rerun's MCAP reader and lenses.

Also counts the messages of an .rrd. The .rrd contains every message that Rerun can read, unchanged. lenses.py and
drawings.py add what the viewer draws.
"""

import re
import shutil
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Final

import rerun as rr
import rerun.chunk as rrc
from msgspec import Struct

from fleet.fleetfile.fleet_file import read_colors
from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import Selection
from fleet.recording.session_dir import FLEET_FILE
from fleet.recording.tools.summary import total
from fleet.recording.tools.tables import car_of
from fleet.replay import panels
from fleet.replay.rerun import blueprint
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import MESSAGE_SUFFIX, RAW, TEXT, is_drawn, lenses
from fleet.replay.rerun.prepare import Prepared, as_recorded, copied, unreadable
from schemas.topics import TOPICS

APPLICATION: Final = "zenoh-car-fleet"
_BAD_SCHEMA: Final = re.compile(r"Invalid schema ([\w.]+)")
"""Found in Rerun's error for a file that has a damaged schema. We can read such a file, but Rerun reads nothing of
it."""
_BAD_FIELD: Final = re.compile(rf"Lenses error: .* input: `([\w.]+){MESSAGE_SUFFIX}`")
"""Found in Rerun's error for a field that is drawn, but has another type in a file."""
_INTERRUPT: Final = re.compile(rf"\b{KeyboardInterrupt.__name__}\b")
_CLOSING_POLL_S: Final = 0.05
STALLED_S: Final = 30.0
"""Time without a byte in the file after which the writer counts as stopped. A slow disk takes a few seconds."""
_TOPIC: Final = "McapChannel:topic"
_LOGS: Final = tuple(f"/{topic.name}" for topic in TOPICS.values() if topic.message == "foxglove.Log")


class ExportFailed(Exception):
    """The .rrd could not be written. The message gives the reason."""


class Part(Struct, frozen=True):
    """The part of a session to show: cars and a time span. The fleet's services are always included."""

    cars: tuple[str, ...] = ()
    """Empty means all cars."""
    start_ns: int | None = None
    end_ns: int | None = None
    """Times of the recorder's clock, ns since the epoch; `end_ns` is excluded."""

    @property
    def selection(self) -> Selection:
        """The time span as a selection."""
        return Selection(None, self.start_ns, self.end_ns)

    def has_key(self, key: str) -> bool:
        """Return True if messages of this key are shown."""
        car = car_of(key)
        return not self.cars or car in self.cars or car.startswith("@")

    def reader(self, segment: Path) -> rrc.McapReader:
        """Return Rerun's reader for this part of a segment."""
        topics = None
        if self.cars:
            names = "|".join(re.escape(name) for name in self.cars)
            topics = [f"^[^/]+/(({names})|@[^/]*)/"]
        return rrc.McapReader(
            segment,
            include_topic_regex=topics,
            start_time_ns=self.start_ns,
            end_time_ns=self.end_ns,
            recover=True,
        )

    @property
    def words(self) -> str:
        """Return what a message of NoSession says about this part."""
        return "" if self == WHOLE_SESSION else " of these cars in this time"


WHOLE_SESSION: Final = Part()


class _SchemaRefused(Exception):
    """Rerun refuses the schema of this name, or the type of a field in it."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the schema {name} is damaged, or another program's")
        self.name = name


class Replayed(Struct, frozen=True):
    """The numbers of recorded messages that are shown and left out. Each message is one or the other."""

    shown: Counter[str]
    """Number of messages by key."""
    left_out: LeftOut


def export(
    session: Session,
    out: Path,
    part: Part = WHOLE_SESSION,
    *,
    tab: str = "",
    on_read: Callable[[int], None] = lambda _: None,
) -> Replayed:
    """Write `out`, and return which messages it shows.

    Raises OSError, ExportFailed, and NoSession if there is no message of a fleet. tab: the car whose tab is in front.
    on_read: called with the number of messages read since the last call.
    """
    whole = part == WHOLE_SESSION
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".replay-") as scratch:
        rrd = Path(scratch) / "whole.rrd"
        prepared = as_recorded(session, part.selection, part.has_key, whole=whole)
        replayed: Replayed | None = None
        refused: set[str] = set()
        if prepared is not None:
            readers = [part.reader(segment) for segment in prepared.files]
            try:
                replayed = _write(session, rrd, out, prepared, readers, part, tab, on_read)
            except _SchemaRefused as error:
                refused.add(error.name)
        while replayed is None:
            # Rerun cannot read all messages of the files, so copy them. A copy costs time and disk space, so it is made
            # only now.
            place = Path(scratch) / str(len(refused))
            place.mkdir()
            copies = copied(session, part.selection, part.has_key, place, refused)
            if not copies.recorded:
                damage = f": {session.damage_words}" if session.damage else ""
                raise NoSession(f"{session.path} has no intact message{part.words}{damage}")
            readers = [WHOLE_SESSION.reader(each) for each in copies.files]
            try:
                replayed = _write(session, rrd, out, copies, readers, part, tab, on_read, final=True)
            except _SchemaRefused as error:
                if error.name in refused:
                    raise ExportFailed(f"Rerun cannot read {session.path}: {error}") from None
                refused.add(error.name)
        rrd.replace(out)
    return replayed


def _write(
    session: Session,
    rrd: Path,
    out: Path,
    prepared: Prepared,
    readers: list[rrc.McapReader],
    part: Part,
    tab: str,
    on_read: Callable[[int], None],
    *,
    final: bool = False,
) -> Replayed | None:
    """Write an .rrd. Return None if Rerun did not read every message, unless this is the `final` attempt."""
    drawing = Drawing(car_colors=read_colors(session.path / FLEET_FILE))
    tally = _Tally()
    stream = rrc.LazyChunkStream.merge(*(reader.stream() for reader in readers))
    stream = rrc.LazyChunkStream.from_iter(drawing.follow(tally.follow(stream, on_read))).lenses(
        lenses(), output_mode="forward_all"
    )
    # Only a file that a recording stream writes has a layout. The layout is sent last, because it depends on all
    # messages.
    recording = rr.RecordingStream(APPLICATION, recording_id=session.name)
    recording.save(rrd)
    try:
        recording.send_chunks(stream)
    except RuntimeError as error:
        words = " ".join(str(error).split())
        if _INTERRUPT.search(words):  # Ctrl-C during a lens: Rerun turns the exception into text
            raise KeyboardInterrupt from None
        if refused := _BAD_SCHEMA.search(words) or _BAD_FIELD.search(words):
            _close(recording, rrd)
            raise _SchemaRefused(refused[1]) from None
        raise ExportFailed(f"Rerun cannot read {session.path}: {words[:200]}") from None
    replayed, missed = tally.compare(prepared)
    if missed and not final:
        _close(recording, rrd)
        return None
    _name_missed(session, part, missed, replayed.left_out)
    contents = drawing.contents()
    if not contents.cars and not contents.services:
        why = f": {'; '.join(replayed.left_out.words())}" if replayed.left_out.total else ""
        raise NoSession(f"{session.path} has no message of a fleet{part.words}{why}")
    description = session.description
    marks = drawing.added_marks(description.marks if description is not None else (), part.start_ns, part.end_ns)
    recording.send_chunks(rrc.LazyChunkStream.from_iter(chain(drawing.ends(), marks, drawing.static())))
    recording.send_blueprint(blueprint.layout(drawing, tab), make_active=False, make_default=True)
    if not (_close(recording, rrd) and _is_whole(rrd)):
        free = shutil.disk_usage(rrd.parent).free
        raise ExportFailed(
            f"{out} is incomplete: the disk is probably full ({free} bytes are free). Name another place."
        )
    return replayed


def _close(recording: rr.RecordingStream, rrd: Path) -> bool:
    """Write all that is left, and close the file. Return False if Rerun's writer has stopped before the end."""
    # After an error, as on a full disk, Rerun's writer ends. Now and then, `disconnect` then waits for it for ever.
    closing = threading.Thread(target=recording.disconnect, name="rrd-close", daemon=True)
    closing.start()
    size, grown_at = -1, time.monotonic()
    while closing.is_alive():
        closing.join(_CLOSING_POLL_S)
        if (now_size := rrd.stat().st_size) != size:
            size, grown_at = now_size, time.monotonic()
        elif time.monotonic() - grown_at > STALLED_S:
            rr.unregister_shutdown()  # at the end of this process, it would wait for this recording, too
            return False
    return True


def _is_whole(rrd: Path) -> bool:
    """Return False if the file lacks its end. Rerun's writer does not report a full disk."""
    try:
        with warnings.catch_warnings(action="ignore"):
            rrc.RrdReader(rrd).store()
    except (RuntimeError, ValueError):  # a file without its end has no index
        return False
    return True


def _name_missed(session: Session, part: Part, missed: Counter[str], left_out: LeftOut) -> None:
    """Add to `left_out` the messages that Rerun did not read. Rerun skips messages that do not match their schema."""
    bad = unreadable(session, part.selection, missed.__contains__) if missed else Counter[str]()
    for key, count in missed.items():
        known = min(count, bad[key])
        left_out.add(key, LeftOutCause.UNREADABLE, known)
        left_out.add(key, LeftOutCause.VIEWER, count - known)


class _Tally:
    """Counts the messages that Rerun's reader yields, by entity and by what became of them."""

    def __init__(self) -> None:
        self._shown: Counter[str] = Counter()
        self._others: Counter[tuple[str, LeftOutCause]] = Counter()
        self._keys: dict[str, set[str]] = {}
        """Keys by entity. Keys that differ only in unusual characters may have the same entity in Rerun."""

    def follow(self, chunks: Iterable[rrc.Chunk], on_read: Callable[[int], None]) -> Iterator[rrc.Chunk]:
        """Pass on chunks and count their messages."""
        for chunk in chunks:
            names = chunk.to_record_batch().schema.names
            if not chunk.is_static:
                if is_drawn(panels.topic_of(panels.key_of(chunk.entity_path)), names):
                    self._shown[chunk.entity_path] += chunk.num_rows
                else:
                    cause = LeftOutCause.NOT_PROTOBUF if RAW in names else LeftOutCause.OTHER_TYPE
                    self._others[chunk.entity_path, cause] += chunk.num_rows
            elif _TOPIC in names:
                (topic,) = chunk.to_record_batch().column(_TOPIC).to_pylist()
                self._keys.setdefault(chunk.entity_path, set()).update(topic)
            yield chunk
            if not chunk.is_static:
                on_read(chunk.num_rows)

    def compare(self, prepared: Prepared) -> tuple[Replayed, Counter[str]]:
        """Return what became of the recorded messages, and how many Rerun did not yield, by key."""
        replayed = Replayed(Counter(), LeftOut(Counter(prepared.left_out.counts)))
        left = Counter(prepared.recorded)
        left.subtract(prepared.left_out.by_key())
        for entity, count in self._shown.items():
            for key, part in self._spread(entity, count, left):
                replayed.shown[key] += part
        for (entity, cause), count in self._others.items():
            for key, part in self._spread(entity, count, left):
                replayed.left_out.add(key, cause, part)
        return replayed, +left

    def _spread(self, entity: str, count: int, left: Counter[str]) -> Iterator[tuple[str, int]]:
        """Divide the messages of an entity among its keys. Subtract each share from `left`, and yield it."""
        for key in sorted(self._keys.get(entity, ())):
            part = min(count, left[key])
            if part > 0:
                left[key] -= part
                count -= part
                yield key, part


def count_of(session: Session) -> int:
    """Return the number of messages of a session from the indexes of its files, or 0 if it is unknown."""
    return total(session) or 0


def rows(path: Path) -> Counter[str]:
    """Return the number of drawn messages of an .rrd by key, counted with Rerun's reader."""
    counted: Counter[str] = Counter()
    for chunk in rrc.RrdReader(path).store().stream():
        if chunk.is_static:
            continue
        key = panels.key_of(chunk.entity_path)
        names = chunk.to_record_batch().schema.names
        own = any(name.endswith(MESSAGE_SUFFIX) for name in names)
        # Rerun converts foxglove.Log to text. Any other text comes from our lenses.
        if (own and is_drawn(panels.topic_of(key), names)) or (TEXT in names and key.endswith(_LOGS)):
            counted[key] += chunk.num_rows
    return counted

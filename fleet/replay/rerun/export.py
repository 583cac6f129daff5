"""Exports a session to an .rrd with its layout, using Rerun's MCAP reader and lenses, and counts the messages of one.

The .rrd contains every message unchanged. lenses.py and drawings.py add what the viewer draws.
"""

import re
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

import rerun as rr
import rerun.chunk as rrc

from fleet.fleetfile.fleet_file import read_colors
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.session_dir import FLEET_FILE
from fleet.replay import panels
from fleet.replay.rerun import blueprint
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import MESSAGE_SUFFIX, lenses
from schemas.topics import TOPICS

APPLICATION: Final = "zenoh-car-fleet"
_INTERRUPT: Final = re.compile(rf"\b{KeyboardInterrupt.__name__}\b")
TEXT: Final = "TextLog:text"
_LOGS: Final = tuple(f"/{topic.name}" for topic in TOPICS.values() if topic.message == "foxglove.Log")


class ExportFailed(Exception):
    """The .rrd could not be written. The message gives the reason."""


@dataclass(frozen=True, slots=True)
class Part:
    """Part of a session to show: cars (the fleet's services are always included) and a time span."""

    cars: tuple[str, ...] = ()
    """Empty: all cars."""
    start_ns: int | None = None
    end_ns: int | None = None
    """Times of the recorder's clock, ns since the epoch; `end_ns` is excluded."""

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
        """Return the end of the message "holds no message of a fleet"."""
        return "" if self == WHOLE_SESSION else " of these cars in this time"


WHOLE_SESSION: Final = Part()


def export(
    session: Session,
    out: Path,
    part: Part = WHOLE_SESSION,
    *,
    tab: str = "",
    seen: Callable[[int], None] = lambda _: None,
) -> Counter[str]:
    """Write `out`, and return its messages by key. Raises ExportFailed, and NoSession without a message of a fleet.

    `tab` names the car whose tab is in front. `seen` is called with the number of messages read since its last call.
    """
    drawing = Drawing(car_colors=read_colors(session.path / FLEET_FILE))
    readers = [part.reader(segment) for segment in session.segments]
    stream = rrc.LazyChunkStream.merge(*(reader.stream() for reader in readers))
    stream = rrc.LazyChunkStream.from_iter(drawing.follow(_count_rows(stream, seen))).lenses(
        lenses(), output_mode="forward_all"
    )
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".replay-") as scratch:
        whole = Path(scratch) / "whole.rrd"
        # Only the file of a recording stream carries a layout. The layout comes last: it depends on all messages.
        recording = rr.RecordingStream(APPLICATION, recording_id=session.name)
        recording.save(whole)
        try:
            recording.send_chunks(stream)
        except RuntimeError as error:
            words = " ".join(str(error).split())
            if _INTERRUPT.search(words):  # Ctrl-C during a lens: Rerun passes on only the text
                raise KeyboardInterrupt from None
            raise ExportFailed(f"Rerun cannot read {session.path}: {words[:200]}") from None
        contents = drawing.contents()
        if not contents.cars and not contents.services:
            raise NoSession(f"{session.path} has no message of a fleet{part.words}")
        recording.send_chunks(rrc.LazyChunkStream.from_iter(chain(drawing.ends(), drawing.static())))
        recording.send_blueprint(blueprint.layout(drawing, tab), make_active=False, make_default=True)
        recording.disconnect()
        try:
            # Rerun's writer does not report a full disk. So read the file back: a truncated one has no index.
            with warnings.catch_warnings(action="ignore"):
                rrc.RrdReader(whole).store()
        except (RuntimeError, ValueError):
            free = shutil.disk_usage(out.parent).free
            raise ExportFailed(
                f"{out} is incomplete: the disk is probably full ({free} bytes are free). Name another place."
            ) from None
        whole.replace(out)
    return drawing.counts


def count_of(session: Session) -> int:
    """Return the number of messages of a session from the indexes of its files."""
    channels = [channel for each in session.segments for channel in WHOLE_SESSION.reader(each).info().channels]
    return sum(channel.message_count or 0 for channel in channels)


def _count_rows(chunks: Iterable[rrc.Chunk], seen: Callable[[int], None]) -> Iterator[rrc.Chunk]:
    for chunk in chunks:
        yield chunk
        if not chunk.is_static:
            seen(chunk.num_rows)


def rows(path: Path) -> Counter[str]:
    """Return the messages of an .rrd by key, counted with Rerun's reader."""
    counted: Counter[str] = Counter()
    for chunk in rrc.RrdReader(path).store().stream():
        if chunk.is_static:
            continue
        key = panels.key_of(chunk.entity_path)
        names = chunk.to_record_batch().schema.names
        own = any(name.endswith(MESSAGE_SUFFIX) for name in names)
        # Rerun converts foxglove.Log to text. Any other text comes from our lenses.
        if own or (TEXT in names and key.endswith(_LOGS)):
            counted[key] += chunk.num_rows
    return counted

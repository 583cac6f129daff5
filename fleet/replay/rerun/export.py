"""A session to an .rrd that carries its layout, by Rerun's own MCAP reader and lenses; and the count of what is in one.

Every message goes into the .rrd as it was; lenses and drawing.py add what the viewer draws.
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

from fleet.recording.reading.session import NoSession, Session
from fleet.replay import panels
from fleet.replay.rerun import blueprint
from fleet.replay.rerun.drawings import Drawing
from fleet.replay.rerun.lenses import MESSAGE, lenses
from schemas.topics import TOPICS

APPLICATION: Final = "zenoh-car-fleet"
_INTERRUPT: Final = re.compile(rf"\b{KeyboardInterrupt.__name__}\b")
TEXT: Final = "TextLog:text"
_LOGS: Final = tuple(f"/{topic.name}" for topic in TOPICS.values() if topic.message == "foxglove.Log")


class ExportFailed(Exception):
    """The .rrd could not be written; its text says why."""


@dataclass(frozen=True, slots=True)
class Part:
    """What of a session is shown: some of its cars (and the fleet's services), some of its time."""

    cars: tuple[str, ...] = ()
    """None: all."""
    start_ns: int | None = None
    end_ns: int | None = None
    """The recorder's clock, ns since the epoch; `end_ns` itself is not in it."""

    def reader(self, segment: Path) -> rrc.McapReader:
        """Rerun's reader of this part of a segment."""
        wanted = None
        if self.cars:
            names = "|".join(re.escape(name) for name in self.cars)
            wanted = [f"^[^/]+/(({names})|@[^/]*)/"]
        return rrc.McapReader(
            segment,
            include_topic_regex=wanted,
            start_time_ns=self.start_ns,
            end_time_ns=self.end_ns,
            recover=True,
        )

    @property
    def words(self) -> str:
        """What stands behind "holds no message of a fleet"."""
        return "" if self == EVERYTHING else " of these cars in this time"


EVERYTHING: Final = Part()


def export(
    session: Session,
    out: Path,
    part: Part = EVERYTHING,
    *,
    tab: str = "",
    seen: Callable[[int], None] = lambda _: None,
) -> Counter[str]:
    """Write `out`; how many messages of each key it holds. Raises ExportFailed, and NoSession if there is nothing.

    `tab`: the car whose tab is in front. `seen` is told how many messages have been read since it was last told.
    """
    drawing = Drawing()
    readers = [part.reader(segment) for segment in session.segments]
    stream = rrc.LazyChunkStream.merge(*(reader.stream() for reader in readers))
    stream = rrc.LazyChunkStream.from_iter(drawing.follow(_told(stream, seen))).lenses(
        lenses(), output_mode="forward_all"
    )
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".replay-") as scratch:
        whole = Path(scratch) / "whole.rrd"
        # A recording stream, because only its file carries a layout, which comes last: what there is is known then.
        recording = rr.RecordingStream(APPLICATION, recording_id=session.name)
        recording.save(whole)
        try:
            recording.send_chunks(stream)
        except RuntimeError as error:
            words = " ".join(str(error).split())
            if _INTERRUPT.search(words):  # which came while a lens was at work: Rerun has only its text
                raise KeyboardInterrupt from None
            raise ExportFailed(f"Rerun cannot read {session.path}: {words[:200]}") from None
        contents = drawing.contents()
        if not contents.cars and not contents.services:
            raise NoSession(f"{session.path} holds no message of a fleet{part.words}")
        recording.send_chunks(rrc.LazyChunkStream.from_iter(chain(drawing.ends(), drawing.still())))
        recording.send_blueprint(blueprint.layout(drawing, tab), make_active=False, make_default=True)
        recording.disconnect()
        try:
            # Its writer tells nobody of a full disk; a cut file has no index, of which its reader warns besides.
            with warnings.catch_warnings(action="ignore"):
                rrc.RrdReader(whole).store()
        except (RuntimeError, ValueError):
            free = shutil.disk_usage(out.parent).free
            raise ExportFailed(
                f"{out} could not be written whole: {free} bytes are free there, {session.path} may need more"
            ) from None
        whole.replace(out)
    return drawing.held


def count_of(session: Session) -> int:
    """How many messages a session has, as its files say."""
    channels = [channel for each in session.segments for channel in EVERYTHING.reader(each).info().channels]
    return sum(channel.message_count or 0 for channel in channels)


def _told(chunks: Iterable[rrc.Chunk], seen: Callable[[int], None]) -> Iterator[rrc.Chunk]:
    for chunk in chunks:
        yield chunk
        if not chunk.is_static:
            seen(chunk.num_rows)


def rows(path: Path) -> Counter[str]:
    """How many messages of each key an .rrd holds, by Rerun's own reader."""
    counted: Counter[str] = Counter()
    for chunk in rrc.RrdReader(path).store().stream():
        if chunk.is_static:
            continue
        key = panels.key_of(chunk.entity_path)
        names = chunk.to_record_batch().schema.names
        own = any(name.endswith(MESSAGE) for name in names)
        # foxglove.Log is text in Rerun; any other text was made by a lens of ours.
        if own or (TEXT in names and key.endswith(_LOGS)):
            counted[key] += chunk.num_rows
    return counted
